"""Replays of plans, and simulations of policies, in physics engines, compared with the plan.

The shapes of engines are balls and capsules. Vertices and edges of the object get the radius r
(`find_rounding`), and shapes that they touch are thinner by r, so that gaps are the C-functions:

============  ==========================  ===================  =====================================
shape         of                          radius               touches
============  ==========================  ===================  =====================================
``v3``        vertex 3                    r                    palm, both links
``e2``        edge 2                      r                    tips, circles about the joints
``finger1``   link 1, a capsule           radius - r           vertices, the other link
``tip1``      the tip's circle            radius - r           edges
``joint1``    the circle about the joint  radius - r           edges
``palm``      the half plane y <= -r                           vertices
============  ==========================  ===================  =====================================

Pairs have the friction of palm or finger. A tip at a vertex touches the vertex and the ends of both
edges at one place. Contacts between links are frictionless.

The cause of a departure is the first deviation in contacts that lasts until the error of the pose
exceeds its limit: a contact opens, sticks, slips, or one that is not planned has force.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array, Flags, IndependentRows, Numbers, find_runs, sort_unique
from ..common.document import Document, Result, Table, fixed
from ..common.errors import InputError, WholearmError
from ..common.fields import choice
from ..contacts.elemental import Contact
from ..contacts.formation import Formation, find_touching
from ..policy.playback import ClosedLoop, Policy
from ..problem.definition import Phase, Problem
from ..problem.read import read_stored_problem
from ..results.adopt import MotionLike, adopt_motion
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion, Samples, Trajectory
from ..scene.model import Scene
from ..simulation.run import Feedback
from ..simulation.simulate import simulate

OBJECT = "object"
LINKS = ("link1", "link2")  # Bodies that move
PALM = "palm"


class Shape(NamedTuple):
    """A ball or a capsule on a body."""

    name: str
    body: str
    # (1, 2) or (2, 2) [m]: centre, or both ends of the axis; of the object relative to its centroid
    # at phi = 0, of a link relative to its joint at theta = 0
    points: Array
    radius: float  # [m]


class Pair(NamedTuple):
    """Two shapes, or a shape and the palm, that may touch."""

    first: str
    second: str
    friction: float

    @property
    def name(self) -> str:
        """Names of both, in the form of names of contacts."""
        return f"{self.first}-{self.second}"


def find_rounding(scene: Scene) -> float:
    """Radius of vertices and edges, and depth of the palm below y = 0 [m]."""
    return 1e-7 * scene.scales.length


def list_shapes(scene: Scene) -> list[Shape]:
    """Every shape of object and links.

    InputError if a link has no thickness: penetrating bodies would leave it on the other side.
    """
    r, corners = find_rounding(scene), scene.polygon.vertices
    edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    shapes = [Shape(f"v{i}", OBJECT, corner[None], r) for i, corner in enumerate(corners)]
    shapes += [Shape(f"e{j}", OBJECT, ends, r) for j, ends in enumerate(edges)]
    for number, (link, body) in enumerate(zip(scene.fingers, LINKS, strict=True), 1):
        if link.radius == 0:
            text = "0 given; engines need links of some thickness, 1e-4 of the length or more"
            raise InputError("", f"{link.name}.radius", text)
        axis = np.array([[0.0, 0.0], [link.length, 0.0]])
        shapes.append(Shape(f"finger{number}", body, axis, link.radius - r))
        shapes.append(Shape(f"tip{number}", body, axis[1:], link.radius - r))
        shapes.append(Shape(f"joint{number}", body, axis[:1], link.radius - r))
    return shapes


def list_pairs(scene: Scene) -> list[Pair]:
    """Every pair of shapes that may touch."""
    count = range(scene.polygon.n_vertices)
    pairs = [Pair(f"v{i}", PALM, scene.friction.palm) for i in count]
    for number, friction in enumerate((scene.friction.finger1, scene.friction.finger2), 1):
        pairs += [Pair(f"v{i}", f"finger{number}", friction) for i in count]
        circles = f"tip{number}", f"joint{number}"
        pairs += [Pair(f"e{j}", circle, friction) for circle in circles for j in count]
    if scene.fingers_collide:
        pairs.append(Pair("finger1", "finger2", 0.0))
    return pairs


def find_pairs(contact: str, corners: int) -> tuple[str, ...]:
    """Pairs of shapes of a contact; of a vertex on a tip's arc also both edges."""
    corner, part = contact.split("-")
    if corner[0] == "e" or not part.startswith("tip"):
        return (contact,)
    index, finger = int(corner[1:]), part[3:]
    edges = [f"e{k % corners}-tip{finger}" for k in (index - 1, index)]
    return (f"{corner}-finger{finger}", *edges)


