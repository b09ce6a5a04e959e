"""The command line: each command reads its files, calls a public function and prints the result.

Exit status 0 means done and all contacts held, 1 infeasible or a contact lost or a goal missed,
2 bad input, 130 interrupted, 143 terminated. Each command imports what it needs and nothing else.
Progress on stderr is a line that changes in a terminal, and else a line every ten seconds.
"""

from __future__ import annotations

import argparse
import errno
import json
import math
import os
import posixpath
import re
import shlex
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import wholearm

from ..common.errors import (
    InputError,
    ReplayError,
    SimulationError,
    WholearmError,
    name_source,
    require_number,
)
from ..common.fields import Range, choice, keys_of, read_options
from ..common.files import READ, number_same, require_ending, require_writable, together, write_text
from ..common.signals import listen, register_cleanup
from ..mechanics import MARGIN
from ..planning.options import PLANNER

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..benchmark.study import Study
    from ..common.document import Result


TOPICS = {
    "python": "", "file-format": "problem", "model": "mechanics", "contacts": "contacts",
    "planning": "planning", "path-domain": "planning/path_domain",
    "time-domain": "planning/time_domain", "robust-plans": "planning/robust",
    "verification": "verification", "messages": "cli", "search": "search", "map": "mapping",
    "policy": "policy", "robustness": "analysis", "engines": "engines", "design": "design",
    "slow-motions": "analysis", "tuning": "analysis", "comparison": "analysis",
    "simulation": "simulation", "free-simulation": "simulation", "output-files": "results",
    "figures": "figures", "movies": "viewer", "studies": "benchmark",
}  # fmt: skip
"""Folder of the page of each topic."""

INPUTS = {"problem", "problems", "plan", "trajectory", "torques", "files", "policy"}
"""Names of files that are read. But the option `--torques` is a file to write."""
PROBLEM = "problem  problem file (TOML)\n"
PLAN = "plan  trajectory file (.npz)\n"
JSON = "--json  print the result as JSON\n"
SQUEEZE = """\
--squeeze  internal force of quasistatic torques: 0 least, 1 with the largest least normal force
    = 0.5 in 0.0..1.0
"""
POLICY = """\
--policy FILE  feedback torques by this policy (.npz), at its period, instead of the plan's
"""
SENSOR = "--sensor  with --policy: the policy gets exact normal forces\n"
SEARCH = """\
--cache DIR       folder for results about the scene, for later searches for a goal (none); nobody
    else may write there
--jobs N          processes of a search for a [goal] (2, or 1 where there is one core) in 1..256
--time-limit S    longest time that this may take; a search then returns the best route so far
    (none) in 1e-3..1e9
"""

PLANNING = re.sub(r"^--samples .*\n", "", PLANNER, flags=re.M) + MARGIN
"""Options of the planner but the rows of trajectory files, which are not written."""
OBJECTIVE = PLANNING[: PLANNING.index("--accuracy")]

