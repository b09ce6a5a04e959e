"""Commands with their files and options, and the parser of them."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from ..common.errors import InputError
from ..common.fields import read_options
from ..mechanics.margin_key import MARGIN
from ..planning.options import PLANNER

TOPICS = {
    "python": "",
    "file-format": "problem",
    "model": "mechanics",
    "contacts": "contacts",
    "planning": "planning",
    "path-domain": "planning/path_domain",
    "time-domain": "planning/time_domain",
    "robust-plans": "planning/robust",
    "verification": "verification",
    "messages": "cli",
    "search": "search",
    "map": "mapping",
    "policy": "policy",
    "robustness": "robustness",
    "engines": "engines",
    "slow-motions": "quasistatic",
    "tuning": "tuning",
    "comparison": "comparison",
    "simulation": "simulation",
    "free-simulation": "simulation",
    "output-files": "results",
    "figures": "figures",
    "movies": "viewer",
    "studies": "benchmark",
}
"""Folder of the page of each topic."""

SIMULATORS = ("told", "free")  # what `--simulate` takes; the first one if it is left out
PROBLEM = "problem  problem file (TOML)\n"
PLAN = "plan  trajectory file (.npz)\n"
JSON = "--json  print the result as JSON\n"
SQUEEZE = """\
--squeeze  how hard quasistatic torques squeeze: 0 as little as needed, 1 as hard as helps
    = 0.5 in 0.0..1.0
"""
POLICY = """\
--policy FILE  torques by this policy (.npz), at its own period, instead of the plan's by the clock
"""
SENSOR = "--sensor  with --policy: measured normal forces are handed to it, exact ones\n"
SEARCH = """\
--cache DIR       folder to keep what is found out of the scene, for later searches for a goal
    (none); nobody else may write there
--jobs N          processes that a search for a [goal] uses (2, or 1 where there is one core)
    in 1..256
--time-limit S    longest time that this may take; a search then returns the best route so far
    (none) in 1e-3..1e9
"""

TABLE = f"""\
[[new]]  write_problem  write a problem file to begin with
name               the problem's name; NAME.toml is written
--polygon CORNERS  corners of the regular polygon, 3 to 50 = 7 in 3..50
--size             from its centre to its corners [m] = 0.05 in 1e-6..1e6
--vertices 'X,Y ...'  corners of the object instead, anticlockwise [m], as in '0,0 0.08,0
    0.08,0.03 0,0.09'
--mass             of the object [kg] (0.2 at a size of 0.05 m, growing with the area) in 1e-6..1e6
[[schema]]  show_schema  print the JSON Schema of problem files, for editors
-o --output FILE  file to write, instead of printing
--table           all keys with unit, default and range as tables (Markdown) instead
[[solve]]  solve  plan joint torques for a problem file
{PROBLEM}\
-o --output FILE        trajectory file to write (default: NAME.npz)
--torques FILE          also write the torques as CSV
--sample-rate HZ        write samples at this rate [Hz] instead, and say what becomes of the motion
    (none) in 1e-9..1e12
--interpolation NAME    of samples: linear, or hold for sample-and-hold (linear)
{PLANNER}{MARGIN}{SEARCH}{JSON}\
[[verify]]  verify  replay torques open loop and check the motion
{PROBLEM}\
torques           trajectory file (.npz) or torques (.csv: t,tau1,tau2)
--tolerance       of the simulator's steps, relative to the scene's scales = 1e-9 in 1e-14..1e-2
--departure       how far the replay may be from the plan, over the object's radius of gyration, and
    in rad (1e-3) in 1e-9..1e3
--rest-speed      speed that passes for rest, over the root of that radius times gravity (2e-2)
    in 1e-9..1e3
{MARGIN}\
--reduced         also list the paper's scalar equation of motion where a phase has four constraints
--free            simulate without telling which contacts hold: whole, and a plan's phases one by
    one too
--policy FILE     with --free: torques by this policy (.npz) instead of the plan's, from the start
    on
{SENSOR}\
--restitution     Poisson's coefficient of impacts, 0 to 1, with --free (0: plastic) in 0.0..1.0
-o --output FILE  trajectory file to write (.npz) of the replayed motion, for plot
{JSON}\
[[plot]]  plot  draw force margins, torques and snapshots
trajectory         trajectory file (.npz), or torques to replay (.csv)
--problem FILE     problem file (TOML) for torques
-o --output FILE   figure to write (.png, .pdf, .svg) (required)
--simulate [free]  overlay the simulated forces; free: simulated without telling which contacts hold
    among told|free
