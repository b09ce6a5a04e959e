"""Commands that vary the numbers of problems: their options, and what carries them out."""

from __future__ import annotations

import argparse
import os
import re
from functools import partial
from typing import Any

from ..common.fields import keys_of
from ..common.files import require_ending, write_text
from ..mechanics import MARGIN
from ..planning.options import PLANNER, PlanOptions

PLANNING = re.sub(r"^--samples .*\n", "", PLANNER, flags=re.M) + MARGIN
"""Options of the planner but the rows of trajectory files, which are not written."""
OBJECTIVE = PLANNING[: PLANNING.index("--accuracy")]
TABLE = f"""\
[[sweep]]  sweep  plan a grid of other values of the numbers in problem files
problems PROBLEM ...   problem files (TOML)
--vary NAME=VALUES ...  what is varied, by the names of Problem.with_: LOW:HIGH:COUNT, or
    VALUE,VALUE,... of numbers or words, as in torque_limit=1:3:5 phases[5].until.phi_deg=-50,-45;
    LOW:HIGH with --samples
--samples N            points of a Latin hypercube of all ranges in place of the grid = 0
    in 0..1000000
--seed K               of the samples = 0 in 0..9223372036854775808
--with CHECKS          what plans are tried with: verify, free, policy, or several with commas
-o --output FILE       table to write (.csv; default: NAME_PARAMETERS.csv). Rows are kept in a
    .jsonl file beside it as they come; a sweep that is there goes on where it was stopped
--fresh                begin these files anew, whatever they hold
--figure FILE          also draw (.png, .pdf, .svg) a curve over one parameter, contours over two,
    small multiples over three
--jobs N               worker processes (default: all cores) in 1..256
--scheduler ADDRESS    run on the cluster of this Dask scheduler (extra: cluster)
--time-limit S         longest time for one point (none) in 1e-3..1e9
{PLANNING}\
--json                 print the result as JSON
[[sensitivities]]  sensitivities  see what 1 percent more of each number in a problem file is worth
problem            problem file (TOML)
[plan]             trajectory file (.npz) of its plan, whose objective and options count
--of NAME ...      these numbers alone, by the names of Problem.with_ (default: all but corners)
--differences      between solved problems, also where multipliers give derivatives
-o --output FILE   figure to write (.png, .pdf, .svg): a bar for each number
--jobs N           processes (default: all cores) in 1..256
{PLANNING}\
--json             print the result as JSON
[[design]]  find_hand  find the hand that does a job best
problems PROBLEM ...   problem files (TOML), for one hand
--over NAME=LOW:HIGH ...  numbers to choose and their ranges, by the names of Problem.with_, as in
    length1=0.1:0.25 base1_x=0.06:0.1 (required)
--minimise NAME        time, effort or -margin = time among time|effort|-margin
--symmetric            let what is said of one finger hold for the other, mirrored
--weights W ...        weights of several problems (equal ones)
--worst                of several problems let the worst one count, and not the weighted sum
--starts N             searches: from the present hand, and from random feasible ones = 3 in 1..100
--budget N             most hands of each search, and most until its first feasible one = 80
    in 1..100000
-o --output FILE       problem file to write (.toml; default: NAME_design.toml); of several problems
    that of the first one
--figure FILE          also draw the path of the search (.png, .pdf, .svg)
--jobs N               processes (default: all cores) in 1..256
{PLANNING.replace(OBJECTIVE, "")}\
--json                 print the result as JSON
"""


def sweep(options: argparse.Namespace) -> int:
    """Plan all points, print and write their table, and draw it if that is asked for."""
    from ..common.parallel import Processes, connect
    from ..design.sweep import read_vary
    from ..design.sweep import sweep as run
    from ..problem.read import read_problem
    from .command import finish, require_output, show_progress, stem_of

    vary = read_vary(options.vary, options.samples)
    parts = [stem_of(options.problems[0]), *(re.sub(r"\W+", "_", name).strip("_") for name in vary)]
    output = options.output or f"{'_'.join(parts)}.csv"
    require_output(output, ".csv")
    require_output(options.figure)
    if options.figure is not None:
        from ..design.figures import choose_axes

        choose_axes(vary, options.samples, len(options.problems))
    start = partial(Processes, options.jobs)
    result = run(
        [read_problem(path) for path in options.problems],
        vary,
        **_list_given(options),
        samples=options.samples,
        seed=options.seed,
        checks=tuple(filter(None, (getattr(options, "with") or "").split(","))),
        time_limit=options.time_limit,
        path=f"{os.path.splitext(output)[0]}.jsonl" if require_ending(output, ".csv") else None,
        fresh=options.fresh,
        start=partial(connect, options.scheduler) if options.scheduler else start,
        progress=show_progress(),
    )
    write_text(output, result.to_csv())
    if options.figure is not None:
        from ..design.figures import draw_sweep
        from ..figures.plots import save

        save(draw_sweep(result), options.figure)
    return finish(options, result, output, options.figure)


def sensitivities(options: argparse.Namespace) -> int:
    """Print a table of sensitivities, and draw it if that is asked for."""
    from ..design.sensitivities import find_sensitivities
    from ..geometry.tracing import load
    from .command import finish, load_plan, require_output, show_progress

    require_output(options.output)
    problem, plan_options = load(options.problem), PlanOptions(**_list_given(options))
    notes = dict[str, list[str]]()
    if options.plan is not None:
        from ..planning.result import load_plan as read_plan

        problem, _, _, notes = load_plan(options, options.plan, options.json)
        plan_options = read_plan(options.plan).options
    result = find_sensitivities(
        problem,
        plan_options,
        options.of or (),
        options.jobs,
        show_progress(),
        not options.differences,
    )
    if options.output is not None:
        from ..design.figures import draw_sensitivities
        from ..figures.plots import save

        save(draw_sensitivities(result), options.output)
    return finish(options, result, options.output, notes=notes)


def _list_given(options: argparse.Namespace) -> dict[str, Any]:
    """Options of the planner that are given."""
    names = [name for name in keys_of(PlanOptions) if name != "samples"]
    values = {name: getattr(options, name, None) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def find_hand(options: argparse.Namespace) -> int:
    """Find the best hand, write its problem files, and draw the search if that is asked for."""
    from ..design.hand import design_hand
    from ..geometry.tracing import load
    from ..problem.table import save_problem
    from .command import finish, require_output, show_progress, stem_of

    paths = options.problems
    outputs = [options.output or f"{stem_of(path)}_design.toml" for path in paths[:1]]
    outputs += [f"{stem_of(path)}_design.toml" for path in paths[1:]]
    for path in outputs:
        require_output(path, ".toml")
    require_output(options.figure)
    result = design_hand(
        [load(path) for path in paths],
        options.over,
        options.minimise,
        **_list_given(options),
        symmetric=options.symmetric,
        weights=options.weights or (),
        worst=options.worst,
        starts=options.starts,
        budget=options.budget,
        jobs=options.jobs,
        progress=show_progress(),
    )
    for plan, path in zip(result.plans, outputs, strict=True):
        save_problem(plan.problem, path)
    if options.figure is not None:
        from ..design.figures import draw_search
        from ..figures.plots import save

        save(draw_search(result), options.figure)
    return finish(options, result, *outputs, options.figure)