TABLE = f"""\
[[new]]  write a first problem file
name               the problem's name; NAME.toml is written
--polygon CORNERS  corners of the regular polygon, 3 to 50 (7) in 3..50
--size             from its centre to its corners [m] (0.05) in 1e-6..1e6
--vertices 'X,Y ...'  corners instead, anticlockwise [m], as in '0,0 0.08,0 0.04,0.06'
--mass             of the object [kg] (0.2 at a size of 0.05 m, growing with the area) in 1e-6..1e6
[[schema]]  print the JSON Schema of problem files, for editors
-o --output FILE  file to write, instead of printing
--table           all keys with unit, default and range as tables (Markdown) instead
[[solve]]  plan joint torques for a problem file
{PROBLEM}\
-o --output FILE        trajectory file to write (default: NAME.npz)
--torques FILE          also write the torques as CSV
--sample-rate HZ        write samples at this rate, and replay them [Hz] (none) in 1e-9..1e12
--interpolation NAME    of samples: linear, or hold for sample-and-hold (linear)
{PLANNER}{MARGIN}{SEARCH}{JSON}\
[[verify]]  replay torques open loop and check the motion
{PROBLEM}\
torques           trajectory file (.npz) or torques (.csv: t,tau1,tau2)
--tolerance       of the simulator's steps, relative to the scene's scales = 1e-9 in 1e-14..1e-2
--departure       largest distance of the replay from the plan, over the object's radius of
    gyration, and in rad (1e-3) in 1e-9..1e3
--rest-speed      largest speed of rest, over sqrt(that radius times g) (2e-2) in 1e-9..1e3
{MARGIN}\
--reduced         also list the paper's scalar equation of motion where a phase has four constraints
--free            simulate without prescribed contacts: whole, and a plan's phases one by one
--policy FILE     with --free: torques by this policy (.npz) instead of the plan's
{SENSOR}\
--restitution     Poisson's coefficient of impacts, 0 to 1, with --free (0: plastic) in 0.0..1.0
-o --output FILE  trajectory file to write (.npz) of the replayed motion, for plot
{JSON}\
[[plot]]  draw force margins, torques and snapshots
trajectory         trajectory file (.npz), or torques to replay (.csv)
--problem FILE     problem file (TOML) for torques
-o --output FILE   figure to write (.png, .pdf, .svg) (required)
--simulate [told|free]  overlay the simulated forces; told (default): with prescribed contacts;
    free: without them among told|free
--width            of the figure [in], 3 to 40 (10) in 3.0..40
--motion           also draw the object's pose, and the joints' angles and speeds
[[predict]]  find the speeds up to which motions along the phases keep every contact
{PROBLEM}\
-o --output FILE  figure to write (.png, .pdf, .svg) of the least normal force over speed
{SQUEEZE}\
--torques FILE    write the quasistatic torques as CSV, a first guess for hand tuning
--speed V         with --torques: mean speed along the phases [m/s] (0.05) in 1e-9..1e6
{JSON}\
[[tune]]  tune torques from quasistatic ones by steps of 10 percent
{PROBLEM}\
-o --output FILE  torques to write (.csv)
--brake           let each phase have one more step of its torques, which stops it at its end
--stops N         with --brake: let a phase that fails stop up to N times on its path = 0 in 0..7
{SQUEEZE}\
--share           raises beyond the first that reaches the end: 0 none, 1 all that keep contacts
    = 1 in 0.0..1.0
{JSON}\
[[compare]]  compare plans and torques for a problem by their replays
{PROBLEM}\
files FILE ...    trajectory files (.npz) or torques (.csv) for that problem
-o --output FILE  figure to write (.png, .pdf, .svg) of the force margins of all
{JSON}\
[[route]]  find the contact formations that lead to a goal, and plan
problem           problem file (TOML) with [goal] in place of [[phases]]
-o --output FILE  figure to write (.png, .pdf, .svg) of the route over the map
--alternatives N  number of further routes (other formations or stops) to list = 0 in 0..100
--objective NAME  of the plans: time, effort or margin; routes are searched by time = time
{SEARCH}{JSON}\
[[map]]  draw the contact formations over (x, phi)
{PROBLEM}\
-o --output FILE  figure to write (.png, .pdf, .svg; default: map_NAME.png)
--plan FILE       trajectory file (.npz) to draw over it
--phi LOW,HIGH    range of phi [deg] (default: the plan's)
--list X,PHI ...  print the formations along a route of two or more poses [m, deg] as [[phases]]
{MARGIN}\
[[export]]  write scene and plan for a physics engine
{PROBLEM}\
[plan]            trajectory file (.npz) that the model plays
--mjcf FILE       file to write (.xml): the scene in MuJoCo's format (required)
--step            time step of the model [s] (from the scene) in 1e-15..1e6
[[replay]]  replay a plan in MuJoCo or Drake and compare it with the plan
{PROBLEM}{PLAN}\
--engine NAME     mujoco or drake, installed with the extra of that name (required)
--whole           from start to end, instead of phase by phase from each planned start
{POLICY}\
--step            longest time step [s] (from the scene) in 1e-15..1e6
--softness        of contacts, over the default, which is proportional to the step (1) in 1e-6..1e6
--departure       largest distance of a replay from the plan, over the object's radius of gyration,
    and in rad (3e-3 for mujoco, 1.5e-3 for drake; of a policy's end, 1e-2) in 1e-9..1e3
--refine N        also replay with steps of a half, a quarter, ... to N halvings = 0 in 0..6
{JSON}\
[[policy]]  make a feedback policy: torques as a function of joint angles and speeds
{PLAN}\
-o --output FILE  policy to write (.npz; default: NAME_policy.npz)
--reserve         robustness margin of normal forces along the path: if plan or problem have ranges
    of numbers, a factor on these (1); otherwise over the changes by usual errors of masses,
    friction and torques (2.5); 0 is as fast as the plan in 0.0..1e3
--period          of the control loop [s] = 1e-3 in 1e-5..10
--delay           time from measuring to when torques take effect [s] = 5e-4 in 0.0..10
--contact-speed   at which contacts are made, over the usual speed; times at rest before the next
    phase begins are longer by its inverse square (the largest of 1, 0.5 and 0.25 that keeps all
    contacts in its simulation) in 1e-3..10
--torque-limit    of both fingers, if more than the plan's [N m] (the same) in 1e-12..1e12
--largest         also find the largest factor on the ranges with which a policy keeps contacts
--departure       largest opening of contacts in its simulation, over the object's radius of
    gyration (1e-3) in 1e-9..1e3
--write-anyway    write the policy although its simulation fails; its file has a mark of that
{JSON}\
[[robustness]]  simulate a plan under random errors and count the samples that succeed
{PROBLEM}{PLAN}\
--samples             samples to replay, a Latin hypercube of all ranges = 1000 in 1..1000000
--seed                of the samples = 0 in 0..9223372036854775808
--phase K             only this phase, from its planned start at rest (the whole plan) in 1..1000
{POLICY}{SENSOR}\
--vary NAME=WIDTH ...  half widths of ranges, instead of the problem's: mass, inertia (0.05),
    friction (0.1), gain of the torques (0.01), all relative; geometry, start_x [m] (6e-3 radii of
    gyration), delay (1e-3 s); 0: no change of a number
--sample-rate HZ      of a sample-and-hold of torques [Hz], 0 as planned = 1000 in 0.0..1e6
--tolerance           of the simulations, relative to the scene's scales = 1e-6 in 1e-14..1e-2
--goal-distance M     largest distance from the plan's end at the goal [m] (0.03 radii of gyration)
    in 1e-9..1e6
--goal-angle DEG      largest difference from its angle at the goal [degrees] = 1 in 1e-9..360
-o --output FILE      file to write results to, one by one (default: NAME_robustness.jsonl, with
    phase and policy in the name); a study in it is continued
--fresh               overwrite the file
--figure FILE         also draw the motion with its noisy copies (.png, .pdf, .svg)
--jobs                worker processes (default: all cores) in 1..256
--scheduler ADDRESS   run on the cluster of this Dask scheduler (extra: cluster)
{JSON}\
[[sweep]]  plan problem files for a grid of values of their numbers
problems PROBLEM ...   problem files (TOML)
--vary NAME=VALUES ...  numbers to vary, by the names of Problem.with_: LOW:HIGH:COUNT, or
    VALUE,VALUE,... of numbers or words, as in torque_limit=1:3:5 phases[5].until.phi_deg=-50,-45;
    LOW:HIGH with --samples
--samples N            points of a Latin hypercube in place of the grid = 0 in 0..1000000
--seed K               of the samples = 0 in 0..9223372036854775808
--with CHECKS          simulations of plans: verify, free, policy, or several with commas
-o --output FILE       table to write (.csv; default: NAME_sweep_PARAMETERS.csv). Rows are stored
    one by one in a .jsonl file beside it; a sweep in it is continued
--fresh                overwrite these files
--figure FILE          also draw (.png, .pdf, .svg) a curve over one parameter, contours over two,
    small multiples over three
--jobs N               worker processes (default: all cores) in 1..256
--scheduler ADDRESS    run on the cluster of this Dask scheduler (extra: cluster)
--time-limit S         longest time for one point (none) in 1e-3..1e9
{PLANNING}{JSON}\
[[sensitivities]]  find derivatives of a plan's objective by each number in a problem file
problem            problem file (TOML)
[plan]             trajectory file (.npz) of its plan, whose objective and options are used
--of NAME ...      these numbers alone, by the names of Problem.with_ (default: all but corners)
--differences      differences of solved problems, also if multipliers give derivatives
-o --output FILE   figure to write (.png, .pdf, .svg): a bar for each number
--jobs N           processes (default: all cores) in 1..256
{PLANNING}{JSON}\
[[design]]  optimize numbers of the hand for one or several problems
problems PROBLEM ...   problem files (TOML), for one hand
--over NAME=LOW:HIGH ...  numbers to choose and their ranges, by the names of Problem.with_, as in
    length1=0.1:0.25 base1_x=0.06:0.1 (required)
--minimise NAME        time, effort or -margin = time among time|effort|-margin
--symmetric            numbers of one finger hold for the other, mirrored
--weights W ...        weights of several problems (equal ones) in 1e-6..1e6
--worst                minimize the largest value of several problems, not the weighted sum
--starts N             searches: from the present hand, and from random feasible ones = 3 in 1..100
--budget N             most hands of a search after its first feasible one, and as many before
    = 80 in 1..100000
-o --output FILE       problem file to write (.toml; default: NAME_design.toml); of several problems
    that of the first one
--figure FILE          also draw the path of the search (.png, .pdf, .svg)
--jobs N               processes (default: all cores) in 1..256
{PLANNING.replace(OBJECTIVE, "")}{JSON}\
[[animate]]  make a movie of a plan, or a page that plays it
trajectory         trajectory file (.npz)
-o --output FILE   what to write: .gif, .mp4 (needs ffmpeg), or .html for any browser (required)
--speed            speed over real time, 0.1 is ten times slower = 0.1 in 1e-6..1e3
--simulate [told|free]  draw the simulated motion behind; told (default): with prescribed contacts;
    free: without them among told|free
[[report]]  write a page of HTML about a problem and its plans
{PROBLEM}\
[files PLAN ...]  trajectory files (.npz) or torques (.csv); none: plan the least time
-o --output FILE  page to write (default: NAME.html)
--sensitivities   also show the effect of 1 percent more of each number of the problem
[[gallery]]  plan problems and show them all on one page
files PROBLEM ...  problem files (TOML)
-o --output FILE   page to write (.md), with a folder of pictures beside it = results/gallery.md
[[help]]  print a page of the documentation, or list its topics
[topic TOPIC]  topic of the page (left out: list the topics) among {"|".join(TOPICS)}
[[completion]]  print a completion script of a shell
shell  bash, zsh or tcsh; needs the extra completion
"""
"""Commands without `bench`: name, purpose, then files and options in the form of `read_options`.
A command is run by the function with its name after an underscore."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    try:
        status = _run(prepare(sys.argv[1:] if arguments is None else arguments))
        sys.stdout.flush()
        return status
    except OSError as error:
        # An error of the output: files have other errors.
        if error.errno not in (errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EIO):
            raise
        # At its exit the interpreter would complain again about the output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if error.errno != errno.EPIPE:
            _complain(f"standard output: cannot be written: {error.strerror}")
        return 1


def _run(words: Sequence[str]) -> int:
    """Run a command; errors are lines on stderr, and with `--json` also objects on stdout."""
    options = argparse.Namespace()
    try:
        options = build_parser(words).parse_args(words)
        for value in (getattr(options, name) for name in options.inputs):
            paths = value if isinstance(value, list) else [value]
            READ.update(map(os.path.realpath, filter(None, paths)))
        if not sys.stderr.isatty():
            _LINES.begin(os.getpid())
        try:
            with warnings.catch_warnings():
                # Letters that the font does not have are boxes in figures.
                warnings.filterwarnings("ignore", "Glyph ")
                status: int = options.run(options)
        finally:
            _LINES.begin(0)
            READ.clear()
        return status
    except WholearmError as error:
        if isinstance(error, InputError) and not error.source and hasattr(options, error.key):
            error = InputError("", f"--{error.key.replace('_', '-')}", error.problem)
        _complain(str(error))
        if getattr(options, "json", "--json" in words):
            print(json.dumps(error.to_dict() | getattr(options, "notes", {}), indent=2))
        return error.exit_status


def _complain(text: str) -> None:
    try:
        clear_progress()
        print(f"wholearm: {text}", file=sys.stderr, flush=True)
    except OSError:
        pass  # stderr is closed


class Parser(argparse.ArgumentParser):
    """A parser whose errors are `InputError`; -margin and negative numbers are no options."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\.?\d|margin$)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; errors of unknown arguments have the name of the command."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def _print_message(self, message: str, file: Any = None) -> None:
        # That of argparse ignores errors of the output.
        print(message, end="", file=file, flush=True)

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        raise InputError("", "", f"{message.removeprefix('argument ')}; see {self.prog} --help")