TOLERANCE = 1e-4  # of the replay in its own problem, over the scene's length and in rad
ROWS = 200  # approximate rows of a result per phase
_SAMPLES = 8  # samples of torques of each step for their mean


class EngineStretch(NamedTuple):
    """A part of a plan that is replayed alone: one phase, or all."""

    phases: tuple[int, ...]  # indices of its phases, from 0
    start: float  # start, stop [s]
    stop: float
    z: Array  # z, z_dot, z_ddot (5,): the planned motion at its start
    z_dot: Array
    z_ddot: Array
    c_n: Mapping[str, float]  # planned normal forces at its start by contacts [N]

    @property
    def numbers(self) -> list[int]:
        """Numbers of its phases, from 1."""
        return [index + 1 for index in self.phases]

    @property
    def name(self) -> str:
        """Numbers of the phases, first to last."""
        return "-".join(map(str, dict.fromkeys((self.numbers[0], self.numbers[-1]))))

    @property
    def duration(self) -> float:
        """Planned duration [s]."""
        return self.stop - self.start


class Setting(NamedTuple):
    """Discretization of an engine."""

    step: float = 1.6e-4  # time step, over the scene's time: 1e-5 s in the scenes of `problems/`
    softness: float = 1.0  # of contacts, over the engine's default, which is proportional to step


class Steps(NamedTuple):
    """Time steps of a stretch.

    Engines use the semi-implicit Euler method, which is of second order in h if velocities are
    those half a step before positions: at the start, and for the torques.
    """

    h: float  # [s]
    v: Array  # (5,): velocity half a step before the start
    tau: Array  # (n, 2) [N m]: torques, averaged over half a step before and after each position
    ends: list[int]  # numbers of the steps after which the state is recorded; the last is n
    drive: EngineDrive | None  # torques by feedback; those of `tau` are zero then


class EngineRun(NamedTuple):
    """A stretch in an engine."""

    t: Array  # (rows + 1,) [s]: from the start of the plan
    z: Array  # z, z_dot (rows + 1, 5)
    z_dot: Array
    pairs: tuple[str, ...]  # pairs of shapes, as of `list_pairs`
    press: Array  # (rows, n_pairs) [N]: normal forces, averaged between rows

    def find_columns(self, contact: str, scene: Scene) -> list[int]:
        """Numbers of the pairs that are one contact."""
        return [self.pairs.index(name) for name in find_pairs(contact, scene.polygon.n_vertices)]

    def cut(self, rows: Numbers, gained: Contact | None, scene: Scene) -> NDArray[Any]:
        """Rows of a phase up to the first force of the contact that it gains."""
        if gained is None:
            return rows
        # Forces before a row are stored in the row before it.
        forces = self.press[np.maximum(rows - 1, 0)][:, self.find_columns(gained.name, scene)]
        return rows[: int(np.argmax(np.append(forces.any(axis=1), True)))]


Drive = TorqueProfile | ClosedLoop  # torques in open loop, or by feedback
Engine = Callable[[Problem, EngineStretch, Drive, Setting], EngineRun]
"""Simulates a stretch under torques, or by feedback until the motion is over."""


def list_stretches(plan: Trajectory, firsts: Sequence[int]) -> list[EngineStretch]:
    """Parts of a plan, each from the planned start of a phase in `firsts` to the next one."""
    starts, stretches = plan.phase_starts, []
    for begin, after in pairwise([*firsts, len(plan.motions)]):
        motion, start, stop = plan.motions[begin], starts[begin], starts[after]
        at = motion.evaluate(np.linspace(0.0, motion.duration, ROWS))
        # Forces of a replay are NaN while it dwells at rest.
        c_n = np.nan_to_num(at.c_n[int(np.argmax(np.isfinite(at.c_n).all(axis=1)))])
        forces = dict(zip(motion.contacts, c_n.tolist(), strict=True))
        span = tuple(range(begin, after)), float(start), float(stop)
        stretches.append(EngineStretch(*span, at.z[0], at.z_dot[0], at.z_ddot[0], forces))
    return stretches


