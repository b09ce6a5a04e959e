"""Tables of a study of run time against error."""

from __future__ import annotations

import math
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..report import stamp
from .planning import IMPLICIT, LEAST_TIME, NO_DRAG, PLANNERS
from .runs import (
    BUDGET,
    LIMIT,
    REPEATS,
    SHIFT,
    SHORT,
    SOLVED,
    Key,
    Median,
    Run,
    find_mean,
    find_medians,
)
from .simulation import DRIFT, FEW, MANY
from .simulators import SIMULATORS


class Comparison(NamedTuple):
    """What one table compares.

    Attributes
    ----------
    study, title : str
    ours : str
        Method that others are compared with.
    targets : tuple of float
        Errors that run times are compared at.
    building : bool
        Whether the time to build counts.
    errors : int or None
        How many of the errors have to be below a target; None for all.
    """

    study: str
    title: str
    ours: str
    targets: tuple[float, ...]
    building: bool
    errors: int | None


_TIMES, _ALL = "by the error of the phase time", "by all three errors"
COMPARISONS = (
    Comparison(FEW, FEW, "wholearm", (1e-6, 1e-9, 1e-11), False, None),
    Comparison(MANY, MANY, "wholearm", (1e-6, 1e-9, 1e-11), False, None),
    Comparison(
        LEAST_TIME, f"{LEAST_TIME}, {_TIMES}", "wholearm, curve", (1e-2, 1e-3, 1e-4), True, 1
    ),
    Comparison(
        LEAST_TIME, f"{LEAST_TIME}, {_ALL}", "wholearm, curve", (1e-2, 1e-3, 1e-4), True, None
    ),
    Comparison(NO_DRAG, f"{NO_DRAG}, {_TIMES}", "wholearm, curve", (1e-2, 1e-3, 1e-4), True, 1),
    Comparison(NO_DRAG, f"{NO_DRAG}, {_ALL}", "wholearm, curve", (1e-2, 1e-3, 1e-4), True, None),
)
"""Tables of times at equal error."""
DISTRIBUTIONS = {"scipy": "", "rockit-meco": "rockit", "toppra": "toppra", "yapss": "yapss"}
"""Distributions whose versions are stated, and the methods that need them."""
INSTALL = "pip install 'wholearm[bench]'"
"""What installs them."""

Medians = dict[Key, Median]


def format_report(runs: Sequence[Run], limit: float = LIMIT) -> str:
    """All tables as Markdown."""
    medians = find_medians(runs)
    lines = ["# Run time against error, with peers", "", stamp(), ""]
    lines += [f"{_name_processor()}; {'; '.join(_list_versions())}.", ""]
    lines += [
        f"Times are medians of processor time over up to {REPEATS} runs (one where that takes over "
        f"{BUDGET:g} s) in one thread; what takes less than {SHORT:g} s is averaged over that "
        f"time. Means are geometric ones, shifted by {1e3 * SHIFT:g} ms, over the phases of all "
        "problems, each with the setting that reaches the error soonest; what does not reach it "
        f"counts with the time limit, {limit:g} s.",
        "",
        "Phases whose slow motion would lose a contact have no few pieces of torque, and where a "
        "method was not run on a phase, ours does not count there either.",
        "",
        "Errors of states are relative to the scene's length and time. A plan counts as solved if "
        "its torques, replayed open loop by other equations than its own, keep every contact and "
        "end within 1e-2 of the end. Its three errors are those of the phase time, against the "
        "lower bound of `solve --certify`, of the replayed end state, and the worst violation "
        "between nodes, over the object's weight or the torque limit.",
        "",
    ]
    for comparison in COMPARISONS:
        lines += _format_targets(medians, comparison, limit)
    for study in (LEAST_TIME, NO_DRAG):
        lines += _format_settings(medians, study)
    lines += _format_starts(medians)
    lines += _format_drift(medians)
    lines += ["## Settings", "", "| method | settings |", "|---|---|"]
    lines += [f"| {name} | {own.settings} |" for name, own in (SIMULATORS | PLANNERS).items()]
    return "\n".join([*lines, ""])


def find_times(medians: Medians, method: str, own: Comparison, target: float) -> dict[str, float]:
    """Times in which a method reaches an error on each phase that it has runs on [s].

    Infinite where it does not.
    """
    found: dict[str, float] = {}
    for (study, name, which, _), median in medians.items():
        if (study, which) == (own.study, method):
            took = median.solve + own.building * median.build
            reached = took if median.reaches(target, own.errors) else math.inf
            found[name] = min(found.get(name, math.inf), reached)
    return found


def list_methods(medians: Medians, study: str) -> list[str]:
    """Methods that a study has runs of, in their order."""
    given = {key[2] for key in medians if key[0] == study}
    return [name for name in SIMULATORS | PLANNERS if name in given]