def add_parser(parsers: Any, name: str, text: str, table: str = "") -> Parser:
    """Add the parser of a command or study: purpose, options and files (`read_options`)."""
    title = f"{text[0].upper()}{text[1:]}."
    parser: Parser = parsers.add_parser(name, help=text, description=title)
    actions = [parser.add_argument(*o.flags, **o.arguments) for o in read_options(table)]
    files = [action for action in actions if action.dest in INPUTS and not action.type]
    parser.set_defaults(inputs=[a.dest for a in files if "--torques" not in a.option_strings])
    return parser


def build_parser(words: Sequence[str] | None = None) -> Parser:
    """The parser of all commands; with `words`, only the command in these has its options."""
    parser = Parser(prog="wholearm", description="Plan and verify whole-arm manipulation.")
    version = f"wholearm {wholearm.__version__}"
    parser.add_argument("--version", action="version", version=version, help="print the version")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for part in re.split(r"^(?=\[\[)", TABLE, flags=re.M)[1:]:
        head, _, table = part.partition("\n")
        name, text = head.removeprefix("[[").split("]]  ")
        selected = words is None or name in words[:1]
        subparser = add_parser(commands, name, text, table if selected else "")
        subparser.set_defaults(run=globals()[f"_{name}"])
    text = "run studies: measure, compare with stored answers, look for what must not be"
    bench = add_parser(commands, "bench", text)
    bench.set_defaults(run=_list_studies)
    if words is None or words[:1] == ["bench"]:
        # Studies are imported when they are used.
        from ..benchmark import STUDIES

        studies = bench.add_subparsers(metavar="STUDY")
        for name, text in STUDIES.items():
            if words is None or name in words[1:2]:
                study = load_study(name)
                subparser = add_parser(studies, name, text, study.list_options())
                subparser.set_defaults(run=partial(_run_study, study))
            else:
                add_parser(studies, name, text)
    return parser