def list_steps(
    problem: Problem, stretch: EngineStretch, torque: Drive, step: float, every: int = 1
) -> Steps:
    """Even steps that fit a stretch, none longer than `step` times the scene's time.

    Feedback is evaluated once in `every` steps.
    """
    duration = stretch.stop - stretch.start
    # Oscillations of contacts after a jump of torques need many steps.
    count = max(int(np.ceil(duration / (step * problem.scene.scales.time) - 1e-9)), 5000)
    h = duration / count
    tau, drive = np.zeros((count, 2)), None
    if isinstance(torque, ClosedLoop):
        drive = EngineDrive(problem.scene, torque, duration, every * h)
    else:
        t = (np.arange(count * _SAMPLES) + 0.5) * (h / _SAMPLES) - h / 2
        samples = torque.at(stretch.start + np.maximum(t, 1e-3 * h))
        tau = np.asarray(samples.reshape(count, _SAMPLES, 2).mean(axis=1))
    v = stretch.z_dot - h / 2 * stretch.z_ddot
    rows = min(count, ROWS * len(stretch.phases))
    ends = np.linspace(0, count, rows + 1)[1:].astype(int).tolist()
    return Steps(h, v, tau, ends, drive)


def record(
    stretch: EngineStretch,
    steps: Steps,
    pairs: Sequence[Pair],
    advance: Callable[[int, int], Array],
    read: Callable[[], tuple[Array, Array]],
) -> EngineRun:
    """Run an engine to the end of its steps, or until its policy is over.

    `advance` simulates from one step to another, and returns the mean forces of the pairs [N];
    `read` returns z and z_dot, (5,) each.
    """
    states, forces, start = [(stretch.z, stretch.z_dot)], [], 0
    for end in steps.ends:
        forces.append(advance(start, end))
        states.append(read())
        start = end
        if steps.drive is not None and steps.drive.loop.over:
            break
    z, z_dot = (np.array(part) for part in zip(*states, strict=True))
    t = stretch.start + steps.h * np.array([0, *steps.ends[: len(forces)]])
    return EngineRun(t, z, z_dot, tuple(pair.name for pair in pairs), np.array(forces))


def apply_friction(scene: Scene, plan: Trajectory) -> TorqueProfile:
    """The torques of a plan less the dry friction D sgn(theta') of its joint velocities."""
    torque, reversals = plan.torque, list[Array]()
    for start, motion in zip(plan.phase_starts[:-1], plan.motions, strict=True):
        t = np.linspace(0.0, motion.duration, 2000)
        for rates in motion.evaluate(t).z_dot[:, 3:].T:
            rows = np.flatnonzero(rates[1:-2] * rates[2:-1] < 0) + 1
            fraction = rates[rows] / (rates[rows] - rates[rows + 1])
            reversals.append(start + t[rows] + fraction * (t[rows + 1] - t[rows]))
    breaks = sort_unique(np.concatenate([torque.breaks, *reversals]))
    breaks = breaks[np.append(True, np.diff(breaks) > 1e-12 * torque.duration)]
    breaks[-1] = torque.breaks[-1]
    friction = np.sign(plan.at((breaks[1:] + breaks[:-1]) / 2).z_dot[:, 3:]) * scene.dry[3:]

    def evaluate(t: Array) -> Array:
        piece = np.searchsorted(breaks, t, side="right") - 1
        return np.asarray(torque.at(t) - friction[piece])

    return TorqueProfile.fit(breaks, evaluate, torque.coefficients.shape[2] - 1)


def find_reference(plan: Trajectory) -> Trajectory:
    """The replay of a plan in its own problem, or the plan if the replay differs from it."""
    starts = plan.phase_starts
    times = np.linspace(starts[:-1], starts[1:], 400)
    try:
        problem = read_stored_problem(plan.meta)
        replay = simulate(problem, plan.torque, times=times.ravel()).trajectory
    except WholearmError:
        return plan
    if len(replay.motions) != len(plan.motions):
        return plan
    delay = np.abs(replay.phase_starts - starts).max()
    times = np.clip(plan.t, 0.0, replay.duration)
    error = np.abs(replay.at(times).z - plan.z) / [*2 * [problem.scene.scales.length], 1, 1, 1]
    # Rest is approached slowly: ends of phases may differ more.
    agrees = delay < 1e-3 * problem.scene.scales.time and error.max() < TOLERANCE
    return replay if agrees else plan


