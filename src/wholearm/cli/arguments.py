"""What each command takes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import NoReturn

from ..common.bounds import PLANNER, Bounds
from ..common.errors import InputError

SIMULATORS = ("told", "free")
"""What `plot --simulate` takes; the first one if it is left out."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ours."""

    def error(self, message: str) -> NoReturn:
        """Refuse the command line."""
        text = message.removeprefix("argument ")
        raise InputError("", "", f"{text}; see {self.prog} --help")


def number(low: float, high: float) -> Callable[[str], float]:
    """What reads an option that is a number from `low` to `high`, a whole one if `low` is."""
    return Bounds(low, high).read


JOBS = number(1, 256)
"""Processes."""
DEPARTURE = number(1e-9, 1e3)
"""How far a motion may be from another one, relative to the scene."""
TOLERANCE = number(1e-14, 1e-2)
"""Of simulators, relative to the scene."""
STEP = number(1e-15, 1e6)
"""Time step [s], which has a range of its own in each scene, too."""


def name_simulator(given: Sequence[str]) -> list[str]:
    """Give `--simulate` the simulator that it leaves out."""
    named: list[str] = []
    for text in given:
        if named[-1:] == ["--simulate"]:
            named[-1] += f"={text if text in SIMULATORS else SIMULATORS[0]}"
            if text in SIMULATORS:
                continue
        named.append(text)
    return [f"{text}={SIMULATORS[0]}" if text == "--simulate" else text for text in named]


def add_solve(parser: argparse.ArgumentParser) -> None:
    """Add what `solve` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    parser.add_argument("-o", "--output", help="trajectory file to write (default: NAME.npz)")
    parser.add_argument("--torques", metavar="FILE", help="also write the torques as CSV")
    text = "write samples at this rate [Hz] instead, and say what becomes of the motion (none)"
    parser.add_argument("--sample-rate", metavar="HZ", type=number(1e-9, 1e12), help=text)
    text = "of samples: linear, or hold for sample-and-hold (linear)"
    parser.add_argument("--interpolation", help=text)
    parser.add_argument("--objective", default="time", help="time, effort or margin (time)")
    text = "relative error of the objective below which refining ends (1e-4)"
    parser.add_argument("--accuracy", type=number(*PLANNER["accuracy"]), help=text)
    text = "intervals of each phase along a curve (as many as the accuracy needs)"
    parser.add_argument("--intervals", type=number(*PLANNER["intervals"]), help=text)
    text = "longest duration, for margin [s] (twice the least time)"
    parser.add_argument("--duration", type=number(*PLANNER["duration"]), help=text)
    text = "weight of time, for effort [(N m)^2] (1)"
    parser.add_argument("--time-weight", type=number(*PLANNER["time_weight"]), help=text)
    text = "rows per phase of the trajectory file (201)"
    parser.add_argument("--samples", type=number(*PLANNER["samples"]), help=text)
    text = "auto, or time for the time domain throughout (auto)"
    parser.add_argument("--transcription", help=text)
    text = "least acceleration of contacts that are let go, over gravity (0.01)"
    parser.add_argument("--opening", type=number(*PLANNER["opening"]), help=text)
    text = "least gap of contacts that were let go, over the radius of gyration (5e-4)"
    parser.add_argument("--clearance", type=number(*PLANNER["clearance"]), help=text)
    text = "intervals of a phase in the time domain (as many as the accuracy needs)"
    parser.add_argument("--time-intervals", type=number(*PLANNER["time_intervals"]), help=text)
    text = "collocation points of an interval there (3)"
    parser.add_argument("--degree", type=number(*PLANNER["degree"]), help=text)
    parser.add_argument("--scheme", help="radau or legendre points (radau)")
    text = "keep the contact modes of the first plan that is found"
    parser.add_argument("--no-mode-search", dest="mode_search", action="store_false", help=text)
    text = "return the plan without replaying it"
    parser.add_argument("--no-replay", dest="replay", action="store_false", help=text)
    text = "keep limits within the problem's ranges, [uncertainty], or FACTOR times these (0)"
    parser.add_argument(
        "--robust",
        metavar="FACTOR",
        nargs="?",
        type=number(*PLANNER["robust"]),
        const=1.0,
        help=text,
    )
    text = "also look for the largest factor with which there is a plan"
    parser.add_argument("--largest", action="store_true", help=text)
    text = "bound the least time along curves from below, and print the gap"
    parser.add_argument("--certify", action="store_true", help=text)
    _add_uniqueness_margin(parser)
    add_cache(parser)
    add_jobs(parser)
    add_time_limit(parser)
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add `--jobs` of a search for a goal."""
    text = "processes that a search for a [goal] uses (2, or 1 where there is one core)"
    parser.add_argument("--jobs", metavar="N", type=JOBS, help=text)


def add_time_limit(parser: argparse.ArgumentParser) -> None:
    """Add how long a search or planning may take."""
    text = "longest time that this may take; a search then returns the best route so far (none)"
    parser.add_argument("--time-limit", metavar="S", type=number(1e-3, 1e9), help=text)


def add_cache(parser: argparse.ArgumentParser) -> None:
    """Add where searches for a goal keep what they find."""
    text = "folder to keep what is found out of the scene, for later searches for a goal (none); "
    text += "nobody else may write there"
    parser.add_argument("--cache", metavar="DIR", help=text)


