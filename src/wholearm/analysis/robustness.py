"""Robustness by Latin-hypercube sampling: success rates with Wilson intervals, sensitivities.

A sample is a replay in a perturbed scene by complementarity simulation, compared with the plan:
parametric ranges, and sample-and-hold, gains and delay of the torques.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from .. import __version__
from ..common.arrays import Array
from ..common.document import Document, Result, Table
from ..common.errors import InputError, SimulationError, require_number
from ..common.fields import Field, Range
from ..common.parallel import DiedError, Journal, Processes, run_all
from ..contacts.closing import close_fingers, describe_obstacle
from ..policy.playback import ClosedLoop, Policy
from ..problem.definition import PARAMETERS, Phase, Problem, change_scene, read_widths
from ..results.adopt import Torques, adopt_motion
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory, interpolate_quintic
from ..scene.model import Scene
from ..simulation.events import OutcomeKind, Simulation
from ..simulation.simulate import simulate_free
from ..verification.free import END_ANGLE, END_SHIFT, GRACE, find_touch, list_aliases, list_gained

Task = tuple[int, tuple[float, ...]]  # number and values of a sample


def draw_cube(count: int, size: int, seed: int | tuple[int, int]) -> Array:
    """Samples of a Latin hypercube, shape (count, size), in [0, 1).

    Each column has one sample in each of `count` slices: the effect of each number is well sampled.
    """
    generator = np.random.default_rng(seed)
    slices = generator.permuted(np.tile(np.arange(count)[:, None], size), axis=0)
    return np.asarray((slices + generator.random(slices.shape)) / count)


@dataclass(frozen=True)
class Uncertainty:
    """Half widths of the ranges by parameter, execution of torques, tolerances of the goal.

    InputError if a name is unknown, or a width is out of its range: below one for relative ones.
    """

    # missing ones have their defaults; a parameter with zero is constant
    widths: Mapping[str, float] = field(default_factory=dict)
    # [Hz]: of a sample-and-hold of the torques, whose first sample is anywhere in a period; None
    # for torques as planned
    sample_rate: float | None = 1000.0
    # of the simulations of samples, relative to the scene: far below the tolerances of the goal
    tolerance: float = 1e-6
    # [m]: largest distance from the planned place at a goal; `END_SHIFT` of the scene's length
    # if left out
    distance: float | None = None
    angle: float = END_ANGLE  # [rad]: largest difference from the planned angle at a goal

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", read_widths(self.widths, "range of {}"))
        if self.sample_rate is not None:
            require_number(self.sample_rate, "sample rate", positive=True)
        if self.distance is not None:
            require_number(self.distance, "goal distance", positive=True)
        require_number(self.angle, "goal angle", positive=True)

    def find_distance(self, scene: Scene) -> float:
        """Largest distance from the planned place at a goal [m]."""
        return END_SHIFT * scene.scales.length if self.distance is None else self.distance

    @property
    def varied(self) -> tuple[Field, ...]:
        """The parameters with a range."""
        return tuple(parameter for parameter in PARAMETERS if self.widths[parameter.name] > 0)

    def draw(self, count: int, seed: int | tuple[int, int]) -> Array:
        """Samples of a Latin hypercube, shape (count, len(varied) + 1).

        The last column is the phase of the sample-and-hold at the start of the torques, in [0, 1).
        """
        cube = draw_cube(count, len(self.varied) + 1, seed)
        low = np.array([0 if parameter.name == "delay" else -1 for parameter in self.varied])
        widths = np.array([self.widths[parameter.name] for parameter in self.varied])
        return np.column_stack([(low + (1 - low) * cube[:, :-1]) * widths, cube[:, -1]])


def change_problem(problem: Problem, changes: Mapping[str, float]) -> Problem:
    """The problem in the scene changed by `change_scene`, with the same start."""
    return replace(problem, scene=change_scene(problem.scene, changes))


def change_torques(
    torque: TorqueProfile,
    changes: Mapping[str, float],
    sample_rate: float | None = None,
    offset: float = 0.0,
) -> TorqueProfile:
    """Torques as executed: with sample-and-hold, delay and errors of gains.

    Changes are `gain1` and `gain2`, relative, and `delay` [s], during which the first torques hold.
    The first sample is early by a fraction `offset` of a period, in [0, 1).
    """
    breaks, coefficients = torque.breaks, torque.coefficients
    if sample_rate is not None:
        start, stop = torque.breaks[0], torque.breaks[-1]
        ticks = np.arange(1, np.ceil((stop - start) * sample_rate) + 1) - offset
        samples = start + ticks / sample_rate
        samples = samples[(samples > start) & (samples < stop)]
        breaks = np.concatenate([[start], samples, [stop]])
        coefficients = torque.at(breaks[:-1])[:, :, None]
    gains = 1 + np.array([changes.get("gain1", 0.0), changes.get("gain2", 0.0)])
    coefficients = coefficients * gains[:, None]
    delay = changes.get("delay", 0.0)
    if delay > 0:
        first = np.zeros((1, *coefficients.shape[1:]))
        first[0, :, 0] = torque.at(torque.breaks[:1])[0] * gains
        breaks = np.concatenate([breaks[:1], breaks + delay])
        coefficients = np.concatenate([first, coefficients])
    return TorqueProfile(breaks, coefficients)


@dataclass(frozen=True, eq=False)
class Trial:
    """A plan, or one phase of it, and its execution with changed parameters."""

    problem: Problem
    torque: TorqueProfile  # from time 0 on
    # (5,): configuration at the start, at rest. With changed parameters the object is put on the
    # palm at the same x and phi, and the fingers are closed on it.
    state: Array
    phases: tuple[Phase, ...]
    stops: tuple[float, ...]  # [s]: ends of the phases in the plan
    goal: Array  # (3,): the planned pose at the end
    uncertainty: Uncertainty
    # feedback instead of planned torques; its period is that of the samples
    policy: Policy | None = None

    def run(self, task: Task) -> dict[str, Any]:
        """Record of the simulation of a sample, a numbered row of `Uncertainty.draw`.

        Keys: `distance` [m] and `angle` [rad] from the goal; `reached` and `kept`; the first
        contact that was `lost`, the number of its `phase` and the `time` [s]; the `least` c_n [N]
        of planned contacts; `path`, poses at even distances, for figures, of the first 200 samples;
        `ended`, the reason if the simulation ended early or could not begin, or empty.
        """
        number, (*sample, offset) = task
        names = [parameter.name for parameter in self.uncertainty.varied]
        changes = dict(zip(names, sample, strict=True))
        record = self.change(changes, self.uncertainty.sample_rate, offset)
        if number >= 200:
            record.pop("path", None)
        return record

    def change(
        self, changes: Mapping[str, float], rate: float | None = None, offset: float = 0.0
    ) -> dict[str, Any]:
        """Record of the simulation with `changes` of parameters, and sample-and-hold at a rate."""
        execution: TorqueProfile | ClosedLoop
        if self.policy is None:
            execution = change_torques(self.torque, changes, rate, offset)
        else:
            gains = (1 + changes.get("gain1", 0.0), 1 + changes.get("gain2", 0.0))
            delay = changes.get("delay", self.policy.settings.delay)
            execution = ClosedLoop(self.policy, self.phases[0].number, delay, gains)
        try:
            simulation = self.simulate(changes, execution, self.uncertainty.tolerance)
        except (InputError, SimulationError) as error:
            return {"ended": str(error), "reached": False, "kept": False, "lost": "start"}
        if not isinstance(execution, ClosedLoop):
            delay = changes.get("delay", 0.0)
            return self.judge(simulation, 0.0, [stop + delay for stop in self.stops])
        # A phase begins when its first torques take effect; the last one lasts until the end.
        end = float(simulation.t[-1])
        starts = {number: time + execution.delay for number, time in execution.phase_starts.items()}
        starts[self.phases[-1].number + 1] = end
        stops = [starts.get(phase.number + 1, math.inf) for phase in self.phases]
        return self.judge(simulation, starts.get(self.phases[0].number, end), stops)

    def simulate(
        self,
        changes: Mapping[str, float],
        torque: TorqueProfile | ClosedLoop,
        tolerance: float = 1e-9,
    ) -> Simulation:
        """Simulate torques in the changed scene, without prescribed contacts.

        InputError, SimulationError if the changed scene has no start.
        """
        problem = change_problem(self.problem, changes)
        x = self.state[:1] + changes.get("start_x", 0.0)
        closed = close_fingers(problem.scene, x, self.state[2:3])
        if text := describe_obstacle(closed):
            raise SimulationError(f"the hand cannot close at the start: {text}")
        until = None
        if isinstance(torque, ClosedLoop):
            until = torque.find_limit(self.phases[-1].number)
        return simulate_free(problem, torque, start=closed.z[0], until=until, tolerance=tolerance)

    def judge(self, simulation: Simulation, start: float, stops: Sequence[float]) -> dict[str, Any]:
        """Compare a motion, and the times at which its phases start and stop [s], with the plan.

        A phase lasts from the gain of the contact of the one before to the gain of its own, or to
        its planned end. A contact is lost if it opens for longer than 1e-3 units of time. One that
        is open at the start, which may be inexact, has `GRACE` to close. Returns as `run`.
        """
        unit, t = self.problem.scene.scales.time, simulation.t
        losses, least = list[tuple[float, int, str]](), math.inf
        for phase, planned in zip(self.phases, stops, strict=True):
            gained, aliases = list_gained(self.problem, phase), list_aliases(self.problem, phase)
            gains = [s.start for s in simulation.stretches if s.contact in gained]
            gain_time = min((time for time in gains if time > start), default=math.inf)
            stop = min(planned, find_touch(simulation, gained, start))
            for name in phase.formation.names:
                c_n = simulation.c_n[(t >= start) & (t < stop), simulation.contacts.index(name)]
                least = min(least, float(np.nanmin(c_n, initial=math.inf)))
                pauses = simulation.list_pauses(name, start, stop, aliases[name])
                settled = start + GRACE * unit if pauses and pauses[0][0] <= start else start
                long = [pause for pause in pauses if pause[1] - pause[0] > 1e-3 * unit]
                losses += [(opened, phase.number, name) for opened, end in long if end > settled]
            start = max(planned, gain_time) if gained else planned
            if start > t[-1]:
                # The last motion may end a little before its contact: the goal decides.
                if phase is not self.phases[-1]:
                    losses.append((planned, phase.number, min(gained, default="")))
                break
        time, number, lost = min(losses, default=(None, None, ""))
        error = simulation.z[-1, :3] - self.goal
        distance, angle = float(np.hypot(error[0], error[1])), float(abs(error[2]))
        at_goal = distance <= self.uncertainty.find_distance(self.problem.scene)
        at_goal = at_goal and angle <= self.uncertainty.angle
        given_up = simulation.outcome.kind is OutcomeKind.GIVEN_UP
        # Smooth in figures, in which straight lines between the steps would be visible.
        lengths = np.append(0.0, np.cumsum(np.hypot(*np.diff(simulation.z[:, :2], axis=0).T)))
        times = np.interp(np.linspace(0.0, lengths[-1], 101), lengths, t)
        times = times[times > 0]
        rows = np.searchsorted(t, times) - 1
        knots = simulation.z, simulation.z_dot, simulation.z_ddot
        path = interpolate_quintic(t[rows + 1] - t[rows], times - t[rows], knots, rows)[0]
        return {
            "distance": distance,
            "angle": angle,
            "reached": at_goal and not given_up,
            "kept": not lost and not given_up,
            "lost": lost,
            "phase": number,
            "time": time,
            "least": least,
            "path": [*simulation.z[:1].tolist(), *path.tolist()],
            "ended": simulation.outcome.text if given_up else "",
        }


def make_trial(
    problem: Problem,
    plan: Trajectory,
    uncertainty: Uncertainty,
    phase: int | None = None,
    policy: Policy | None = None,
) -> Trial:
    """Trial of a plan, or of the phase with a number, with a policy if there is one.

    InputError if the plan has no phase of that number, or one that does not start at rest; or the
    policy has other phases.
    """
    starts = plan.phase_starts
    count = len(starts) - 1
    if phase is not None and not 1 <= phase <= count:
        raise InputError("", "--phase", f"{phase} given; the plan has phases 1 to {count}")
    if policy is not None:
        policy.require_count(count, "plan")
    first, last = (0, count - 1) if phase is None else (phase - 1, phase - 1)
    rows = np.flatnonzero((plan.phase >= first) & (plan.phase <= last))
    scales = problem.scene.scales
    units = np.array([scales.speed, scales.speed, *[scales.rate] * 3])
    if np.abs(plan.z_dot[rows[0]] / units).max() > 1e-6:
        text = f"{phase} given; it does not start at rest, so that it is no trial of its own"
        raise InputError("", "--phase", text)
    start = float(starts[first])
    stops = tuple((starts[first + 1 : last + 2] - start).tolist())
    torque = plan.torque.cut(start, float(starts[last + 1]))
    torque = TorqueProfile(torque.breaks - start, torque.coefficients)
    goal = plan.q[rows[-1]]
    if policy is not None:
        policy = policy.cut(last + 1)
    phases = problem.phases[first : last + 1]
    return Trial(problem, torque, plan.z[rows[0]], phases, stops, goal, uncertainty, policy)


@dataclass(frozen=True, eq=False, repr=False)
class Robustness(Result):
    """Fractions of samples that reach the goal, and sensitivities of the least normal force."""

    trial: Trial
    samples: Array  # (n, len(varied) + 1): of `Uncertainty.draw`
    seed: int
    records: tuple[dict[str, Any], ...]  # of `Trial.run`, in the order of the samples
    known: int = 0  # number of samples in the file, these included; 0 without a file

    @cached_property
    def nominal(self) -> dict[str, Any]:
        """The record without changes of parameters."""
        return self.trial.change({})

    @cached_property
    def sensitivities(self) -> Sensitivities:
        """Sensitivities of the least normal force of the motion; empty with a policy."""
        if self.trial.policy is not None:
            return Sensitivities("", math.nan, math.nan, ())
        return measure_sensitivities(self.trial)

    @property
    def headline(self) -> str:
        """Counts, in a line, without the simulations that the document needs."""
        count = len(self.records)
        return f"{count} samples, goal reached {self.reached}, contacts kept {self.kept}"

    @property
    def reached(self) -> Share:
        """Samples that reach the goal within the tolerances of the uncertainty."""
        return Share(sum(record["reached"] for record in self.records), len(self.records))

    @property
    def kept(self) -> Share:
        """Samples that reach the goal and keep all planned contacts."""
        successes = sum(record["reached"] and record["kept"] for record in self.records)
        return Share(successes, len(self.records))

    @property
    def first_lost(self) -> dict[str, Share]:
        """Contacts lost first, by name and number of the phase, the most frequent first."""
        lost = [(r["lost"], r.get("phase")) for r in self.records if r["lost"]]
        names = Counter(f"{name} in phase {k}" if k is not None else name for name, k in lost)
        return {name: Share(n, len(self.records)) for name, n in names.most_common()}

    @property
    def document(self) -> Document:
        """Counts of samples that reach the goal, contacts lost first, sensitivities."""
        trial, count, least = self.trial, len(self.records), self.sensitivities
        phases = [phase.number for phase in trial.phases]
        place = "whole plan" if len(phases) > 1 else f"phase {phases[0]}"
        samples = f"{count} of {self.known}" if self.known > count else f"{count}"
        distance = 1e3 * trial.uncertainty.find_distance(trial.problem.scene)
        tolerances = f"{distance:.3g} mm and {math.degrees(trial.uncertainty.angle):.3g} deg"
        shares = [(f"goal reached within {tolerances}", str(self.reached))]
        shares.append(("and all planned contacts kept", str(self.kept)))
        losses = [(name, str(share)) for name, share in self.first_lost.items()]
        rest = sum(share.hits for share in list(self.first_lost.values())[8:])
        remaining = [(f"{len(losses) - 8} others", f"{rest} times")] if losses[8:] else []
        ended = Counter(record["ended"] for record in self.records if record["ended"])
        rows = []
        for sensitivity in least.of:
            unit, change = sensitivity.unit, sensitivity.width
            width = f"{change:g} {unit}" if unit else f"{100 * change:g} %"
            slope = f"{sensitivity.slope:.5g} N{f'/{unit}' if unit else ''}"
            slope = "a contact is lost at once" if math.isnan(sensitivity.slope) else slope
            rows.append((sensitivity.name, width, slope, sensitivity.over_range))
        heads = ["parameter", "range (+-)", "d(least c_n)/d:.5g", "over the range [N]:.4g"]
        end = self.nominal
        miss = "" if end["reached"] else str(end["ended"])
        if not end["reached"] and "distance" in end:
            miss = f"{1e3 * end['distance']:.3g} mm and {math.degrees(end['angle']):.3g} deg"
        least_at = f" on {least.contact} at t = {least.time:.4g} s"
        return Document(
            f"{trial.problem.name}, {place}",
            reason=f"{samples} samples, seed {self.seed}",
            parts=[
                Table(["", "share of the samples"], shares),
                f"without anything off the goal is missed too: by {miss}" if miss else "",
                Table(["contact lost first", "share of the samples"], losses[:8] + remaining),
                *(f"{count} ended early: {text}" for text, count in ended.most_common(3)),
                f"least c_n: {least.c_n:.4g} N{least_at}" if least.contact else "",
                Table(heads, rows),
            ],
        )

    @property
    def values(self) -> dict[str, Any]:
        """Counts, shares and sensitivities."""
        trial, least = self.trial, self.sensitivities
        keys = ("parameter", "unit", "range", "slope")
        return {
            "problem": trial.problem.name,
            "phases": [phase.number for phase in trial.phases],
            "samples": len(self.records),
            "seed": self.seed,
            "ranges": trial.uncertainty.widths,
            "sample_rate": trial.uncertainty.sample_rate,
            "reached": self.reached.table,
            "kept": self.kept.table,
            "first_lost": {name: share.table for name, share in self.first_lost.items()},
            "least_c_n": {"contact": least.contact, "time": least.time, "c_n": least.c_n},
            "sensitivities": [dict(zip(keys, each, strict=True)) for each in least.of],
            "nominal": {key: entry for key, entry in self.nominal.items() if key != "path"},
        }


def assess_robustness(
    problem: Problem,
    plan: Torques,
    *,
    samples: int = 1000,
    seed: int = 0,
    uncertainty: Uncertainty | None = None,
    phase: int | None = None,
    policy: Policy | None = None,
    path: str | os.PathLike[str] | None = None,
    fresh: bool = False,
    start: Callable[[], Executor] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Robustness:
    """Free simulations of a plan with random changes of parameters, and counts of successes.

    Parameters
    ----------
    samples      number of samples. If it exceeds that of the file, a Latin hypercube of the
                 difference is added; otherwise the first ones of the file are counted
    seed         of the samples, a Latin hypercube of all ranges
    uncertainty  the ranges; those of the problem, or their defaults, if left out
    phase        number of the only phase to simulate, from its planned start at rest
    policy       carries the plan out by feedback from the joints
    path         file to which results are written one by one. A study in it is continued, with
                 results that are equal to the last bit, unless `fresh` is set
    fresh        overwrite the file
    start        makes a `concurrent.futures.Executor`; processes on all cores if left out

    InputError if the plan has no such phase, or the file holds another study or anything else, is
    being written by another run, or cannot be written.
    """
    problem, trajectory = adopt_motion(problem, plan)
    Range(1, 10**6).read(samples, "samples")
    trial_uncertainty = uncertainty or Uncertainty(problem.ranges)
    trial = make_trial(problem, trajectory, trial_uncertainty, phase, policy)
    with Journal(os.fspath(path or os.devnull), _stamp(trial, seed), fresh) as journal:
        sizes = [record["samples"] for record in journal.records if "samples" in record]
        stored = {record["sample"]: record for record in journal.records if "sample" in record}
        if samples > sum(sizes):
            sizes.append(samples - sum(sizes))
            journal.add({"samples": sizes[-1]})
        outcomes = {k: record for k, record in stored.items() if k < samples}
        # One Latin hypercube each time that the study was enlarged.
        starts = [sum(sizes[:k]) for k in range(len(sizes))]
        seeds = [(seed, k) if k else seed for k in starts]
        cubes = [trial_uncertainty.draw(*part) for part in zip(sizes, seeds, strict=True)]
        draws = np.vstack(cubes)[:samples]
        tasks = ((k, tuple(draws[k].tolist())) for k in range(samples) if k not in outcomes)
        successes = sum(record["reached"] for record in outcomes.values())
        for (number, _), answer in run_all(trial.run, tasks, (start or Processes)()):
            if isinstance(answer, DiedError):
                answer = {"ended": str(answer), "reached": False, "kept": False, "lost": "worker"}
            elif isinstance(answer, Exception):
                raise answer
            outcomes[number] = {"sample": number, **answer}
            successes += answer["reached"]
            journal.add(outcomes[number])
            if progress is not None:
                progress(f"{len(outcomes)} of {samples} samples, {successes} reach the goal")
    records = tuple(outcomes[number] for number in range(samples))
    n_stored = 0 if path is None else len({*stored, *outcomes})
    return Robustness(trial, draws, seed, records, n_stored)


def _stamp(trial: Trial, seed: int) -> dict[str, Any]:
    """Inputs of a study: records of other plans, ranges or versions are of another study."""
    policy = trial.policy
    arrays = [] if policy is None else [array for t in policy.tables for array in t.values()]
    return {
        "study": "robustness",
        "version": __version__,
        "problem": trial.problem.table,
        "plan": _digest([trial.torque.breaks, trial.torque.coefficients, trial.state]),
        "policy": None if policy is None else _digest(arrays),
        "pace": None if policy is None else policy.settings._asdict(),
        "sensor": policy is not None and policy.sensor,
        "phases": [phase.number for phase in trial.phases],
        "widths": trial.uncertainty.widths,
        "sample_rate": trial.uncertainty.sample_rate,
        "tolerance": trial.uncertainty.tolerance,
        "goal": [trial.uncertainty.distance, trial.uncertainty.angle],
        "seed": seed,
    }


def _digest(arrays: Iterable[Array]) -> str:
    data = b"".join(np.ascontiguousarray(part).tobytes() for part in arrays)
    return hashlib.sha256(data).hexdigest()[:12]


class Sensitivity(NamedTuple):
    """Sensitivity of a normal force, by central differences of free simulations."""

    name: str  # name, unit: the parameter, and the unit of its range; empty for a relative one
    unit: str
    width: float  # half width of its range
    # dc_n/d(parameter) [N per unit]; NaN where the contact is lost even for such a step
    slope: float

    @property
    def over_range(self) -> float:
        """Change by the half width, to first order [N]."""
        return self.slope * self.width


class Sensitivities(NamedTuple):
    """The least normal force of a motion, and its sensitivities."""

    contact: str
    time: float  # [s]: of the least force, without times near steps of forces
    c_n: float  # [N]
    of: tuple[Sensitivity, ...]  # the largest over its range first


def measure_sensitivities(trial: Trial) -> Sensitivities:
    """Sensitivities of the least planned normal force to every parameter with a range.

    To first order, the least value of a smooth force changes like the force at that instant.
    """
    least, contact, time = find_least(trial)
    sensitivities = []
    for parameter in trial.uncertainty.varied if contact else ():
        width = trial.uncertainty.widths[parameter.name]
        step = 1e-3 * width
        values = (0.0, step) if parameter.name == "delay" else (-step, step)
        forces = list[float]()
        for value in values:
            change, delay = {parameter.name: value}, value if parameter.name == "delay" else 0.0
            torque = change_torques(trial.torque, change).cut(0.0, time + delay)
            try:
                simulation = trial.simulate(change, torque)
                forces.append(float(simulation.c_n[-1, simulation.contacts.index(contact)]))
            except (InputError, SimulationError):
                forces.append(math.nan)
        slope = (forces[1] - forces[0]) / (values[1] - values[0])
        sensitivities.append(Sensitivity(parameter.name, parameter.unit, width, slope))
    sensitivities.sort(key=lambda s: np.nan_to_num(-abs(s.over_range), nan=math.inf))
    return Sensitivities(contact, time, least, tuple(sensitivities))


def find_least(trial: Trial) -> tuple[float, str, float]:
    """The least c_n of a planned contact [N], its name and time [s]; NaN and "" for none."""
    simulation, start = trial.simulate({}, trial.torque), 0.0
    t, forces = simulation.t, list[tuple[float, str, float]]()
    events = np.array([0.0, t[-1], *(event.time for event in simulation.events)])
    # Forces step where sliding reverses, and changes of parameters shift the time of the step.
    smooth = np.abs(t[:, None] - events).min(axis=1) > 0.01 * t[-1]
    for phase, stop in zip(trial.phases, trial.stops, strict=True):
        for name in phase.formation.names:
            c_n = simulation.c_n[:, simulation.contacts.index(name)]
            rows = np.flatnonzero(smooth & (t > start) & (t < stop) & (c_n == c_n))
            forces += [(float(c_n[row]), name, float(t[row])) for row in rows]
        start = stop
    return min(forces, key=lambda force: force[0], default=(math.nan, "", math.nan))


@dataclass(frozen=True)
class Share:
    """Fraction of samples, with Wilson's interval of 95 % for the probability.

    References
    ----------
    E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """

    hits: int
    total: int

    @property
    def interval(self) -> tuple[float, float]:
        """Least and largest probability p with |hits/total - p| <= z sigma(p)."""
        from scipy.stats import binomtest

        if not self.total:
            return 0.0, 1.0
        interval = binomtest(self.hits, self.total).proportion_ci(method="wilson")
        return float(interval.low), float(interval.high)

    @property
    def value(self) -> float:
        """The fraction; NaN without samples."""
        return self.hits / self.total if self.total else math.nan

    @property
    def table(self) -> dict[str, float]:
        """Count, fraction and interval, as in JSON."""
        low, high = self.interval
        return {"count": self.hits, "share": self.value, "low": low, "high": high}

    def __str__(self) -> str:
        if not self.total:
            return "none"
        percent = [f"{100 * value:.1f}" for value in (self.value, *self.interval)]
        return f"{percent[0]} % ({self.hits} of {self.total}, 95 %: {percent[1]} to {percent[2]} %)"