def penetrate_start(
    problem: Problem, stretch: EngineStretch, stiffness: Mapping[str, float] | None = None
) -> Array:
    """The planned start with penetrations of planned force over stiffness, shape (5,).

    It is the nearest such configuration in the metric of the kinetic energy. Contacts without a
    force, such as released ones, get a small gap, as oscillations at the start would hit them.

    `stiffness` is that of each pair of shapes [N/m]; without it all penetrations are small.
    """
    scene, formation = problem.scene, problem.phases[stretch.phases[0]].formation
    touching = find_touching(scene, stretch.z)
    contacts = formation.contacts + tuple(c for c in touching if c not in formation.contacts)
    A = Formation(scene, contacts).evaluate(stretch.z[None], stretch.z_dot[None]).A[0]
    weight = 1 / np.sqrt(scene.mass_diagonal)
    # Other contacts only if independent: rows of contacts at one place are equal but for rounding.
    independent, count = IndependentRows(0.1), formation.n_contacts
    rows = [k for k, row in enumerate(A * weight) if independent.add(row) or k < count]
    depth = scene.scales.length * np.where(np.arange(len(contacts)) < count, 1e-6, -3e-7)
    if stiffness is not None:
        for k, name in enumerate(formation.names):
            total = sum(stiffness[pair] for pair in find_pairs(name, scene.polygon.n_vertices))
            depth[k] = stretch.c_n[name] / total if total else 0.0
    return np.asarray(stretch.z - weight * (np.linalg.pinv((A * weight)[rows]) @ depth[rows]))


class EngineDrive:
    """Torques of a policy in an engine, with sampling, delay and regularized dry friction.

    It lasts for a `duration`, and calls have the distance `h` [s].
    """

    def __init__(self, scene: Scene, loop: ClosedLoop, duration: float, h: float) -> None:
        self.loop, self.h, self.dry = loop, h, scene.dry[3:]
        self.feedback, self.piece = Feedback(loop, duration), 0  # and its pieces so far
        inertia = np.array([finger.inertia for finger in scene.fingers])
        # Dry friction is viscous below ten times its change of the speed in a step.
        self.viscous = inertia / (10.0 * h)

    def step(self, t: float, theta: Array, theta_dot: Array) -> Array:
        """Applied torques at a time, shape (2,) [N m]; times increase from zero."""
        torque = self.feedback.torque
        while t + 0.5 * self.h >= torque.breaks[self.piece] and self.piece < len(torque.breaks) - 1:
            self.feedback.begin(self.piece, theta, theta_dot, {})
            self.piece += 1
        tau = torque.coefficients[self.piece - 1, :, 0]
        return np.asarray(tau - np.clip(self.viscous * theta_dot, -self.dry, self.dry))


PARTS = 5  # equal parts of a stretch at whose ends the error is listed
STICK_RATIO = 0.1  # largest sliding speed of a contact that sticks, over the planned one
LEAST = 0.25  # least considered normal force, over the scene's force: 0.5 N in `problems/`
# Allowed error of the final pose, over the scene's length and in rad; soft contacts cause 2e-3.
ALLOWED = 1e-2


class EngineInfo(NamedTuple):
    """A physics engine."""

    title: str
    package: str  # Python package
    allowed: float  # error of the pose, over the scene's length and in rad


ENGINES = {
    "mujoco": EngineInfo("MuJoCo", "mujoco", 3e-3),
    "drake": EngineInfo("Drake", "pydrake", 1.5e-3),
}
"""In the scenes of `problems/` 3e-3 are 0.1 mm and 0.17 degrees."""


class Force(NamedTuple):
    """The normal force of a contact, averaged over a phase [N]."""

    phase: int
    contact: str
    planned: float
    found: float  # in the engine

    @property
    def off(self) -> float:
        """Error relative to the planned force."""
        return (self.found - self.planned) / self.planned


class Departure(NamedTuple):
    """Comparison of a stretch with the plan."""

    t: Array  # (n,) [s]: from the start of the plan
    position: Array  # (n,) [m]: error of the object's position
    angle: Array  # (n,) [rad]: error of its angle
    forces: tuple[Force, ...]
    time: float | None  # [s]: from which on the error exceeds its limit
    reason: str  # the cause; empty without one


