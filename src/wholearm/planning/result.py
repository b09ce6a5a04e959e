"""The result of planning: a plan with its problem, options, statistics and replay."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from functools import reduce
from operator import add
from typing import Any, NamedTuple, get_type_hints

from numpy.typing import ArrayLike

from ..common.document import Document, Drawn, Result, Table, fixed, restore, to_plain
from ..common.errors import InputError, name_source
from ..problem.definition import PARAMETERS, Problem
from ..problem.read import read_stored_problem
from ..results.dwell_record import Settling
from ..results.planned_motion import PlannedMotion
from ..results.report import Certificate, RangeFigures, ReplayFigures, Transition, UniquenessMargin
from ..results.trajectory import ModeSpan, Samples, Trajectory, load_trajectory
from .nlp import SolverStatistics
from .options import Objective, PlanOptions
from .phase_plan import combine

UNITS = {Objective.TIME: "s", Objective.EFFORT: "(N m)^2 s", Objective.MARGIN: "N"}
"""Units of the objectives."""
_KEYS = {
    "value": "phase_values", "duration": "phase_durations", "attempt": "attempts",
    "error": "phase_errors", "uniqueness_margin": "uniqueness_margins",
    "build_time": "build_times", "solve_time": "solve_times",
}  # fmt: skip
"""Keys in `meta` of fields of phases and of their statistics; other fields keep their name."""
_OPTIONS = [o.name for o in fields(PlanOptions) if o.name not in ("objective", "replay", "ranges")]
"""Options with a key of their own in `meta`."""
_PARTS = ("versions", "transitions", "replay", "certificate", "timings", "ranges")
"""Fields of a plan that have the same name in `meta`."""


class Status(Enum):
    """How planning has ended."""

    SOLVED = "solved"
    BEST = "solved, best of several sequences of contact modes"
    STOPPED = "stopped early, with the best so far"
    """The mode search has reached its number of sequences before it was complete, or no larger
    margin was found than that of a plan of least time."""

    @staticmethod
    def of(phases: tuple[PlannedPhase, ...]) -> Status:
        """The status of a plan of these phases."""
        if not all(phase.complete for phase in phases):
            return Status.STOPPED
        return Status.BEST if any(phase.sequences > 1 for phase in phases) else Status.SOLVED


class PlannedPhase(NamedTuple):
    """One phase of a plan; files of earlier versions may lack fields with a default."""

    number: int  # from 1
    statistics: SolverStatistics  # of all solves for this phase, or for a block from this one on
    value: float = 0.0  # its part of the objective: s, (N m)^2 s or N
    duration: float = 0.0  # [s]
    rolling: tuple[str, ...] = ()  # contacts that the problem lets roll
    modes: tuple[ModeSpan, ...] = ()  # contact modes in the time domain; none along a curve
    sequences: int = 0  # of modes that were solved; of phases in one NLP booked to the first
    complete: bool = True  # whether all neighbouring sequences of modes were solved
    attempt: str = ""  # name of its initial guess, in the time domain
    error: float = math.nan  # estimated relative error of the value, of all phases in its NLP
    uniqueness_margin: UniquenessMargin | None = None  # of its contact forces
    # [s]: time for which friction may hold everything at rest; None if it starts in motion
    wedged: float | None = None
    settling: Settling | None = None  # dwell at its end, included in `duration`
    unheld: float | None = None  # `value` with free torques, if they are held over periods


_PHASES = PlannedPhase._fields[2:]
_STATISTICS = [statistic.name for statistic in fields(SolverStatistics)]


class Timings(NamedTuple):
    """Times of planning [s]."""

    # trace, plan, replay, assess: tracing curves; all up to the first plan; its replay and the
    # replanning of blocks (in `plan` if a search has replayed it); savings by impacts
    trace: float = 0.0
    build: float = 0.0  # build, solve: building and solving NLPs, within these
    solve: float = 0.0
    plan: float = 0.0
    replay: float = 0.0
    assess: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Drawn, Result):
    """A planned motion with its problem, options, statistics and verification."""

    problem: Problem
    options: PlanOptions
    status: Status
    value: float  # of the objective, in `unit`
    # the motion; its `meta` has the plan in plain values, for files
    trajectory: Trajectory = field(repr=False)
    phases: tuple[PlannedPhase, ...]
    transitions: tuple[Transition, ...] = ()  # impacts that the problem asks for
    replay: ReplayFigures | None = None  # none if the plan was not replayed
    timings: Timings = field(default_factory=Timings)
    versions: Mapping[str, str] = field(default_factory=dict)  # of the packages used
    certificate: Certificate | None = None  # lower bounds of the durations, with `certify`
    ranges: RangeFigures | None = None  # cost of the ranges, for a robust plan

    @property
    def headline(self) -> str:
        """Name, value and status, in a line."""
        value = f"{self.options.goal.value} = {self.value:.6g} {self.unit}"
        return f"{self.problem.name!r}, {value}, {self.status.value}"

    @property
    def unit(self) -> str:
        """Unit of the objective."""
        return UNITS[self.options.goal]

    @property
    def error(self) -> float:
        """Estimated relative distance of the value from a local optimum; NaN if unknown.

        It is the gain of finer grids in these contact modes, not that of other modes.
        """
        if self.options.goal is Objective.MARGIN:
            return min(self.phases, key=lambda phase: phase.value).error
        values = [abs(phase.value) for phase in self.phases]
        shares = zip(values, self.phases, strict=True)
        return sum(value * phase.error for value, phase in shares) / sum(values)

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return self.trajectory.duration

    @property
    def statistics(self) -> SolverStatistics:
        """Total cost of solving."""
        return reduce(add, (phase.statistics for phase in self.phases))

    @property
    def meta(self) -> Mapping[str, Any]:
        """The plan in plain values, as its file has them."""
        return self.trajectory.meta

    @property
    def values(self) -> Mapping[str, Any]:
        """The same, for JSON."""
        return self.meta

    @property
    def document(self) -> Document:
        """Report of phases, replay, value and its error."""
        return describe_plan(self)

    def at(self, t: ArrayLike) -> Samples:
        """The motion at some times [s]; see `Trajectory.at`."""
        return self.trajectory.at(t)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to a ``.npz`` file, which `load_plan` reads; see `Trajectory.save`."""
        self.trajectory.save(path)

    def save_torques(self, path: str | os.PathLike[str]) -> None:
        """Write the torques as CSV; see `Trajectory.save_torques`."""
        self.trajectory.save_torques(path)


