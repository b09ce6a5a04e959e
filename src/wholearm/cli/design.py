"""Commands that vary the numbers of problems: their options, and what carries them out."""

from __future__ import annotations

import argparse
import os
import re
from functools import partial

from ..common.fields import keys_of
from ..common.files import require_ending, write_text
from ..mechanics import MARGIN
from ..planning.options import PLANNER, PlanOptions

PLANNING = re.sub(r"^--samples .*\n", "", PLANNER, flags=re.M) + MARGIN
"""Options of the planner but the rows of trajectory files, which are not written."""
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
        from ..design.sweep_figure import choose_axes

        choose_axes(vary, options.samples, len(options.problems))
    values = {name: getattr(options, name, None) for name in {*keys_of(PlanOptions)} - {"samples"}}
    start = partial(Processes, options.jobs)
    result = run(
        [read_problem(path) for path in options.problems],
        vary,
        **{name: value for name, value in values.items() if value is not None},
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
        from ..design.sweep_figure import draw_sweep
        from ..figures.plots import save

        save(draw_sweep(result), options.figure)
    return finish(options, result, output, options.figure)