class Level(NamedTuple):
    """Replays with one discretization: a comparison for each stretch."""

    setting: Setting
    departures: tuple[Departure, ...]


@dataclass(frozen=True, eq=False, repr=False)
class EngineReport(Result):
    """Errors and forces of replays in an engine."""

    problem: Problem
    title: str  # the engine and its version
    allowed: float
    stretches: tuple[EngineStretch, ...]
    levels: tuple[Level, ...]  # the chosen setting, then finer ones

    @property
    def ok(self) -> bool:
        """Whether no stretch exceeds the allowed error."""
        return all(departure.time is None for departure in self.levels[0].departures)

    @property
    def converged(self) -> bool:
        """Whether every stretch that departs also does with finer settings."""
        rows = zip(*(level.departures for level in self.levels), strict=True)
        return all(
            first.time is None or all(each.time is not None for each in finer)
            for first, *finer in rows
        )

    @property
    def document(self) -> Document:
        """Errors and forces of each stretch."""
        scales, (setting, departures) = self.problem.scene.scales, self.levels[0]
        millimetres, degrees = self.allowed * scales.length * 1e3, math.degrees(self.allowed)
        worst = max(float(np.max(each.position)) for each in departures) * 1e3
        degrees_worst = math.degrees(max(float(np.max(each.angle)) for each in departures))
        verb = "departs" if self.converged else "departs with some settings only, here"
        lines, errors, forces = list[str](), list[list[Any]](), list[tuple[Any, ...]]()
        for stretch, departure in zip(self.stretches, departures, strict=True):
            if departure.time is not None:
                event = f"at t = {departure.time:.5g} s: {departure.reason}"
                lines.append(f"phase {stretch.name} {verb} {event}")
            times = np.linspace(stretch.start, stretch.stop, PARTS + 1)[1:]
            sampled = np.interp(times, departure.t, departure.position)
            largest = np.max(departure.position), np.max(departure.angle)
            errors.append([stretch.name, stretch.duration, *largest, *sampled])
            for force in departure.forces:
                forces.append((*force, force.off if force.planned > LEAST * scales.force else None))
        levels = [
            [each.setting.step * scales.time, each.setting.softness]
            + [np.max(departure.position) for departure in each.departures]
            for each in (self.levels if len(self.levels) > 1 else ())
        ]
        lines.append(
            f"steps of up to {setting.step * scales.time:.3g} s, softness {setting.softness:g}; "
            "torques contain the dry friction of the joints, with its planned signs"
        )
        form, press = fixed(min(millimetres, 0.09)), fixed(min(scales.force, 9.0), 5)
        columns = [f"{k / PARTS:.0%} [mm]:{form}" for k in range(1, PARTS + 1)]
        names = [f"{stretch.name} [mm]:{form}" for stretch in self.stretches]
        heads = ["phase:d", "duration [s]:.6f", f"largest [mm]:{form}", "[deg]:.4f", *columns]
        means = ["phase:d", "contact", f"planned mean c_n [N]:{press}", f"found [N]:{press}"]
        means.append("off [%]:+.2f")
        finer = ["step [s]:.3g", "softness:g", *names]
        return Document(
            f"{self.problem.name} in {self.title}",
            "ok" if self.ok else "DEPARTS" if self.converged else "NOT CONVERGED",
            f"within {worst:{form}} mm and {degrees_worst:.4f} degrees of the plan "
            f"(allowed {millimetres:.4g} mm, {degrees:.3g} degrees)",
            [*lines, Table(heads, errors), Table(means, forces), Table(finer, levels)],
        )

    @property
    def values(self) -> dict[str, Any]:
        """The values of the JSON document, in m, rad, s and N; null if an engine fails."""
        scales, levels = self.problem.scene.scales, list[dict[str, Any]]()
        for setting, departures in self.levels:
            stretches = list(map(_describe, self.stretches, departures))
            entry = {"step": setting.step * scales.time, "softness": setting.softness}
            levels.append({**entry, "stretches": stretches})
        values = {"problem": self.problem.name, "engine": self.title, "ok": self.ok}
        allowed = {"position": self.allowed * scales.length, "angle": self.allowed}
        return {**values, "converged": self.converged, "allowed": allowed, "levels": levels}