def write_meta(plan: Plan) -> dict[str, Any]:
    """The plan but its motion in plain values."""
    phases, options = plan.phases, plan.options
    of_phases = {name: [getattr(phase, name) for phase in phases] for name in _PHASES}
    costs = {name: [getattr(each.statistics, name) for each in phases] for name in _STATISTICS}
    values: dict[str, Any] = to_plain(
        {
            "status": plan.status,
            "name": plan.problem.name,
            "objective": options.goal,
            "value": plan.value,
            "value_unit": plan.unit,
            "error": plan.error,
            "epsilon": plan.problem.epsilon,
            **{_KEYS.get(name, name): each for name, each in (of_phases | costs).items()},
            **{name: getattr(options, name) for name in _OPTIONS},
            **{name: getattr(plan, name) for name in _PARTS},
        }
    )
    return values | {"problem": plan.problem.table}


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Read the plan of a trajectory file; values that older files lack have defaults.

    Raises
    ------
    InputError  if the file cannot be read, or is no plan: a replay, or one without its problem
    """
    trajectory = load_trajectory(path)
    source = str(path)
    problem = read_stored_problem(trajectory.meta, source)
    try:
        with name_source(source, "meta."):
            return _read(trajectory, problem)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        missing = " is missing" if isinstance(error, KeyError) else ""
        what = f"does not describe a plan: {error}{missing}"
        raise InputError(source, "meta", what) from None


def _read(trajectory: Trajectory, problem: Problem) -> Plan:
    meta = trajectory.meta
    count = len(trajectory.motions)
    arguments = {name: meta[name] for name in _OPTIONS if name in meta}
    options = PlanOptions(meta["objective"], **arguments, replay=meta.get("replay") is not None)
    options = options.scale_ranges(problem.ranges)

    named = {name: meta.get(_KEYS.get(name, name)) for name in (*_PHASES, *_STATISTICS)}
    stored = {name: values for name, values in named.items() if values is not None}
    for name, values in stored.items():
        if len(values) != count:
            key = _KEYS.get(name, name)
            raise InputError("", key, f"{len(values)} values given, {count} needed")

    def pick(names: Sequence[str], k: int) -> dict[str, Any]:
        return {name: values[k] for name, values in stored.items() if name in names}

    entries = [pick(_PHASES, k) | {"statistics": pick(_STATISTICS, k)} for k in range(count)]
    numbered = [{"number": number, **entry} for number, entry in enumerate(entries, start=1)]
    phases = restore(tuple[PlannedPhase, ...], numbered)
    kinds, stored = get_type_hints(Plan), {name: meta[name] for name in _PARTS if name in meta}
    if replay := meta.get("replay"):
        # In earlier versions intervals were doubled for a replay to hold.
        stored["replay"] = {key: value for key, value in replay.items() if key != "refinements"}
    modes = (phase.modes for phase in phases)
    triples = zip(trajectory.motions, problem.phases, modes, strict=True)
    trajectory = replace(trajectory, motions=tuple(PlannedMotion.of(*each) for each in triples))
    status, value = Status(meta["status"]), float(meta["value"])
    parts = {name: restore(kinds[name], part) for name, part in stored.items()}
    return Plan(problem, options, status, value, trajectory, phases, **parts)


def describe_plan(plan: Plan, output: str = "", table: Mapping[str, Any] | None = None) -> Document:
    """Report of a plan, its trajectory file `output`, and the figures of its torque `table`."""
    figure = f"{plan.value:.6f}" if abs(plan.value) >= 1e-2 else f"{plan.value:.6g}"
    value = f"{plan.status.value}: {plan.options.goal.value} = {figure} {plan.unit}"
    if not math.isnan(plan.error):
        # Compared as printed, with one digit.
        error = f"{max(plan.error, 1e-9):.0e}"  # limits hold to about 1e-9
        exceeded = float(error) > plan.options.accuracy
        text = f"; accuracy {plan.options.accuracy:g} not reached" if exceeded else ""
        value += f" (to {error}{text})"
    suffix = f"; wrote {output}" if output else ""
    transitions = {
        "phase": "after phase:d", "velocity_ratio": "velocity ratio:.6f",
        "least_impulse": "least impulse [N s per m/s]:.6g", "least_impulse_contact": "of",
        "speed": "speed [m/s]:.7g", "saves": f"saves [{plan.unit}]:.6g", "stop": "",
    }  # fmt: skip
    parts = [
        _list_phases(plan),
        _list_modes(plan),
        Table.of(plan.transitions, transitions),
        *_list_settlings(plan),
        *_describe_held(plan),
        _describe_replay(plan),
        _list_bounds(plan),
        *_describe_ranges(plan),
        *(() if table is None else _list_table(table)),
        _describe_uniqueness(plan),
        f"{value}, {plan.duration:.6f} s in all{suffix}",
    ]
    return Document("", parts=parts)


def _list_phases(plan: Plan) -> Table:
    forces = fixed(plan.problem.epsilon or 0.05, 5)
    torques = fixed(float(plan.problem.scene.torque_limit.max()), 7)
    rows = []
    least, most = plan.trajectory.least_forces, plan.trajectory.largest_torques
    for phase, (c_n, _), torque in zip(plan.phases, least, most, strict=True):
        rows.append((phase.number, phase.duration, c_n, torque))
    heads = ["phase:d", "duration [s]:.6f", f"least c_n [N]:{forces}"]
    return Table([*heads, f"largest |tau| [N m]:{torques}"], rows)


def _list_modes(plan: Plan) -> Table:
    """Contact modes of the phases that were planned in the time domain."""
    words = {"+": " slides +", "-": " slides -", "rolls": " rolls"}
    rows = []
    for phase in plan.phases:
        for mode in phase.modes:
            contacts = ", ".join(name + words[how] for name, how in mode.contacts.items())
            text = f"{contacts}; joints turn {' '.join(mode.joints)}"
            if phase.sequences > 1 and mode is phase.modes[-1]:
                text += f"; best of {phase.sequences} sequences of modes"
            rows.append((phase.number, mode.start, mode.stop, text))
    heads = ["phase:d", "from [s]:.4f", "to [s]:.4f", "contact modes"]
    return Table(heads, rows, "modes, from the start of each phase")


def _list_settlings(plan: Plan) -> Iterator[str | Table]:
    """The dwells of phases, and their duration."""
    dwells = [phase.settling for phase in plan.phases if phase.settling is not None]
    if not dwells:
        return
    rows = []
    for dwell in dwells:
        closing = (dwell.gap, dwell.closes, dwell.left, dwell.speed, ", ".join(dwell.parts) or "-")
        row = (dwell.phase, dwell.duration, dwell.tau, dwell.contact or "-")
        rows.append(row + (closing if dwell.contact else ("",) * 5))
    heads = ["phase:d", "held [ms]:.3g", "tau [N m]:8.4f", "closes", "from [mm]:.3g"]
    heads += ["in [ms]:.3g", "left [mm]:.2g", "at [mm/s]:.3g", "parts for a moment"]
    yield Table(heads, rows)
    yield from (f"warning: {dwell.warning}" for dwell in dwells if dwell.warning)
    held, share = (sum(getattr(dwell, key) for dwell in dwells) for key in ("duration", "share"))
    text, time = f"held for {held:.6g} s in all", held / share if share else plan.duration - held
    extra = plan.duration - held - time
    changes = f"; torque changes before and after dwells take {extra:.6g} s more"
    yield f"{text}, {share:.1%} of the motion's {time:.6f} s{changes * (extra > 1e-9 * time)}"


def _describe_held(plan: Plan) -> Iterator[str]:
    """Relative cost of torques held over control periods."""
    scene = plan.problem.scene
    free = [phase.unheld for phase in plan.phases if phase.unheld is not None]
    if len(free) == len(plan.phases):
        value = combine(plan.options.goal, free)
        text = f"torques {scene.control_hold} over {1e3 * scene.control_period:g} ms each:"
        cost = f"{plan.value / value - 1:+.2%} of the {plan.options.goal.value}"
        yield f"{text} {cost} with free ones, {value:.6f} {plan.unit}"


def _describe_replay(plan: Plan) -> str:
    """Least normal force and final errors of the replay."""
    replay, epsilon = plan.replay, plan.problem.epsilon
    if replay is None:
        return "the plan was not replayed"
    ends = [phase.end_deviation for phase in replay.phases if phase.end_deviation]
    least = replay.least_c_n
    short = epsilon - least.value
    note = f", {short:.1e} N below epsilon between samples" if short > 1e-6 * least.value else ""
    return (
        f"replayed: least c_n {least.value:{fixed(epsilon or 0.05, 5)}} N on "
        f"{least.contact}{note}, off by at most "
        f"{max((end.m for end in ends), default=0.0):.1e} m and "
        f"{max((end.rad for end in ends), default=0.0):.1e} rad at the ends of phases"
    )


def _list_bounds(plan: Plan) -> Table:
    """Lower bounds of the durations, and their sum."""
    rows, certificate = list[tuple[Any, ...]](), plan.certificate
    for part in certificate.parts if certificate else ():
        ends = dict.fromkeys((part.phases[0], part.phases[-1]))
        figures = part.bound, part.error, part.gap
        text = f"not certified: {part.reason}" if part.bound is None else ""
        rows.append(("-".join(map(str, ends)), part.duration, *figures, text))
    if certificate and (total := certificate.total):
        text = "of those with a bound" if any(row[-1] for row in rows) else ""
        rows.append(("all", total.duration, total.bound, total.error, total.gap, text))
    heads = ["phases:d", "planned [s]:.8f", "at least [s]:.8f", "error [s]:.1e", "gap:.1e"]
    return Table([*heads, "lower bounds of the least time"], rows)


def _describe_ranges(plan: Plan) -> Iterator[str]:
    """Relative cost of ranges, and the largest feasible ones."""
    ranges = plan.ranges
    if ranges is None:
        return
    units = {parameter.name: parameter.unit for parameter in PARAMETERS}
    radii = [
        f"{name} {1e3 * radius:g} mm" if units[name] == "m" else f"{name} {100 * radius:g} %"
        for name, radius in ranges.radii.items()
        if radius and units[name] != "s"
    ]
    yield f"within ranges of {', '.join(radii)}"
    cost = f"{100 * (plan.value / ranges.nominal - 1):+.1f} % of the {plan.options.goal.value}"
    yield f"{cost} without ranges, {ranges.nominal:.6f} {plan.unit}"
    if ranges.held:
        numbers = " and ".join(map(str, ranges.held))
        yield f"friction within the ranges may hold the start of phase {numbers}"
    if ranges.largest is not None:
        each = ", ".join("-" if factor is None else f"{factor:.3g}" for factor in ranges.phases)
        text = f"a plan exists for ranges {ranges.largest:.3g} times as wide as the problem's"
        capped = ", as wide as they make sense" if ranges.capped else ""
        yield f"{text}{capped}; phase by phase {each}"


def _list_table(table: Mapping[str, Any]) -> Iterator[str | Table]:
    """The torque table, and the phases of its replay if it has samples at a rate."""
    sampled, replay = "sample_rate" in table, table["replay"]
    rate = f", {table['interpolation']} at {table['sample_rate']:g} Hz" if sampled else ""
    text = f"wrote {table['file']}: {table['rows']} rows{rate}"
    if replay is not None:
        verdict = "holds" if replay["ok"] else "does not hold"
        text += f"; its replay {verdict}: {replay['reason']}"
    yield text
    if sampled and replay is not None:
        keys = ("phase", "arrival", "planned_arrival", "least_c_n", "planned_least_c_n")
        rows = [(*(row[key] for key in keys), row["contact"] or "-") for row in replay["phases"]]
        heads = ["phase:d", "arrival [s]:.6f", "planned [s]:.6f", "least c_n [N]:.6f"]
        yield Table([*heads, "planned [N]:.6f", "contact"], rows)


def _describe_uniqueness(plan: Plan) -> str:
    """Uniqueness margin of contact forces, and times for which phases may be stuck."""
    margins = [(p.uniqueness_margin, p.number) for p in plan.phases if p.uniqueness_margin]
    if not margins:
        return ""
    least, number = min(margins)
    text = f"contact forces unique: margin {least.value:.2f} (1 without friction, 0 ambiguous)"
    text += f", least in phase {number}"
    for phase in plan.phases:
        if phase.wedged:
            text += f"; phase {phase.number} may stay wedged for {1e3 * phase.wedged:.3g} ms"
    return text