--width            of the figure [in], 3 to 40 (10) in 3.0..40
--motion           also draw the object's pose, and the joints' angles and speeds
[[predict]]  predict  see up to which speed slow motions keep every contact
{PROBLEM}\
-o --output FILE  figure to write (.png, .pdf, .svg) of the least normal force over speed
{SQUEEZE}\
--torques FILE    write the quasistatic torques as CSV, which hand tuning starts from
--speed V         mean speed along the phases for these [m/s], over which they are spread in time
    (0.05) in 1e-9..1e6
{JSON}\
[[tune]]  tune  tune torques from quasistatic ones by steps of 10 percent
{PROBLEM}\
-o --output FILE  torques to write (.csv)
--brake           let each phase have one more step of its torques, which stops it at its end
--stops N         with --brake: let a phase that fails stop up to N times on its way, 0 to 7
    = 0 in 0..7
{SQUEEZE}\
--share           raises beyond the first that reaches the end: 0 none, 1 all that keep contacts
    = 1 in 0.0..1.0
{JSON}\
[[compare]]  compare  put plans and torques for a problem side by side
{PROBLEM}\
files FILE ...    trajectory files (.npz) or torques (.csv) for that problem
-o --output FILE  figure to write (.png, .pdf, .svg) of the force margins of all
{JSON}\
[[route]]  route  find the contact formations that lead to a goal, and plan
problem           problem file (TOML) with [goal] in place of [[phases]]
-o --output FILE  figure to write (.png, .pdf, .svg) of the route over the map
--alternatives N  how many routes of other formations are listed beside the best one = 0 in 0..100
--objective NAME  of the plans: time, effort or margin; routes are looked for by time = time
{SEARCH}{JSON}\
[[map]]  draw_map  draw the contact formations over (x, phi)
{PROBLEM}\
-o --output FILE  figure to write (.png, .pdf, .svg; default: map_NAME.png)
--plan FILE       trajectory file (.npz) to draw over it
--phi LOW,HIGH    range of phi [deg] (default: the plan's)
--list X,PHI ...  print the formations along a route of two or more poses [m, deg] as [[phases]]
{MARGIN}\
[[export]]  export  write scene and plan for a physics engine
{PROBLEM}\
[plan]            trajectory file (.npz) that the model plays
--mjcf FILE       file to write (.xml): the scene in MuJoCo's format (required)
--step            time step of the model [s] (from the scene) in 1e-15..1e6
[[replay]]  replay  replay a plan in MuJoCo or Drake and compare it with the plan
{PROBLEM}{PLAN}\
--engine NAME     mujoco or drake, installed with the extra of that name (required)
--whole           from start to end, instead of phase by phase from each planned start
{POLICY}\
--step            longest time step [s] (from the scene) in 1e-15..1e6
--softness        softness of contacts, over the default, which is in proportion to the step (1)
    in 1e-6..1e6
--departure       how far a replay may be from the plan, over the object's radius of gyration, and
    in rad (3e-3 for mujoco, 1.5e-3 for drake; of a policy's end, 3e-2) in 1e-9..1e3
--refine N        also replay with steps of a half, a quarter, ... to N halvings = 0 in 0..6
{JSON}\
[[policy]]  policy  make torques a function of the joints, by feedback
{PLAN}\
-o --output FILE  policy to write (.npz; default: NAME_policy.npz)
--reserve         normal force that is kept in reserve along the way: where plan or problem have
    ranges of numbers, for so many times these (1); otherwise over what usual errors of masses,
    friction and torques take away (2.5); 0 is as fast as the plan in 0.0..1e3
--period          of the control loop [s] = 1e-3 in 1e-5..10
--delay           time from measuring to when torques take effect [s] = 5e-4 in 0.0..10
--torque-limit    of both fingers, if it is more than the plan was made with [N m] (default: the
    same) in 1e-12..1e12
--largest         also look for how many times as wide ranges a policy can keep contacts in
--departure       how far contacts may open in its simulation, over the object's radius of gyration
    (1e-3) in 1e-9..1e3
--write-anyway    write the policy although its simulation does not hold, marked so in its file
{JSON}\
[[robustness]]  robustness  see how much error a plan bears
{PROBLEM}{PLAN}\
--samples             samples to replay, a Latin hypercube of all ranges = 1000 in 1..1000000
--seed                of the samples = 0 in 0..9223372036854775808
--phase K             only this phase, from its planned start at rest (default: the whole plan)
    in 1..1000
{POLICY}{SENSOR}\
--vary NAME=WIDTH ...  half widths of ranges, instead of the problem's: mass, inertia (0.05),
    friction (0.1), gain of the torques (0.01), all relative; geometry, start_x [m] (6e-3 radii of
    gyration), delay (1e-3 s); 0 leaves a number as it is
--sample-rate HZ      of a sample-and-hold of the torques [Hz], 0 for torques as planned
    = 1000 in 0.0..1e6
--tolerance           of the simulations, relative to the scene's scales = 1e-6 in 1e-14..1e-2
--goal-distance M     how far from the plan's end the goal counts as reached [m] (0.03 radii of
    gyration) in 1e-9..1e6
--goal-angle DEG      and how far from its angle [degrees] = 1 in 1e-9..360
-o --output FILE      file to write results to, one by one (default: NAME_robustness.jsonl, with
    phase and policy in the name); a study that is there goes on where it was stopped
--fresh               begin the file anew, whatever it holds
--figure FILE         also draw the motion with its noisy copies (.png, .pdf, .svg)
--jobs                worker processes (default: all cores) in 1..256
--scheduler ADDRESS   run on the cluster of this Dask scheduler (extra: cluster)
{JSON}\
[[animate]]  animate  make a movie of a plan, or a page that plays it
trajectory         trajectory file (.npz)
-o --output FILE   what to write: .gif, .mp4 (needs ffmpeg), or .html, which plays in any browser
    (required)
--speed            speed over real time, 0.1 is ten times slower = 0.1 in 1e-6..1e3
--simulate [free]  draw the simulated motion behind; free: simulated without telling which contacts
    hold among told|free
[[report]]  report  put a problem and its plans into one page to open anywhere
{PROBLEM}\
[files PLAN ...]  trajectory files (.npz) or torques (.csv); none: plan the least time
-o --output FILE  page to write (default: NAME.html)
[[gallery]]  gallery  plan problems and show them all on one page
files PROBLEM ...  problem files (TOML)
-o --output FILE   page to write (.md); figures and movies go to a folder beside it
    = results/gallery.md
[[help]]  show_page  print a page of the documentation, or list its topics
[topic TOPIC]  what the page is about (left out: list the topics) among {"|".join(TOPICS)}
[[completion]]  complete  print what makes a shell complete all this
shell  bash, zsh or tcsh; needs the extra completion
"""
"""Commands but `bench`: name, function that carries it out, what it is for, and then its files and
options as of `read_options`."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ours, and which can be filled when it is first used.

    Pairs of numbers that begin with a minus are no options.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-\.?\d")
        self.fill: Callable[[], object] | None = None

    def complete(self) -> None:
        """Add what is left out until then."""
        fill, self.fill = self.fill, None
        if fill is not None:
            fill()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, with all options."""
        self.complete()
        return super().parse_known_args(args, namespace)

    def format_help(self) -> str:
        """The help, with all options."""
        self.complete()
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        text = message.removeprefix("argument ")
        raise InputError("", "", f"{text}; see {self.prog} --help")


def add_parser(parsers: Any, name: str, text: str, table: str = "") -> Parser:
    """Add the parser of a command or study that is for what the text says."""
    parser: Parser = parsers.add_parser(
        name, help=text, description=f"{text[0].upper()}{text[1:]}."
    )
    add_options(parser, table)
    return parser


def add_options(parser: argparse.ArgumentParser, table: str) -> None:
    """Give options and files of a table, as of `read_options`, to a parser."""
    for option in read_options(table) if table else ():
        option.add(parser)


def add_commands(parsers: Any, runs: dict[str, Any]) -> None:
    """Add the parsers of all commands of `TABLE`, which are carried out by functions by name."""
    for part in re.split(r"^(?=\[\[)", TABLE, flags=re.M)[1:]:
        head, _, table = part.partition("\n")
        name, run, text = re.split(r" {2,}", head)
        add_parser(parsers, name.strip("[]"), text, table).set_defaults(run=runs[run])


def prepare(given: Sequence[str]) -> list[str]:
    """Arguments as argparse takes them: `--simulate` with its simulator, `--list` without a sign.

    It would take a file for the simulator that is left out, and of several pairs one alone after
    an equals sign.
    """
    left, texts = [*given], list[str]()
    while left:
        text = left.pop(0)
        if text == "--simulate":
            text += f"={left.pop(0) if left and left[0] in SIMULATORS else SIMULATORS[0]}"
        texts += ["--list", text[7:]] if text.startswith("--list=") else [text]
    return texts