def _describe(stretch: EngineStretch, departure: Departure) -> dict[str, Any]:
    event = {"time": departure.time, "reason": departure.reason}
    return {
        "phases": stretch.numbers,
        "start": stretch.start,
        "stop": stretch.stop,
        "largest": {"position": departure.position.max(), "angle": departure.angle.max()},
        "departs": None if departure.time is None else event,
        **{name: getattr(departure, name) for name in ("forces", "t", "position", "angle")},
    }


def require_engine(name: str) -> Engine:
    """The function of an engine that simulates a stretch.

    InputError if there is no such engine, or it is not installed.
    """
    choice(*ENGINES).read(name, "engine")
    if importlib.util.find_spec(ENGINES[name].package) is None:
        text = f"{name} is not installed; pip install 'wholearm[{name}]'"
        raise InputError("", "engine", text)
    try:
        importlib.import_module(ENGINES[name].package)
    except ImportError as error:
        # For example MuJoCo 4 without mujoco-core.
        raise InputError("", "engine", f"{name}: {' '.join(str(error).split())}") from None
    engine: Engine = importlib.import_module(f".{name}", __package__).play
    return engine


def replay_in(
    engine: str,
    problem: Problem,
    plan: Trajectory | MotionLike,
    *,
    whole: bool = False,
    setting: Setting | None = None,
    allowed: float | None = None,
    halvings: int = 0,
    progress: Callable[[str], None] | None = None,
) -> EngineReport:
    """Replay a plan in open loop in an engine, without prescribed contacts.

    Parameters
    ----------
    engine : {"mujoco", "drake"}
    whole      from start to end; otherwise phase by phase, each from its planned start
    setting    time step and softness of contacts
    allowed    error of the pose, over the scene's length and in rad; by default that of `ENGINES`
    halvings   number of halvings of the step, with harder contacts and with the same

    InputError if the engine is unknown or not installed, the plan is of other phases, or a link has
    no thickness.
    """
    play = require_engine(engine)
    info = ENGINES[engine]
    problem, plan = adopt_motion(problem, plan)
    setting = setting or Setting()
    allowed = info.allowed if allowed is None else allowed
    plan = find_reference(plan)
    torque = apply_friction(problem.scene, plan)
    stretches = list_stretches(plan, [0] if whole else range(len(plan.motions)))
    levels = []
    # Finer settings, then finer steps with the first stiffness of contacts.
    finer = [setting._replace(step=setting.step / 2**k) for k in range(halvings + 1)]
    steps = [level._replace(softness=setting.softness * 2**k) for k, level in enumerate(finer) if k]
    for level in [*finer, *steps]:
        departures = []
        for stretch in stretches:
            if progress is not None:
                progress(f"phase {stretch.name} in {info.title}, step {level.step:.3g}")
            run = play(problem, stretch, torque, level)
            departures.append(compare(problem, plan, stretch, run, allowed))
        levels.append(Level(level, tuple(departures)))
    title = f"{info.title} {version(engine)}"
    return EngineReport(problem, title, allowed, tuple(stretches), tuple(levels))


def compare(
    problem: Problem, plan: Trajectory, stretch: EngineStretch, run: EngineRun, allowed: float
) -> Departure:
    """Compare a replay with the plan.

    `allowed` is the largest error of the position over the scene's length, and of the angle in rad.
    """
    length, starts = problem.scene.scales.length, plan.phase_starts
    # Each phase includes the row at its end.
    phase_index = np.searchsorted(starts[1:-1], run.t, side="left")
    phase_index = np.clip(phase_index, stretch.phases[0], stretch.phases[-1])
    phase_index[0] = stretch.phases[0]
    error, forces = np.empty_like(run.z), list[Force]()
    changes = list[tuple[float, float, str]]()
    for index in stretch.phases:
        phase, motion = problem.phases[index], plan.motions[index]
        rows, t = np.flatnonzero(phase_index == index), run.t - starts[index]
        planned = motion.evaluate(np.clip(t[rows], 0.0, motion.duration))
        error[rows] = run.z[rows] - planned.z
        forces += _average(phase, motion, t, rows, run)
        changes += _list_changes(phase, planned, rows, run, allowed * length)
    position, angle = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    exceeding = np.flatnonzero(~(np.maximum(position / length, angle) <= allowed))
    if not len(exceeding):
        return Departure(run.t, position, angle, tuple(forces), None, "")
    time = float(run.t[exceeding[0]])
    before = [change for change in changes if change[0] <= time]
    # The first one that lasts until that time, or else the last one before it.
    lasting = [change for change in before if change[1] >= time]
    reason = "every contact is as planned"
    if before:
        start, _, deviation = min(lasting) if lasting else max(before, key=lambda change: change[1])
        reason = f"{deviation} at t = {start:.5g} s"
    return Departure(run.t, position, angle, tuple(forces), time, reason)