def _format_targets(medians: Medians, own: Comparison, limit: float) -> list[str]:
    """Times to reach errors, and how many times as long as ours that is."""
    methods = list_methods(medians, own.study)
    if own.ours not in methods:
        return []
    lines = [f"## {own.title[0].upper()}{own.title[1:]}", ""]
    heads = [f"{target:g} [s] | reached | times ours" for target in own.targets]
    lines += [f"| method | {' | '.join(heads)} |", "|---|" + "---:|---:|---:|" * len(heads)]
    for method in methods:
        cells = [method]
        for target in own.targets:
            times, ours = (find_times(medians, m, own, target) for m in (method, own.ours))
            names = times.keys() & ours.keys()
            reached = sum(math.isfinite(times[name]) for name in names)
            mean, least = (
                find_mean([min(part[name], limit) for name in names] or [math.nan])
                for part in (times, ours)
            )
            shown = (f"{mean:.4f}", f"{mean / least:.2g}") if reached else ("-", "-")
            cells += [shown[0], f"{reached} of {len(names)}", shown[1]]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def group_settings(medians: Medians, study: str, method: str) -> dict[str, list[Median]]:
    """Medians of a method on all phases of a study, by setting."""
    found: dict[str, list[Median]] = {}
    for key, median in medians.items():
        if (key[0], key[2]) == (study, method):
            found.setdefault(key[3], []).append(median)
    return found


def _format_settings(medians: Medians, study: str) -> list[str]:
    """What each setting of each planner gives: medians of errors, means of times."""
    methods = list_methods(medians, study)
    if not methods:
        return []
    lines = [f"## {study[0].upper()}{study[1:]}: medians over phases of each setting", ""]
    lines += ["| method | setting | solved | phase time | end state | violation | building [s] |"]
    lines[-1] += " solving [s] | what failed |"
    lines += ["|---|---:|---:|---:|---:|---:|---:|---:|---|"]
    for method in methods:
        for setting, group in group_settings(medians, study, method).items():
            errors = [np.abs(own.errors) for own in group if len(own.errors) == 3]
            middle = np.median(errors, axis=0) if errors else np.full(3, np.nan)
            shown = " | ".join(f"{value:.1e}" for value in middle)
            failed = dict.fromkeys(own.outcome for own in group if own.outcome != SOLVED)
            solved = sum(own.outcome == SOLVED for own in group)
            built, took = (
                find_mean([t for t in part if math.isfinite(t)] or [math.nan])
                for part in ([own.build for own in group], [own.solve for own in group])
            )
            cells = f"{solved} of {len(group)} | {shown} | {built:.4f} | {took:.4f}"
            lines.append(f"| {method} | {setting} | {cells} | {'; '.join(failed)} |")
    return [*lines, ""]


def _format_starts(medians: Medians) -> list[str]:
    """What came of the random starts."""
    own = [median for key, median in medians.items() if key[0] == IMPLICIT]
    if not own:
        return []
    found = [median for median in own if len(median.errors) == 3]
    solved = [median for median in own if median.outcome == SOLVED]
    errors = sorted(median.errors[0] for median in found)
    seconds = [median.build + median.solve for median in own if math.isfinite(median.build)]
    text = f"{len(own)} random starts: Ipopt found a solution from {len(found)}, and of these "
    text += f"{len(solved)} hold in their replay. All starts took {sum(seconds):.0f} s."
    if errors:
        text += f" Errors of the phase time range from {errors[0]:.1e} to {errors[-1]:.1e}; "
        text += f"those of the replayed end from {min(m.errors[1] for m in found):.1e} on."
    return [f"## {IMPLICIT[0].upper()}{IMPLICIT[1:]}", "", text, ""]


def _format_drift(medians: Medians) -> list[str]:
    """The long swing: time, error of the state, drift of gaps and energy."""
    own = {key: median for key, median in medians.items() if key[0] == DRIFT}
    if not own:
        return []
    lines = [f"## {DRIFT[0].upper()}{DRIFT[1:]}", ""]
    lines += ["| method | tolerance | seconds | error of the state | gaps | energy | outcome |"]
    lines += ["|---|---:|---:|---:|---:|---:|---|"]
    for (_, _, method, setting), median in own.items():
        errors = " | ".join(f"{value:.1e}" for value in (*median.errors, *3 * (math.nan,))[:3])
        cells = f"{method} | {setting} | {median.solve:.4f} | {errors} | {median.outcome}"
        lines.append(f"| {cells} |")
    return [*lines, ""]


def _name_processor() -> str:
    """Name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _list_versions() -> list[str]:
    """Versions of the peers that are installed, and what installs the others."""
    found = []
    for name, method in DISTRIBUTIONS.items():
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{method or name} is skipped: {INSTALL}")
    return found
