"""Speeds up to which motions along the paths of phases keep every contact, without planning.

Inverse dynamics along a path at given s' and s''; the internal force is the best one at each place,
or that of quasistatic torques. Limit speeds are found by bisection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from ..common.arrays import Array, find_runs, sort_unique
from ..common.document import Document, Result, Table, fixed
from ..common.errors import InfeasibleError, name_source, require_number
from ..common.fields import SHARE
from ..common.sharing import exclusive
from ..contacts.formation import Formation
from ..geometry.curve import Curve, CurvePoint, border, describe_pose, directions_of, solve_tangent
from ..geometry.path_guess import RELEASE_PLACE, count_freedoms, find_end, guess_phase
from ..geometry.tracing import trace_phase
from ..mechanics.dynamics import (
    LAMBDA,
    ONE,
    Directions,
    PathForces,
    close_all,
    forward,
    inverse,
    metric_weights,
    reduced_inertia,
)
from ..mechanics.limits import CONE, PRESS
from ..mechanics.path_limits import InternalForceLimits
from ..problem.definition import End, Phase, Problem
from ..problem.read import require_phases
from ..results.torque import TorqueProfile

N_PLACES = 241  # approximate number of places of a phase
SQUEEZE = 0.5
"""Internal force of quasistatic torques: 0 least, 1 with the largest least normal force."""
OWN_TORQUES = "own torques"  # name of the motion under the torques of the quasistatic one
PROFILES: dict[str, tuple[tuple[float, ...], float]] = {
    "steady": ((1.0,), 1.0),
    "moving": ((1.0,), 1.0),
    "from rest": ((0.0, 1.0), 2.0),
    "to rest": ((1.0, -1.0), 2.0),
    "rest to rest": ((0.0, 4.0, -4.0), math.pi / 2),
}
"""Speed profiles along a phase, of largest speed one: b = s'^2 as a polynomial of s over the
length, and the duration over the length. From rest to rest s is a cosine of time; with one end at
rest s'' is constant, with none the speed is."""


@exclusive
def predict(
    problem: Problem, *, squeeze: float = SQUEEZE, progress: Callable[[str], None] | None = None
) -> Prediction:
    """Quasistatic motions along the phases of a problem, and the speeds up to which contacts hold.

    Parameters
    ----------
    squeeze   internal force of quasistatic torques. They are the least torques that keep a normal
              force, interpolated from epsilon, at 0, to the largest least one of the phase, at 1
    progress  called with a text before each phase

    InputError if the phases cannot be carried out geometrically, or a number is out of its range.
    """
    require_phases(problem)
    ratio = SHARE.read(squeeze, "squeeze")
    predictions: list[PhasePrediction] = []
    z, in_motion = problem.start, False
    with name_source(problem.source):
        for phase in problem.phases:
            if progress is not None:
                progress(f"predicting phase {phase.number} of {len(problem.phases)}")
            later = problem.phases[phase.index + 1 :]
            path = sample_path(phase, z, later)
            at_rest = not in_motion, phase.end is End.REST
            predictions.append(_predict_phase(problem, phase, path, at_rest, ratio))
            z = find_end(phase, z, later) if path is None else path.point.z[-1]
            in_motion = phase.end is not End.REST
    return Prediction(problem.name, problem.epsilon, tuple(predictions))


def make_torques(prediction: Prediction, speed: float) -> TorqueProfile:
    """Quasistatic torques of all phases over time, at a constant speed along the phases [m/s].

    They balance friction without starting a motion: the first guess of hand tuning.

    InfeasibleError if a phase has no quasistatic torques.
    """
    speed, profiles = require_number(speed, "speed", positive=True), []
    for phase in prediction.phases:
        if phase.torques is None:
            text = f"phase {phase.number} is not kept all along"
            raise InfeasibleError(f"no quasistatic torques to write: {text}")
        rows = np.column_stack([phase.torques.s / speed, phase.torques.tau])
        profiles.append(TorqueProfile.join_rows(rows))
    return TorqueProfile.chain(profiles)


def _predict_phase(
    problem: Problem, phase: Phase, path: PathSamples | None, rest: tuple[bool, bool], ratio: float
) -> PhasePrediction:
    names, until = phase.formation.names, str(phase.until)
    if path is None:
        return PhasePrediction(phase.number, names, until, "left out", math.nan)
    motion_name = ("moving", "to rest", "from rest", "rest to rest")[2 * rest[0] + rest[1]]
    motions = {
        name: (evaluate_best(path, name), PROFILES[name][1] * path.length)
        for name in ("steady", motion_name)
    }
    torques = find_torques(path, problem.epsilon, ratio)
    if torques is not None:
        motions[OWN_TORQUES] = (evaluate_torques(path, torques.tau), path.length)
        # Every eighth place, with both ends and both sides of every reversal.
        reversals = np.diff(path.s) == 0
        chosen = np.append(True, reversals) | np.append(reversals, True)
        chosen[::8] = True
        torques = QuasistaticTorques(*(part[chosen] for part in torques))
    unit, survivals = problem.scene.scales.speed, list[LimitSpeeds]()
    for name, (evaluate, path_length) in motions.items():
        speed, again, least = find_limit_speed(evaluate, problem.epsilon, unit)
        lost, *_ = find_limit_speed(evaluate, 0.0, unit, speed or 0.0)
        duration = path_length / speed if speed else None
        survivals.append(LimitSpeeds(name, speed, duration, lost, again, _name(path, least)))
    zero = np.zeros_like(path.s)
    grasp = path.force_limits.find_best(zero, zero)
    kept = (grasp.least >= problem.epsilon) & (path.inertia > 0)
    # Curves of least forces extend over all limit speeds. They may break there: speeds just below
    # and above are among the samples.
    limits = [s for each in survivals for s in (each.speed, each.lost, each.again) if s]
    ends = (0.36 * min(limits), 1.4 * max(limits)) if limits else (0.1 * unit, 10 * unit)
    breaks = np.outer([1 - 1e-7, 1 + 1e-7], limits)
    speeds = sort_unique(np.append(np.geomspace(*ends, 61), breaks))
    forces = {
        name: np.array([evaluate(speed).force for speed in speeds.tolist()])
        for name, (evaluate, _) in motions.items()
    }
    return PhasePrediction(
        number=phase.number,
        contacts=names,
        until=until,
        path="line" if path.curve is None else "curve",
        length=path.length,
        slow=_name(path, motions["steady"][0](0.0)),
        kept=tuple((_place(path, r.start), _place(path, r.stop - 1)) for r in find_runs(kept)),
        survivals=tuple(survivals),
        torques=torques,
        curves=Curves(speeds, forces),
    )


def find_torques(path: PathSamples, epsilon: float, squeeze: float) -> QuasistaticTorques | None:
    """Torques that balance a quasistatic motion at all places of a path; None if impossible.

    They keep `epsilon` [N]; `squeeze` is that of `predict`.
    """
    zero = np.zeros_like(path.s)
    best = path.force_limits.find_best(zero, zero)
    if not (best.least >= epsilon).all() or not (path.inertia > 0).all():
        return None
    required = epsilon + squeeze * float(best.least.min() - epsilon)
    low, high = path.force_limits.find_span(zero, zero, required)
    forces = path.forces
    constant, by_lambda = (forces.of_tau[..., column] for column in (ONE, LAMBDA))
    size = (by_lambda**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        minimal = -(constant * by_lambda).sum(axis=1) / size
    # At the largest least force the interval is one point, but for rounding.
    clipped = np.where(low <= high, np.clip(minimal, low, high), best.internal_force)
    internal = np.where(size > 0, clipped, 0.0)
    c_n = forces.c(zero, zero, internal)[:, : path.phase.formation.n_contacts]
    return QuasistaticTorques(path.s, path.point.z, forces.tau(zero, zero, internal), c_n)


def _name(path: PathSamples, least: Least) -> CriticalLimits:
    parts = dict[str, dict[str, None]]()  # contacts, and others by kind of limit
    for limit in (path.force_limits.limits.limits[k] for k in least.limits):
        kind = "" if limit.kind in (PRESS, CONE) else limit.kind
        parts.setdefault(kind, {})[limit.part] = None
    contacts = tuple(parts.pop("", {}))
    others = tuple(f"{kind} of {' and '.join(each)}" for kind, each in parts.items())
    force = least.force if math.isfinite(least.force) else None
    return CriticalLimits(contacts, others, _place(path, least.place), force)


def _place(path: PathSamples, row: int) -> Place:
    return Place(float(path.s[row]), float(path.point.z[row, 0]), float(path.point.z[row, 2]))


class Least(NamedTuple):
    """Least normal force along a phase at one speed."""

    # [N]: the least normal force, or for a rolling contact the largest epsilon within its cone;
    # minus infinity where other limits are violated with any internal force
    force: float
    place: int  # row of the path
    limits: tuple[int, ...]  # active limits, as indices into the limits of the path


Evaluate = Callable[[float], Least]  # least normal force at a speed [m/s]


def evaluate_best(path: PathSamples, profile: str) -> Evaluate:
    """Least normal force along a path as a function of the largest speed of one of `PROFILES`.

    The internal force is the best one at each place.
    """
    square, x = Polynomial(PROFILES[profile][0]), path.s / path.length
    a, b = square.deriv()(x) / (2 * path.length), square(x)

    def evaluate(speed: float) -> Least:
        grasp = path.force_limits.find_best(speed**2 * a, speed**2 * b)
        least = np.where(path.inertia > 0, grasp.least, -np.inf)
        place = int(least.argmin())
        owners = grasp.owners[place].tolist() if path.inertia[place] > 0 else []
        return Least(float(least[place]), place, tuple(owners))

    return evaluate


def evaluate_torques(path: PathSamples, tau: Array) -> Evaluate:
    """Least normal force as a function of a constant speed, under torques `tau` (n, 2) [N m]."""
    limits = path.force_limits.limits
    owners, force_limits = limits.owners, limits.of(PRESS, CONE)
    weights = np.concatenate([limit.weight for limit in limits.limits])[force_limits]
    others = np.setdiff1d(np.arange(len(owners)), force_limits)
    # Tolerance for rounding.
    slack = 1e-9 * limits.scales[others]

    def evaluate(speed: float) -> Least:
        rates = speed * path.point.z_s[:, 3:]
        values = np.hstack([path.find_forces(tau, speed), tau, rates]) @ limits.rows.T
        force, rest = values[:, force_limits] / weights, values[:, others]
        violated = (rest > limits.high[others] + slack) | (rest < limits.low[others] - slack)
        force[violated.any(axis=1)] = -np.inf
        place, row = np.unravel_index(int(force.argmin()), force.shape)
        return Least(float(force[place, row]), int(place), (int(owners[force_limits[row]]),))

    return evaluate


def find_limit_speed(
    evaluate: Evaluate, required: float, unit: float, above: float = 0.0
) -> tuple[float | None, float | None, Least]:
    """The least speed at which the least force is below `required` [N], by bisection.

    At speeds up to `above` [m/s] the force is known to be enough if it is enough at rest; `unit` is
    the scene's speed [m/s].

    Returns
    -------
    speed : [m/s]  zero if the force is below near rest, None if it is enough at all speeds
    again : [m/s]  if `speed` is zero, the speed above which the force is enough; None without one
    least          the least force just above the speed
    """
    start, low = evaluate(0.0), above
    enough = start.force >= required
    speeds = unit * np.geomspace(1e-2, 1e2, 49)
    for high in speeds[speeds > above].tolist():
        least = evaluate(high)
        if (least.force >= required) != enough:
            break
        low = high
    else:
        return (None if enough else 0.0), None, start
    for _ in range(24):
        speed = (low + high) / 2
        candidate = evaluate(speed)
        if (candidate.force >= required) == enough:
            low = speed
        else:
            high, least = speed, candidate
    return (high, None, least) if enough else (0.0, high, start)


@dataclass(frozen=True, eq=False)
class PathSamples:
    """Path of a phase, sampled, with its limits."""

    phase: Phase
    curve: Curve | None  # none along a straight line
    # (n,) [m]: arc lengths in the metric of curves; places of reversals occur twice
    s: Array
    point: CurvePoint
    directions: Directions  # one row for each place
    forces: PathForces
    force_limits: InternalForceLimits
    # (n,): reduced inertia over that without friction: motions jam at zero and below
    inertia: Array

    @property
    def length(self) -> float:
        """Length of the phase [m]."""
        return float(self.s[-1])

    def find_forces(self, tau: Array, speed: float) -> Array:
        """Contact forces [c_n; c_t(rolling)], (n, n_c + R), under torques `tau` (n, 2) at a speed.

        The acceleration follows from the torques.
        """
        kinematics, v = self.point.kinematics, speed * self.point.z_s
        kinematics = kinematics._replace(P_dot_v=speed**2 * kinematics.P_dot_v)
        return forward(self.phase.formation, kinematics, v, tau, self.directions)[1]


def sample_path(phase: Phase, z: Array, later: Sequence[Phase]) -> PathSamples | None:
    """The path of a phase that starts at `z`, shape (5,); None with other than 1 or 2 freedoms.

    InputError if the contacts do not touch at `z`, or the end cannot be reached.
    """
    formation = phase.formation
    curve = None
    if formation.n_constraints == 4 and count_freedoms(formation, z) == 1:
        curve = trace_phase(phase, z, later)
        if phase.until.is_release:
            curve = replace(curve, length=RELEASE_PLACE * curve.length)
        # Both ends of each segment, and denser there, where motions start and stop.
        sizes = [part.stop - part.start for part in curve.segments]
        counts = [max(5, round(N_PLACES * size / curve.length)) for size in sizes]
        fractions = [(1 - np.cos(np.linspace(0.0, np.pi, count))) / 2 for count in counts]
        owners = np.repeat(np.arange(len(counts)), counts)
        starts = np.array([part.start for part in curve.segments])
        s = starts[owners] + np.concatenate(fractions) * np.array(sizes)[owners]
        point = curve.evaluate(s)
        directions = directions_of(curve, owners)
    elif formation.n_constraints == 3 and count_freedoms(formation, z) == 2:
        goal = guess_phase(phase, z, later)[-1].z[-1]
        s, point = _straighten(formation, z, goal)
        directions = Directions.of(point.kinematics, point.z_s)
    else:
        return None
    forces = inverse(formation, point, directions)
    limits = InternalForceLimits.of(formation, forces, point.z_s[:, 3:])
    inertia = reduced_inertia(formation, point.kinematics, directions)
    return PathSamples(phase, curve, s, point, directions, forces, limits, inertia)


def _straighten(formation: Formation, start: Array, goal: Array) -> tuple[Array, CurvePoint]:
    """Arc lengths of places along a straight line in (x, phi), and the path there."""
    u = (1 - np.cos(np.linspace(0.0, np.pi, N_PLACES))) / 2
    line_z = goal - start
    line, slip = start + u[:, None] * line_z, formation.evaluate_slip(start[None])[0]
    z = close_all(formation, line, slip, ((0, line[:, 0]), (2, line[:, 2])))
    metric, tangent = metric_weights(formation.scene), line_z * [1, 0, 1, 0, 0]
    at = formation.evaluate(z, np.zeros_like(z))
    normal = np.array([-line_z[2], 0, line_z[0], 0, 0])
    for _ in range(2):
        # The line is one more constraint, without curvature.
        P, curvature = border(at.P, normal), np.pad(at.P_dot_v, ((0, 0), (0, 1)))
        z_s, z_ss = solve_tangent(P, curvature, np.tile(tangent, (N_PLACES, 1)), metric)
        at = formation.evaluate(z, z_s)
    speed = tangent @ tangent / (z_s @ tangent)
    s = np.append(0.0, np.cumsum(np.diff(u) * (speed[1:] + speed[:-1]) / 2))
    return s, CurvePoint(z, z_s, z_ss, at)


class Place(NamedTuple):
    """A place along a phase: arc length [m], x [m] and phi [rad]."""

    s: float
    x: float
    phi: float

    def to_text(self) -> str:
        """The pose in mm and degrees."""
        return describe_pose(np.array(self[1:]))


class CriticalLimits(NamedTuple):
    """The limits that are violated first, and their place."""

    # one, or two of which the internal force selects one; none if other limits are the first
    contacts: tuple[str, ...]
    others: tuple[str, ...]  # active limits of torques or speeds of fingers
    place: Place
    # [N]: the least normal force there; None if limits other than those of forces are violated
    force: float | None

    @property
    def name(self) -> str:
        """The limits in words."""
        parts = [" or ".join(self.contacts), " and ".join(self.others)]
        return ", by ".join(filter(None, parts)) or "jams"


class LimitSpeeds(NamedTuple):
    """Limit speeds of one kind of motion."""

    # "steady": constant speed, with the best internal force at each place; "rest to rest",
    # "from rest", "to rest": with the best one, too, s a cosine of time, or constant acceleration;
    # "own torques": constant speed, under the torques of the quasistatic motion
    motion: str
    # [m/s]: least peak speed along the phase at which a normal force is below epsilon. Zero if one
    # is near rest, None if none is at any speed.
    speed: float | None
    duration: float | None  # [s]: of the phase at that speed
    lost: float | None  # [m/s]: least peak speed at which a contact is lost
    # [m/s]: if `speed` is zero, the speed above which all contacts are kept
    again: float | None
    first: CriticalLimits  # the limits that are violated at `speed`


class QuasistaticTorques(NamedTuple):
    """Torques that balance a quasistatic motion, at n places of a phase."""

    s: Array  # (n,) [m]
    z: Array  # (n, 5)
    tau: Array  # (n, 2) [N m]
    c_n: Array  # (n, n_c) [N]


class Curves(NamedTuple):
    """The least normal force over speed."""

    speed: Array  # (n,) [m/s]
    # (n,) [N]: by the names of motions; minus infinity where other limits are violated
    force: dict[str, Array]


@dataclass(frozen=True, eq=False)
class PhasePrediction:
    """One phase."""

    number: int
    contacts: tuple[str, ...]
    until: str
    # {"curve", "line", "left out"}: its curve, a straight line in (x, phi), or no prediction
    path: str
    length: float  # [m]
    # least force of the quasistatic motion with the best internal force; None if left out
    slow: CriticalLimits | None = None
    # stretches where the quasistatic motion keeps every contact
    kept: tuple[tuple[Place, Place], ...] = ()
    survivals: tuple[LimitSpeeds, ...] = ()
    torques: QuasistaticTorques | None = None  # None if no torques balance everywhere
    curves: Curves | None = None

    derived = ("is_kept",)

    @property
    def is_kept(self) -> bool:
        """Whether the quasistatic motion keeps every contact all along."""
        return len(self.kept) == 1 and self.kept[0][1].s - self.kept[0][0].s >= self.length


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result):
    """Predictions of the phases of a problem."""

    name: str
    epsilon: float  # [N]
    phases: tuple[PhasePrediction, ...]

    @property
    def document(self) -> Document:
        """Tables of quasistatic motions and of limit speeds."""
        failed = [phase.number for phase in self.phases if phase.slow and not phase.is_kept]
        verdict = "keeps every contact"
        if failed:
            verdict += f" but in phase{'s' * (len(failed) > 1)} {', '.join(map(str, failed))}"
        head = f"a quasistatic motion, epsilon = {self.epsilon:g} N, {verdict}"
        if all(phase.path == "left out" for phase in self.phases):
            head = "no phase has one or two freedoms"
        return Document(self.name, reason=head, parts=[self._list_slow(), self._list_speeds()])

    def _list_slow(self) -> Table:
        sizes = [abs(phase.slow.force) for phase in self.phases if phase.slow and phase.slow.force]
        rows, form = list[tuple[object, ...]](), fixed(self.epsilon or 1e-3 * max(sizes, default=0))
        for phase in self.phases:
            row = phase.number, phase.until, phase.path
            if phase.slow is None:
                rows.append((*row, None, None, "-", "-", "has neither one nor two freedoms"))
                continue
            parts = "; ".join(f"{a.to_text()} to {b.to_text()}" for a, b in phase.kept)
            kept, slow = "all along" if phase.is_kept else parts or "nowhere", phase.slow
            rows.append((*row, phase.length, slow.force, slow.name, slow.place.to_text(), kept))
        heads = ["phase:d", "until", "along", "length [m]:.4g", f"least c_n [N]:+{form}"]
        return Table([*heads, "of", "at", "kept"], rows)

    def _list_speeds(self) -> Table:
        rows = []
        for phase, survival in ((p, survival) for p in self.phases for survival in p.survivals):
            ends = survival.speed, survival.lost
            speed, lost = ("any speed" if v is None else f"{v:.4g}" for v in ends)
            if survival.again is not None:
                speed = f"0; from {survival.again:.4g} on"
            first = f"{survival.first.name} at {survival.first.place.to_text()}"
            first = "nothing gives way" if survival.speed is None else first
            rows.append((phase.number, survival.motion, speed, survival.duration, lost, first))
        heads = ["phase:d", "motion", "keeps epsilon to [m/s]:.4g", "lasting [s]:.4g"]
        return Table([*heads, "contacts to [m/s]:.4g", "first"], rows)