def prepare(words: Sequence[str]) -> list[str]:
    """Arguments for argparse: `--simulate` with its simulator, `--list` without an equals sign.

    argparse would use a file after `--simulate` as simulator, in place of the default `told`, and
    only one pair after `--list=`.
    """
    queue, texts = [*words], list[str]()
    while queue:
        text = queue.pop(0)
        if text == "--simulate":
            word = queue and re.fullmatch(r"\w+", queue[0]) and not os.path.exists(queue[0])
            text += f"={queue.pop(0) if word else 'told'}"
        texts += ["--list", text[7:]] if text.startswith("--list=") else [text]
    return texts


LOG_INTERVAL = 10.0  # time between lines of progress where stderr is no terminal [s]


class _Lines:
    """Lines on progress for a log, with the elapsed time."""

    def __init__(self) -> None:
        listen(self.print_if_due)
        self.begin(0)

    def begin(self, process: int) -> None:
        """Start the clock of the work of a process."""
        self._process, self.text = process, "working"
        self._start = self._last = time.monotonic()

    def print_if_due(self) -> None:
        """Print the last text, if the interval is over."""
        now = time.monotonic()
        # Progress of a forked process is printed by its parent.
        if now - self._last >= LOG_INTERVAL and os.getpid() == self._process:
            self._last = now
            _complain(f"{now - self._start:.0f} s: {self.text}")


_LINES = _Lines()  # of the command, for progress of several tasks