def _average(phase: Phase, motion: Motion, t: Array, rows: Numbers, run: EngineRun) -> list[Force]:
    """Planned and actual normal forces of a phase, averaged until the gained contact closes.

    Its gap closes at a vanishing speed: a small error of the pose closes it early. `t` are times
    of the run from the start of the phase, `rows` those of the phase.
    """
    scene, inner = phase.formation.scene, rows[rows > 0]
    closed_before = run.cut(inner, phase.until.contact, scene)
    closed_before = closed_before if len(closed_before) else inner[:1]
    middles = (np.arange(2000) + 0.5) / 2000 * min(t[closed_before[-1]], motion.duration)
    planned = np.nanmean(motion.evaluate(middles).c_n, axis=0).tolist()
    weights = np.diff(run.t)[closed_before - 1]
    press = weights @ run.press[closed_before - 1] / weights.sum()
    mean_forces = [float(press[run.find_columns(name, scene)].sum()) for name in motion.contacts]
    means = zip(motion.contacts, planned, mean_forces, strict=True)
    return [Force(phase.number, *mean) for mean in means]


def _list_changes(
    phase: Phase, planned_motion: Samples, rows: Numbers, run: EngineRun, departure: float
) -> Iterator[tuple[float, float, str]]:
    """Deviations of contacts from the plan in a phase: start and end [s], and description."""
    formation, scales = phase.formation, phase.formation.scene.scales
    flags = list[tuple[str, Flags, Array]]()
    t, moves = run.t[rows], 2e-3 * scales.speed
    actual = formation.evaluate(run.z[rows], run.z_dot[rows])
    planned = formation.evaluate(planned_motion.z, planned_motion.z_dot)
    slides = np.einsum("nij,nj->ni", actual.A_t, run.z_dot[rows])
    planned_slides = np.einsum("nij,nj->ni", planned.A_t, planned_motion.z_dot)
    pressing = run.press[rows[rows > 0] - 1].copy()
    for k, name in enumerate(formation.names):
        pressing[:, run.find_columns(name, formation.scene)] = 0.0
        flags.append((f"{name} opens", actual.C[:, k] > 0.1 * departure, t))
        slide, planned_slide = np.abs(slides[:, k]), np.abs(planned_slides[:, k])
        if k in formation.rolling_rows:
            flags.append((f"{name} slips", slide > moves, t))
        else:
            sticking = (planned_slide > moves) & (slide < STICK_RATIO * planned_slide)
            flags.append((f"{name} sticks", sticking, t))
    for name, force in zip(run.pairs, pressing.T, strict=True):
        hits = force > LEAST * scales.force
        flags.append((f"{name} presses, which is not planned,", hits, run.t[rows[rows > 0]]))
    for text, mask, times in flags:
        for span in find_runs(mask):
            yield float(times[span.start]), float(times[span.stop - 1]), text


class StretchEnd(NamedTuple):
    """End of a stretch that a policy carries out in an engine."""

    stretch: EngineStretch
    duration: float  # [s]: until the joints are at rest at the end
    over: bool  # whether they came to rest
    position: float  # [m]: final error of the object's position
    angle: float  # [rad]: final error of its angle
    contact: str  # the planned contact with the largest gap during its phase
    gap: float  # [m]: this gap