def add_verify(parser: argparse.ArgumentParser) -> None:
    """Add what `verify` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    parser.add_argument("torques", help="trajectory file (.npz) or torques (.csv: t,tau1,tau2)")
    parser.add_argument(
        "--tolerance",
        type=TOLERANCE,
        default=1e-9,
        help="of the simulator's steps, relative to the scene's scales (1e-9)",
    )
    text = (
        "how far the replay may be from the plan, over the object's radius of gyration, and in rad"
    )
    parser.add_argument("--departure", type=DEPARTURE, help=f"{text} (1e-3)")
    text = "speed that passes for rest, over the root of that radius times gravity"
    parser.add_argument("--rest-speed", type=DEPARTURE, help=f"{text} (2e-2)")
    _add_uniqueness_margin(parser)
    text = "also list the paper's scalar equation of motion where a phase has four constraints"
    parser.add_argument("--reduced", action="store_true", help=text)
    text = "simulate without telling which contacts hold: whole, and a plan's phases one by one too"
    parser.add_argument("--free", action="store_true", help=text)
    text = "with --free: torques by this policy (.npz) instead of the plan's, from the start on"
    parser.add_argument("--policy", metavar="FILE", help=text)
    text = "with --policy: measured normal forces are handed to it, exact ones"
    parser.add_argument("--sensor", action="store_true", help=text)
    text = "Poisson's coefficient of impacts, 0 to 1, with --free (0: plastic)"
    parser.add_argument("--restitution", type=number(0.0, 1.0), help=text)
    text = "trajectory file to write (.npz) of the replayed motion, for plot"
    parser.add_argument("-o", "--output", metavar="FILE", help=text)
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def _add_uniqueness_margin(parser: argparse.ArgumentParser) -> None:
    text = "least uniqueness margin of contact forces: principal minors of the contact matrix "
    text += "over those without friction, 1 without friction, 0 ambiguous (0.1)"
    parser.add_argument("--uniqueness-margin", type=number(-1e3, 0.999), help=text)


def add_plot(parser: argparse.ArgumentParser) -> None:
    """Add what `plot` takes."""
    text = "trajectory file (.npz), or torques to replay (.csv)"
    parser.add_argument("trajectory", help=text)
    parser.add_argument("--problem", metavar="FILE", help="problem file (TOML) for torques")
    parser.add_argument("-o", "--output", required=True, help="figure to write (.png, .pdf, .svg)")
    text = "overlay the simulated forces; free: simulated without telling which contacts hold"
    parser.add_argument("--simulate", choices=SIMULATORS, metavar="[free]", help=text)
    parser.add_argument("--width", type=number(3.0, 40.0), help="of the figure [in], 3 to 40 (10)")
    text = "also draw the object's pose, and the joints' angles and speeds"
    parser.add_argument("--motion", action="store_true", help=text)


def add_predict(parser: argparse.ArgumentParser) -> None:
    """Add what `predict` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    text = "figure to write (.png, .pdf, .svg) of the least normal force over speed"
    parser.add_argument("-o", "--output", metavar="FILE", help=text)
    text = "how hard quasistatic torques squeeze: 0 as little as needed, 1 as hard as helps (0.5)"
    parser.add_argument("--squeeze", type=number(0.0, 1.0), default=0.5, help=text)
    text = "write the quasistatic torques as CSV, which hand tuning starts from"
    parser.add_argument("--torques", metavar="FILE", help=text)
    text = "mean speed along the phases for these [m/s], over which they are spread in time (0.05)"
    parser.add_argument("--speed", metavar="V", type=number(1e-9, 1e6), help=text)
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def add_tune(parser: argparse.ArgumentParser) -> None:
    """Add what `tune` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    parser.add_argument("-o", "--output", metavar="FILE", help="torques to write (.csv)")
    text = "let each phase have one more step of its torques, which stops it at its end"
    parser.add_argument("--brake", action="store_true", help=text)
    text = "with --brake: let a phase that fails stop up to N times on its way, 0 to 7 (0)"
    parser.add_argument("--stops", metavar="N", type=number(0, 7), default=0, help=text)
    text = "how hard quasistatic torques squeeze: 0 as little as needed, 1 as hard as helps (0.5)"
    parser.add_argument("--squeeze", type=number(0.0, 1.0), default=0.5, help=text)
    text = "raises beyond the first that reaches the end: 0 none, 1 all that keep contacts (1)"
    parser.add_argument("--share", type=number(0.0, 1.0), default=1.0, help=text)
    parser.add_argument("--json", action="store_true", help="print every trial as JSON")


def add_compare(parser: argparse.ArgumentParser) -> None:
    """Add what `compare` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    text = "trajectory files (.npz) or torques (.csv) for that problem"
    parser.add_argument("files", nargs="+", metavar="FILE", help=text)
    text = "figure to write (.png, .pdf, .svg) of the force margins of all"
    parser.add_argument("-o", "--output", metavar="FILE", help=text)
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def add_map(parser: argparse.ArgumentParser) -> None:
    """Add what `map` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    parser.add_argument(
        "-o", "--output", help="figure to write (.png, .pdf, .svg; default: map_NAME.png)"
    )
    parser.add_argument("--plan", metavar="FILE", help="trajectory file (.npz) to draw over it")
    parser.add_argument(
        "--phi", metavar="LOW,HIGH", help="range of phi [deg] (default: the plan's)"
    )
    text = "print the formations along a route of two or more poses [m, deg] as [[phases]]"
    parser.add_argument("--list", metavar="X,PHI", nargs="+", help=text)
    _add_uniqueness_margin(parser)