def show_progress(text: str) -> None:
    """Show progress: a line that changes in a terminal, or else one every ten seconds."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
    else:
        _LINES.text = text
        _LINES.print_if_due()


def clear_progress() -> None:
    """Remove the progress line."""
    if sys.stderr.isatty():
        show_progress("")


register_cleanup(clear_progress)


def require_output(path: str | None, *endings: str) -> None:
    """InputError, before long work, if a file cannot be written; by default it is a figure."""
    if path is not None:
        require_writable(path)
        require_ending(path, *(endings or (".png", ".pdf", ".svg")))


def finish(options: argparse.Namespace, result: Result | None, *paths: str | None) -> int:
    """Print a result as text or JSON with notes, and names of written files; the exit status."""
    clear_progress()
    as_json = getattr(options, "json", False)
    if result is not None and as_json:
        print(json.dumps(result.to_dict() | getattr(options, "notes", {}), indent=2))
    elif result is not None:
        print(result.to_text())
    written = ", ".join(filter(None, paths))
    if written and not as_json:
        print(f"wrote {written}")
    return 0 if result is None else result.exit_status


def refuse(options: argparse.Namespace, problem: str, *names: str) -> None:
    """InputError, with the problem, of the first of some options that is set."""
    for name in names:
        if getattr(options, name) is not None and getattr(options, name) is not False:
            raise InputError("", f"--{name.replace('_', '-')}", problem)


def require_with(options: argparse.Namespace, required: str, *names: str) -> None:
    """InputError if an option is not set, but another one that needs it."""
    if getattr(options, required) in (None, False):
        refuse(options, f"needs --{required.replace('_', '-')}", *names)


def list_given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Options with these names that are set."""
    values = {name: getattr(options, name, None) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def save_figure(path: str | None, function: str, result: Result) -> None:
    """Draw a result by a function of `figures.result_figures`, if a file is given for it."""
    if path is not None:
        from ..figures import result_figures

        wholearm.plots.save(getattr(result_figures, function)(result), path)


def choose_workers(options: argparse.Namespace) -> Callable[[], Executor]:
    """Function that starts the processes of a study, or connects to its cluster."""
    from ..common.parallel import Processes, connect

    if options.scheduler is not None:
        client = connect(options.scheduler)  # before any file is written
        return lambda: client
    return partial(Processes, options.jobs)


def read_problem(options: argparse.Namespace) -> wholearm.Problem:
    """The problem of a command, whose phases are not traced."""
    from ..problem.read import read_problem

    return read_problem(options.problem)


LoadedPlan = tuple["wholearm.Problem", "wholearm.Trajectory", "wholearm.Policy | None"]


def load_plan(options: argparse.Namespace, path: str) -> LoadedPlan:
    """The problem with the phases of a plan, the plan, and its policy if any.

    Notes on plans for another problem are printed, or stored if the output is JSON or phases.
    InputError, with the file, if a plan or policy cannot be used for the problem.
    """
    from ..results.adopt import adopt_phases, describe_origin, require_same_contacts

    plan, problem, policy = wholearm.load_trajectory(path), read_problem(options), None
    policy_path, origins = getattr(options, "policy", None), [("plan", path, plan.meta)]
    if policy_path is not None:
        policy = wholearm.Policy.load(policy_path).with_sensor(getattr(options, "sensor", False))
        origins.append(("policy", policy_path, policy.about))
    problem, notes = adopt_phases(problem, plan.meta, plan.q[-1], path), list[str]()
    with name_source(path):
        require_same_contacts(problem, plan)
    for what, source, meta in origins:
        with name_source(source):
            notes += filter(None, [describe_origin(problem, meta, what)])
            if policy is not None and what == "policy":
                policy.require_count(len(problem.phases), "problem")
    if getattr(options, "json", False) or getattr(options, "list", ()):
        options.notes = {"notes": notes} if notes else {}
    else:
        for note in notes:
            print(note)
    return problem, plan, policy


def _solve(options: argparse.Namespace) -> int:
    from ..planning.plan import solve_with
    from ..planning.result import describe_plan
    from ..scene.model import find_unit_hint

    plan_options = wholearm.PlanOptions(**list_given(options, *keys_of(wholearm.PlanOptions)))
    problem = wholearm.load(options.problem)
    output = options.output or f"{Path(options.problem).stem}.npz"
    require_output(output, ".npz")
    require_output(options.torques, ".csv")
    require_with(options, "sample_rate", "interpolation")
    require_with(options, "torques", "sample_rate")
    interpolation = options.interpolation or "linear"
    choice("linear", "hold").read(interpolation, "interpolation")
    if hint := find_unit_hint(problem.scene):
        _complain(f"{options.problem}: {hint}")
    if not problem.goals:
        refuse(options, "is for problems with [goal]", "cache", "jobs")
    route_text, table = "", None
    try:
        if problem.goals:
            answer = find_route(options, problem)
            plan, route_text = answer.plan, answer.to_text()
        else:
            plan = solve_with(problem, plan_options, show_progress, options.time_limit)
        if options.torques is not None:
            from ..planning.replay_check import make_table

            sampling = options.sample_rate, interpolation
            table = make_table(plan.problem, plan.trajectory, options.replay, *sampling)
    except WholearmError as error:
        # Bad input needs no further line.
        for path in filter(None, (output, options.torques) if error.exit_status == 1 else ()):
            if os.path.exists(path):
                _complain(f"{path}: left as it was, from an earlier run")
        raise
    with together():
        plan.save(output)
        if table is not None:
            table.save(options.torques)
    clear_progress()
    figures = None if table is None else {"file": options.torques, **table.figures}
    if options.json:
        extra = {} if figures is None else {"torques": figures}
        print(json.dumps(plan.to_dict() | extra, indent=2))
    else:
        print(route_text + describe_plan(plan, output, figures).to_text())
    return 0


def _verify(options: argparse.Namespace) -> int:
    require_output(options.output, ".npz")
    keys = ("tolerance", "departure", "rest_speed", "uniqueness_margin", "restitution")
    values = list_given(options, *keys)
    require_with(options, "free", "restitution", "policy")
    require_with(options, "policy", "sensor")
    if options.free:
        refuse(options, "does not go with --free", "reduced", "rest_speed", "uniqueness_margin")
    policy = None
    torques: wholearm.Trajectory | wholearm.TorqueProfile
    report: wholearm.Report | wholearm.FreeReport
    if not _is_table(options.torques) or options.policy is not None:
        problem, torques, policy = load_plan(options, options.torques)
    else:
        problem, torques = read_problem(options), wholearm.read_torque_csv(options.torques)
    if getattr(torques, "meta", {}).get("problem") != problem.table:
        # Only problems that have been neither planned nor replayed may be impossible.
        from ..geometry.tracing import check_phases

        check_phases(problem)
    if policy is not None and isinstance(torques, wholearm.Trajectory):
        report = wholearm.verify_policy(problem, torques, policy, **values)
    elif options.free:
        report = wholearm.verify_free(problem, torques, progress=show_progress, **values)
    else:
        show_progress(f"replaying {len(problem.phases)} phases")
        report = wholearm.verify(problem, torques, reduced=options.reduced, **values)
    written = None
    if options.output is not None:
        try:
            report.trajectory.save(options.output)
            written = options.output
        except SimulationError as error:
            _complain(f"{options.output}: is not written: {error}")
    return finish(options, report, written)


def _is_table(path: str) -> bool:
    """Whether a file has torques alone, and no trajectory."""
    return require_ending(path, ".npz", ".csv") == ".csv"


def _plot(options: argparse.Namespace) -> int:
    require_output(options.output)
    if not _is_table(options.trajectory):
        trajectory = wholearm.load_trajectory(options.trajectory)
        motion: wholearm.Simulation | wholearm.Trajectory = trajectory
        refuse(options, "is for torques (.csv); trajectories bring their own", "problem")
    else:
        torques = wholearm.read_torque_csv(options.trajectory)
        if options.problem is None:
            raise InputError(options.trajectory, "--problem", "is needed to replay torques")
        problem = wholearm.load(options.problem)
        # Steps of the simulator are too long for smooth curves; a figure has about 1000 points.
        rows: Any = {"times": [k / 1000 * torques.breaks[-1] for k in range(1001)], "minima": True}
        motion = wholearm.simulate(problem, torques, **rows, progress=show_progress)
        trajectory = motion.trajectory
    with name_source(options.trajectory):
        simulation = overlay(options.simulate, trajectory)
        figure = wholearm.plots.force_margins(
            motion, simulation=simulation, motion=options.motion, **list_given(options, "width")
        )
    wholearm.plots.save(figure, options.output)
    return finish(options, None, options.output)


def overlay(simulator: str | None, trajectory: wholearm.Trajectory) -> wholearm.Simulation | None:
    """Simulation of the torques of a trajectory by a simulator, told or free; None without one."""
    if simulator is None:
        return None
    from ..problem.read import read_stored_problem

    problem = read_stored_problem(trajectory.meta)
    if simulator == "free":
        show_progress("simulating the whole")
        free = wholearm.simulate_free(problem, trajectory, times=trajectory.t)
        return free.show(trajectory.contacts)
    torque, t = trajectory.torque, trajectory.t
    return wholearm.simulate(problem, torque, times=t, progress=show_progress)


def _predict(options: argparse.Namespace) -> int:
    from ..analysis.slow_speeds import make_torques

    require_output(options.output)
    require_output(options.torques, ".csv")
    require_with(options, "torques", "speed")
    problem = read_problem(options)
    prediction = wholearm.predict(problem, squeeze=options.squeeze, progress=show_progress)
    save_figure(options.output, "draw_prediction", prediction)
    if not options.json:
        finish(options, prediction)  # also if there are no torques to write
    if options.torques is not None:
        wholearm.save(make_torques(prediction, options.speed or 0.05), options.torques)
    finish(options, prediction if options.json else None, options.output, options.torques)
    return prediction.exit_status


def _tune(options: argparse.Namespace) -> int:
    require_output(options.output, ".csv")
    values = list_given(options, "brake", "stops", "squeeze", "share")
    tuning = wholearm.tune(wholearm.load(options.problem), **values, progress=show_progress)
    output = options.output if tuning.ok else None
    if output is not None:
        write_text(output, tuning.to_csv())
    return finish(options, tuning, output)


def _compare(options: argparse.Namespace) -> int:
    require_output(options.output)
    problem = wholearm.load(options.problem)
    comparison = wholearm.compare(problem, options.files, show_progress)
    save_figure(options.output, "draw_comparison", comparison)
    return finish(options, comparison, options.output)


def _robustness(options: argparse.Namespace) -> int:
    from ..problem.definition import expand_widths

    # Studies of other problems, phases and policies have other files.
    parts = [Path(options.problem).stem, "robustness"]
    parts += [] if options.phase is None else [f"phase{options.phase}"]
    parts += [] if options.policy is None else [Path(options.policy).stem]
    parts += ["sensor"] if options.sensor else []
    output = options.output or f"{'_'.join(parts)}.jsonl"
    require_output(output, ".jsonl")
    require_output(options.figure)
    require_with(options, "policy", "sensor")
    problem, plan, policy = _load_replayed(options)
    widths: dict[str, float] = {}
    for text in options.vary:
        name, _, value = text.partition("=")
        try:
            if name in widths:
                raise ValueError(name)
            widths[name] = float(value)
        except ValueError:
            fault = f"{text!r} given; NAME=WIDTH is needed, such as mass=0.1, and each name once"
            raise InputError("", "--vary", fault) from None
    ranges = problem.ranges | expand_widths(widths, "--vary {}")
    goal = options.goal_distance, math.radians(options.goal_angle)
    trials = wholearm.Uncertainty(ranges, options.sample_rate or None, options.tolerance, *goal)
    study = wholearm.assess_robustness(
        problem,
        plan,
        **list_given(options, "samples", "seed", "phase", "fresh"),
        uncertainty=trials,
        policy=policy,
        path=output,
        start=choose_workers(options),
        progress=show_progress,
    )
    save_figure(options.figure, "draw_robustness", study)
    status = finish(options, study, options.figure)
    if not options.json:
        print(f"results: {output}")  # also of earlier runs
    return status


def _route(options: argparse.Namespace) -> int:
    require_output(options.output)
    answer = find_route(options, read_problem(options), options.alternatives)
    clear_progress()
    text = f"{json.dumps(answer.to_dict(), indent=2)}\n" if options.json else answer.to_text()
    print(text, end="")
    if options.output is not None:
        _save_map(answer.problem, answer.plan.trajectory, options.output)
        print(f"wrote {options.output}", file=sys.stderr)
    return 0


def find_route(
    options: argparse.Namespace, problem: wholearm.Problem, alternatives: int = 0
) -> wholearm.Answer:
    """Find a route, with a progress line, in two processes by default."""
    from ..common.parallel import count_cores

    def warn(message: Warning | str, *_: object, **__: object) -> None:
        _complain(f"warning: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = warn
        return wholearm.find_route(
            problem,
            **list_given(options, "cache", "time_limit", *keys_of(wholearm.PlanOptions)),
            alternatives=alternatives,
            progress=show_progress,
            jobs=min(2, count_cores()) if options.jobs is None else options.jobs,
            hurry=hasten,
        )


def hasten() -> None:
    """Print that the best route so far is being planned."""
    _complain("planning the best route; again to stop")


def _save_map(
    problem: wholearm.Problem,
    plan: wholearm.Trajectory | None,
    output: str,
    phi: tuple[float, float] | None = None,
    **limit: Any,
) -> None:
    from ..mapping.formation_map import choose_window

    window = choose_window(problem, phi)
    formation_map = wholearm.build_map(problem, window=window, progress=show_progress, **limit)
    wholearm.plots.save(wholearm.draw_map(formation_map, plan), output)
    clear_progress()


def _map(options: argparse.Namespace) -> int:
    poses = [_read_pair(text, "--list", "X,PHI in m and degrees") for text in options.list]
    phi = options.phi and _read_pair(options.phi, "--phi", "LOW,HIGH in degrees")
    if phi and not 0 < phi[1] - phi[0] <= 360:
        raise InputError("", "--phi", f"{options.phi!r} given; LOW < HIGH <= LOW + 360 is needed")
    output = options.output or f"map_{Path(options.problem).stem}.png"
    draws = options.output is not None or not poses
    if draws:
        require_output(output)
    problem, plan = read_problem(options), None
    if options.plan is not None:
        problem, plan, _ = load_plan(options, options.plan)
    if poses:
        radians = [(x, math.radians(angle)) for x, angle in poses]
        print(wholearm.format_route(wholearm.list_formations(problem, *radians)), end="")
    if draws:
        _save_map(problem, plan, output, phi, **list_given(options, "uniqueness_margin"))
        print(f"wrote {output}", file=sys.stderr if poses else sys.stdout)
    return 0


def _read_pair(text: str, key: str, allowed: str) -> tuple[float, float]:
    try:
        first, second = (require_number(float(part), key) for part in text.split(","))
    except ValueError:
        raise InputError("", key, f"{text.strip()!r} given; allowed is {allowed}") from None
    return first, second


def _check_step(options: argparse.Namespace, problem: wholearm.Problem) -> None:
    """InputError if the time step is out of the range of an engine."""
    step_range = Range(1e-6, 1e-1, lambda scene, _: scene.scales.time, "times the scene's time")
    if options.step is not None:
        step_range.check("--step", options.step, "s", problem.scene)


def _load_replayed(options: argparse.Namespace) -> LoadedPlan:
    """As `load_plan`, of a plan with the phases of the problem."""
    from ..results.adopt import require_same_phases

    loaded = problem, plan, _ = load_plan(options, options.plan)
    with name_source(options.plan):
        require_same_phases(problem, plan)
    return loaded


def _export(options: argparse.Namespace) -> int:
    require_output(options.mjcf, ".xml")
    problem, plan = read_problem(options), None
    _check_step(options, problem)
    if options.plan is not None:
        problem, plan, _ = _load_replayed(options)
    with name_source(options.problem):
        write_text(options.mjcf, wholearm.write_mjcf(problem, plan, step=options.step))
    return finish(options, None, options.mjcf)


def _replay(options: argparse.Namespace) -> int:
    from ..engines.engine_replay import ALLOWED, Setting, require_engine

    require_engine(options.engine)
    problem, plan, policy = _load_replayed(options)
    _check_step(options, problem)
    setting = Setting()._replace(**list_given(options, "softness"))
    if options.step is not None:
        setting = setting._replace(step=options.step / problem.scene.scales.time)
    arguments: dict[str, Any] = {"whole": options.whole, "setting": setting}
    arguments["progress"] = show_progress
    if policy is None:
        arguments |= {"allowed": options.departure, "halvings": options.refine}
        with name_source(options.problem):
            replays = wholearm.replay_in(options.engine, problem, plan, **arguments)
        return finish(options, replays)
    if options.refine:
        raise InputError("", "--refine", "is for plans by the clock, not with --policy")
    arguments["allowed"] = ALLOWED if options.departure is None else options.departure
    with name_source(options.policy):
        report = wholearm.play_policy(options.engine, problem, plan, policy, **arguments)
    return finish(options, report)


def _policy(options: argparse.Namespace) -> int:
    from ..planning.plan import plan_anew
    from ..policy.make import find_largest_factors
    from ..problem.read import read_stored_problem
    from ..verification.free import CONTACT_SPEEDS, find_policy

    output = options.output or f"{Path(options.plan).stem}_policy.npz"
    require_output(output, ".npz")
    plan = wholearm.load_trajectory(options.plan)
    problem = read_stored_problem(plan.meta, options.plan)
    planner = partial(plan_anew, progress=show_progress)
    names = "reserve", "period", "delay", "torque_limit", "contact_speed", "departure"
    values = list_given(options, *names) | {"planner": planner}

    def advise() -> str:
        """Advice: a faster loop, half the reserve, or a larger epsilon, whichever succeeds."""
        period, epsilon = min(2e-4, options.period), 2 * problem.epsilon
        default = 2.5 if problem.uncertainty is None else 1.0
        reserve = (default if options.reserve is None else options.reserve) / 2
        pressing = problem.with_({"epsilon": epsilon})
        trials: list[tuple[str, wholearm.Problem, dict[str, Any]]] = [
            (f"--period {period:g} --delay 0", problem, {"period": period, "delay": 0.0}),
            (f"--reserve {reserve:g}", problem, {"reserve": reserve}),
            (f"a plan with epsilon = {epsilon:g} N", pressing, {}),
        ]
        for words, scene, changes in trials:
            show_progress(f"trying {words}")
            with suppress(WholearmError):
                motion = plan if scene is problem else planner(scene)
                if find_policy(scene, motion, **(values | changes))[1].ok:
                    return f"{words} would do"
        speeds = () if "contact_speed" in values else CONTACT_SPEEDS[1:]
        texts = [f"--contact-speed {speed:g}" for speed in speeds]
        texts += [words for words, *_ in trials]
        return f"{', '.join(texts)} would not do either"

    with name_source(options.plan):
        show_progress("making and simulating the policy")
        policy, report = find_policy(problem, plan, **values)
        if options.largest:
            show_progress("looking for the widest ranges")
            factors = find_largest_factors(problem, plan, options.delay)
            policy.about["largest"] = {str(number): factor for number, factor in factors.items()}
    failures = "; ".join(report.failures)
    if not report.ok and options.write_anyway:
        # Mark of a failed policy in its file.
        policy.about["failures"] = list(report.failures)
        _complain(f"warning: {output}: written although in the free simulation, {failures}")
    elif not report.ok:
        gaps = [loss.gap for phase in report.phases for loss in phase.losses]
        hint = ""
        if len(gaps) == len(report.failures):
            # Openings alone: the largest one, rounded up to two digits.
            departure = f"{1.05 * max(gaps) / problem.scene.scales.length:.2g}"
            hint = f"--departure {departure} allows that; "
        raise ReplayError(
            f"{options.plan}: no policy is written: in the free simulation, {failures}; "
            f"{hint}{advise()}; --write-anyway writes it all the same"
        )
    if report.warnings:
        policy.about["warnings"] = list(report.warnings)
    policy.save(output)
    status = finish(options, policy)
    if not options.json:
        print(f"{policy.duration:.6f} s in all, the plan {plan.duration:.6f} s; wrote {output}")
    return status


def _sweep(options: argparse.Namespace) -> int:
    from ..design.sweep import read_vary, require_table
    from ..problem.read import read_problem

    vary = read_vary(options.vary, options.samples)
    names = (re.sub(r"\W+", "_", name).strip("_") for name in vary)
    output = options.output or f"{'_'.join([Path(options.problems[0]).stem, 'sweep', *names])}.csv"
    require_output(output, ".csv")
    if not options.fresh:
        require_table(output)
    require_output(options.figure)
    if options.figure is not None:
        from ..figures.result_figures import choose_axes

        choose_axes(vary, options.samples, len(options.problems))
    # Here `samples` are points, not rows of a trajectory.
    values = list_given(options, "seed", "time_limit", "fresh", *keys_of(wholearm.PlanOptions))
    result = wholearm.sweep(
        [read_problem(path) for path in options.problems],
        vary,
        **values,
        checks=tuple(filter(None, (getattr(options, "with") or "").split(","))),
        path=f"{os.path.splitext(output)[0]}.jsonl" if require_ending(output, ".csv") else None,
        start=choose_workers(options),
        progress=show_progress,
    )
    write_text(output, result.to_csv())
    save_figure(options.figure, "draw_sweep", result)
    return finish(options, result, output, options.figure)


def _sensitivities(options: argparse.Namespace) -> int:
    require_output(options.output)
    problem = wholearm.load(options.problem)
    plan_options = wholearm.PlanOptions(**list_given(options, *keys_of(wholearm.PlanOptions)))
    if options.plan is not None:
        problem, *_ = load_plan(options, options.plan)
        plan_options = wholearm.load_plan(options.plan).options
    result = wholearm.find_sensitivities(
        problem, plan_options, options.of, options.jobs, show_progress, not options.differences
    )
    save_figure(options.output, "draw_sensitivities", result)
    return finish(options, result, options.output)


def _design(options: argparse.Namespace) -> int:
    stems = number_same([Path(path).stem for path in options.problems])
    outputs = [f"{stem}_design.toml" for stem in stems]
    outputs[:1] = [options.output or outputs[0]]
    for path in outputs:
        require_output(path, ".toml")
    require_output(options.figure)
    names = "symmetric", "weights", "worst", "starts", "budget", "jobs"
    result = wholearm.design_hand(
        [wholearm.load(path) for path in options.problems],
        options.over,
        options.minimise,
        **list_given(options, *names, *keys_of(wholearm.PlanOptions)),
        progress=show_progress,
    )
    for plan, path in zip(result.plans, outputs, strict=True):
        wholearm.save(plan.problem, path)
    save_figure(options.figure, "draw_search", result)
    return finish(options, result, *outputs, options.figure)


def _gallery(options: argparse.Namespace) -> int:
    from ..viewer.report_page import write_gallery

    require_ending(options.output, ".md")
    failures = write_gallery(options.files, options.output, show_progress)
    finish(options, None, options.output)
    for text in failures:
        _complain(text)
    return 1 if failures else 0


def _animate(options: argparse.Namespace) -> int:
    from ..problem.read import read_stored_problem

    require_output(options.output, ".gif", ".mp4", ".html")
    trajectory = wholearm.load_trajectory(options.trajectory)
    with name_source(options.trajectory):
        problem = read_stored_problem(trajectory.meta)
        simulation = overlay(options.simulate, trajectory)
        ghost = None if simulation is None else simulation.trajectory
        if options.output.lower().endswith(".html"):
            from ..viewer.page import build_page, describe_motion, write_player

            motion = describe_motion(trajectory, problem, ghost) | {"speed": options.speed}
            write_text(options.output, build_page(problem.name, [write_player(motion)]))
        else:
            from ..viewer.movie import write_movie

            settings: Any = {"speed": options.speed, "progress": show_progress}
            write_movie(options.output, problem, trajectory, ghost, **settings)
    return finish(options, None, options.output)


def _report(options: argparse.Namespace) -> int:
    import tempfile

    from ..viewer.report_page import build_report

    stem = Path(options.problem).stem
    output = options.output or f"{stem}.html"
    require_output(output, ".html")
    problem = read_problem(options)
    with tempfile.TemporaryDirectory() as folder:
        paths = options.files or [os.path.join(folder, f"{stem}.npz")]
        if not options.files:
            wholearm.solve(problem, progress=show_progress).save(paths[0])
        text = Path(options.problem).read_text(encoding="utf-8")
        content = build_report(problem, paths, text, show_progress, options.sensitivities)
    write_text(output, content)
    return finish(options, None, output)


def _help(options: argparse.Namespace) -> int:
    if options.topic is not None:
        print(read_page(TOPICS[options.topic]), end="")
        return 0
    for topic, folder in TOPICS.items():
        print(f"{topic:16} {read_page(folder).splitlines()[0].removeprefix('# ')}")
    return 0


def read_page(folder: str) -> str:
    """The page of a folder, with topics in place of links to other pages."""
    from importlib import resources

    page = resources.files("wholearm").joinpath(*folder.split("/"), "README.md")

    def name(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        topics = [topic for topic, path in TOPICS.items() if target == f"{path}/README.md"]
        if not topics:
            return link[1]
        return f"{link[1]} (wholearm help {link[3] if link[3] in topics else topics[-1]})"

    text = page.read_text(encoding="utf-8")
    return re.sub(r"\[([^\]]+)\]\(([^)#]*)#?([^)]*)\)", name, text)


def _completion(options: argparse.Namespace) -> int:
    choice("bash", "zsh", "tcsh").read(options.shell, "SHELL")
    try:
        import shtab
    except ImportError:
        text = "is not installed; pip install 'wholearm[completion]' brings it"
        raise InputError("", "shtab", text) from None
    parser = build_parser()
    _complete_files(parser, shtab.FILE, shtab.DIRECTORY)
    print(shtab.complete(parser, options.shell))
    return 0


def _complete_files(parser: Parser, files: object, folders: object) -> None:
    """Set the completion of all arguments that are names of files or folders."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for subparser in action.choices.values():
                _complete_files(subparser, files, folders)
        elif action.metavar == "DIR":
            action.complete = folders  # type: ignore[attr-defined]
        elif action.metavar in ("FILE", "PLAN") or (action.dest in INPUTS and not action.type):
            action.complete = files  # type: ignore[attr-defined]


def _new(options: argparse.Namespace) -> int:
    import numpy as np

    from ..mapping.formation_list import write_template

    if Path(name := options.name.removesuffix(".toml")).name in ("", ".."):
        raise InputError("", "NAME", f"{options.name!r} given; needed is the name of a file")
    output, vertices = f"{name}.toml", None
    require_writable(output)
    if os.path.exists(output):
        raise InputError(output, "", "is there already; choose another name")
    size = list_given(options, "polygon", "size", "mass")
    if (text := options.vertices) is not None:
        for key in [key for key in size if key != "mass"]:
            raise InputError("", f"--{key}", f"{size[key]} given; --vertices has the corners")
        try:
            vertices = np.array([[float(x) for x in corner.split(",")] for corner in text.split()])
        except ValueError:
            fault = f"{text!r} given; needed are corners as x,y in m, as in '0,0 0.08,0 0.04,0.06'"
            raise InputError("", "--vertices", fault) from None
    with name_source("--vertices" if vertices is not None else ""):
        # A file name may have bytes that no text has.
        stem = os.fsencode(Path(output).stem).decode(errors="replace")
        content = write_template(stem, **size, vertices=vertices)
    write_text(output, content)
    path = f"./{output}" if output.startswith("-") else output
    print(f"wrote {output}; next: wholearm solve {shlex.quote(path)}")
    return 0


def _schema(options: argparse.Namespace) -> int:
    from ..problem.read import build_schema, write_page

    text = write_page() if options.table else json.dumps(build_schema(), indent=2) + "\n"
    if options.output is None:
        print(text, end="")
        return 0
    require_writable(options.output)
    write_text(options.output, text)
    return finish(options, None, options.output)


def load_study(name: str) -> Study:
    """The study with a name."""
    study: Study = import_module(f"wholearm.benchmark.{name}").STUDY
    return study


def _list_studies(options: argparse.Namespace) -> int:
    from ..benchmark import STUDIES

    for name, text in STUDIES.items():
        print(f"{name:{max(map(len, STUDIES))}}  {text}")
    return 0


def _run_study(study: Study, options: argparse.Namespace) -> int:
    from ..benchmark.study import run_study

    text, findings, written = run_study(study, options, show_progress)
    clear_progress()
    print(text, *(f"wrote {path}\n" for path in written), sep="", end="")
    return 1 if findings else 0