@dataclass(frozen=True, eq=False, repr=False)
class PolicyReport(Result):
    """Final errors of a policy in an engine; `allowed` is over the scene's length and in rad."""

    problem: Problem
    title: str
    allowed: float
    arrivals: tuple[StretchEnd, ...]

    @property
    def ok(self) -> bool:
        """Whether every stretch ends, at the planned pose."""
        return all(self.find_failure(end) is None for end in self.arrivals)

    def find_failure(self, end: StretchEnd) -> str | None:
        """Description of a failure, or None."""
        error = max(end.position / self.problem.scene.scales.length, end.angle)
        if not error <= self.allowed:
            text = f"{end.position * 1e3:.3g} mm and {math.degrees(end.angle):.3g} degrees"
            return f"phase {end.stretch.name} ends {text} away from the plan"
        if not end.over:
            return f"phase {end.stretch.name} does not end within {end.duration:.4g} s"
        return None

    @property
    def document(self) -> Document:
        """Durations and final errors."""
        form = fixed(min(1e3 * self.allowed * self.problem.scene.scales.length, 0.09))
        columns = {
            "stretch.name": "phase:d", "stretch.duration": "plan [s]:.6f",
            "duration": "policy [s]:.6f", "position": f"end off [mm]:{form}", "angle": "[deg]:.4f",
            "gap": f"largest gap [mm]:{form}", "contact": "",
        }  # fmt: skip
        failures = [self.find_failure(end) or "" for end in self.arrivals]
        title = f"{self.problem.name} in {self.title}, by the policy"
        verdict, table = "ok" if self.ok else "FAILS", Table.of(self.arrivals, columns)
        return Document(title, verdict, parts=[*failures, table])

    @property
    def values(self) -> dict[str, Any]:
        """The values of the JSON document, in m, rad and s."""
        stretches = [{"phases": end.stretch.numbers, **end._asdict()} for end in self.arrivals]
        for stretch in stretches:
            del stretch["stretch"]
        values = {"problem": self.problem.name, "engine": self.title, "ok": self.ok}
        return {**values, "allowed": self.allowed, "stretches": stretches}


def play_policy(
    engine: str,
    problem: Problem,
    plan: Trajectory | MotionLike,
    policy: Policy,
    *,
    whole: bool = False,
    setting: Setting | None = None,
    allowed: float = ALLOWED,
    progress: Callable[[str], None] | None = None,
) -> PolicyReport:
    """Simulate a policy in an engine, without prescribed contacts.

    Parameters
    ----------
    engine : {"mujoco", "drake"}
    plan                        start and end of each phase
    whole                       from start to end; otherwise from each phase that begins at rest
    setting, allowed, progress  as of `replay_in`

    InputError if the engine is unknown or not installed, or the policy is of other phases.
    """
    problem, plan = adopt_motion(problem, plan)
    play = require_engine(engine)
    policy.require_count(len(problem.phases), "problem")
    info = ENGINES[engine]
    setting = setting or Setting()
    arrivals = []
    # From rest; at these instants the replay may still move slowly.
    firsts, zero = [0] if whole else [number - 1 for number in policy.resting], np.zeros(5)
    for stretch in list_stretches(find_reference(plan), firsts):
        stretch = stretch._replace(z_dot=zero, z_ddot=zero)
        if progress is not None:
            progress(f"phase {stretch.name} in {info.title}")
        last = stretch.phases[-1] + 1
        loop = ClosedLoop(policy.cut(last), stretch.phases[0] + 1)
        until = stretch.start + loop.find_limit(last)
        run = play(problem, stretch._replace(stop=until), loop, setting)
        arrivals.append(_judge(problem, plan, stretch, loop, run))
    title = f"{info.title} {version(engine)}"
    return PolicyReport(problem, title, allowed, tuple(arrivals))


def _judge(
    problem: Problem, plan: Trajectory, stretch: EngineStretch, loop: ClosedLoop, run: EngineRun
) -> StretchEnd:
    """Final error of a run, and the planned contact with the largest gap."""
    goal = plan.z[np.flatnonzero(plan.phase == stretch.phases[-1])[-1]]
    error, t = np.abs(run.z[-1] - goal), run.t - stretch.start
    position, angle = float(np.hypot(*error[:2])), float(error[2])
    starts = [loop.phase_starts.get(index + 1, np.inf) for index in stretch.phases]
    contact, gap = "", 0.0
    for index, start, stop in zip(stretch.phases, starts, [*starts[1:], np.inf], strict=True):
        phase = problem.phases[index]
        rows = np.flatnonzero((t >= start) & (t < stop))
        rows = run.cut(rows, phase.until.contact, problem.scene)
        gaps = phase.formation.evaluate(run.z[rows], run.z_dot[rows]).C
        if gaps.size and gaps.max() > gap:
            gap = float(gaps.max())
            contact = phase.formation.names[int(gaps.max(axis=0).argmax())]
    return StretchEnd(stretch, float(t[-1]), loop.over, position, angle, contact, gap)
