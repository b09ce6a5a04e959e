"""Interface of physics engines: shapes of a scene, parts of a plan, time steps, torques, results.

Engines know no points and no lines, only balls and capsules. Those of the object get the radius r
(`find_rounding`), and what they touch is that much thinner, so that gaps are the C-functions:

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

Pairs have the friction of palm or finger. A tip that passes a vertex touches that and the ends of
both edges at one place. The links press each other without friction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array, Independent, Numbers, sort_unique
from ..common.errors import InputError, WholearmError
from ..contacts.elemental import Contact
from ..contacts.formation import Formation, find_touching
from ..policy.playback import ClosedLoop
from ..problem.definition import Problem
from ..problem.read import read_own_problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
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
    """Two shapes, or a shape and the palm, that may touch; it has the name of their contact."""

    first: str
    second: str
    friction: float

    @property
    def name(self) -> str:
        """First and second, as contacts are named."""
        return f"{self.first}-{self.second}"


def find_rounding(scene: Scene) -> float:
    """Radius of vertices and edges [m]; the palm is that much lower."""
    return 1e-7 * scene.scales.length


def list_shapes(scene: Scene) -> list[Shape]:
    """Every shape of object and links.

    InputError if a link has no thickness: what sinks into it would come out on the other side.
    """
    r, corners = find_rounding(scene), scene.polygon.vertices
    after = np.roll(corners, -1, axis=0)
    shapes = [Shape(f"v{i}", OBJECT, corner[None], r) for i, corner in enumerate(corners)]
    shapes += [
        Shape(f"e{j}", OBJECT, np.array(ends), r)
        for j, ends in enumerate(zip(corners, after, strict=True))
    ]
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
        pairs += [Pair(f"e{j}", f"tip{number}", friction) for j in count]
        pairs += [Pair(f"e{j}", f"joint{number}", friction) for j in count]
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


SAME = 1e-4  # difference of replay and plan that counts as none, over the scene's length and in rad
ROWS = 200  # approximate rows of a result per phase
_LOOKS = 8  # samples of each step over which torques are averaged


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
    softness: float = 1.0  # of contacts, over the engine's default, which is in proportion to step


class Steps(NamedTuple):
    """Time steps of a stretch.

    Engines use the semi-implicit Euler method, which is of second order in h if velocities are read
    as those of half a step before: at the start, and for the torques.
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
    pairs: tuple[str, ...]  # pairs of shapes, see `shapes.list_pairs`
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


Drive = TorqueProfile | ClosedLoop  # torques that are applied, or by feedback
Engine = Callable[[Problem, EngineStretch, Drive, Setting], EngineRun]
"""Replays a stretch under the torques that are applied, or by feedback until the motion is over."""


def list_stretches(plan: Trajectory, begins: Sequence[int]) -> list[EngineStretch]:
    """Parts of a plan, from its planned start at each of the phases `begins` to the next one."""
    starts, stretches = plan.phase_starts, []
    for first, after in pairwise([*begins, len(plan.motions)]):
        motion, start, stop = plan.motions[first], starts[first], starts[after]
        at = motion.evaluate(np.linspace(0.0, motion.duration, ROWS))
        # Forces of a replay that waits at rest are NaN.
        c_n = np.nan_to_num(at.c_n[int(np.argmax(np.isfinite(at.c_n).all(axis=1)))])
        forces = dict(zip(motion.contacts, c_n.tolist(), strict=True))
        span = tuple(range(first, after)), float(start), float(stop)
        stretches.append(EngineStretch(*span, at.z[0], at.z_dot[0], at.z_ddot[0], forces))
    return stretches


def list_steps(
    problem: Problem, stretch: EngineStretch, torque: Drive, step: float, every: int = 1
) -> Steps:
    """Even steps that fit a stretch, none longer than `step` times the scene's time.

    Feedback is asked `every` so many steps.
    """
    duration = stretch.stop - stretch.start
    # Contacts oscillate after a jump of torques: that takes some steps.
    count = max(int(np.ceil(duration / (step * problem.scene.scales.time) - 1e-9)), 5000)
    h = duration / count
    tau, drive = np.zeros((count, 2)), None
    if isinstance(torque, ClosedLoop):
        drive = EngineDrive(problem.scene, torque, duration, every * h)
    else:
        t = (np.arange(count * _LOOKS) + 0.5) * (h / _LOOKS) - h / 2
        samples = torque.at(stretch.start + np.maximum(t, 1e-3 * h))
        tau = np.asarray(samples.reshape(count, _LOOKS, 2).mean(axis=1))
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

    `advance` takes the steps from one number to another, and returns the mean forces of the pairs
    [N]; `read` returns z and z_dot, (5,) each.
    """
    states, press, start = [(stretch.z, stretch.z_dot)], [], 0
    for end in steps.ends:
        press.append(advance(start, end))
        states.append(read())
        start = end
        if steps.drive is not None and steps.drive.loop.over:
            break
    z, z_dot = (np.array(part) for part in zip(*states, strict=True))
    t = stretch.start + steps.h * np.array([0, *steps.ends[: len(press)]])
    return EngineRun(t, z, z_dot, tuple(pair.name for pair in pairs), np.array(press))


def apply_friction(scene: Scene, plan: Trajectory) -> TorqueProfile:
    """The torques of a plan less D sgn(theta') of its own joint velocities, with its steps."""
    torque, reversals = plan.torque, list[Array]()
    for start, motion in zip(plan.phase_starts[:-1], plan.motions, strict=True):
        t = np.linspace(0.0, motion.duration, 2000)
        for speed in motion.evaluate(t).z_dot[:, 3:].T:
            back = np.flatnonzero(speed[1:-2] * speed[2:-1] < 0) + 1
            share = speed[back] / (speed[back] - speed[back + 1])
            reversals.append(start + t[back] + share * (t[back + 1] - t[back]))
    cuts = sort_unique(np.concatenate([torque.breaks, *reversals]))
    cuts = cuts[np.append(True, np.diff(cuts) > 1e-12 * torque.duration)]
    cuts[-1] = torque.breaks[-1]
    turns = np.sign(plan.at((cuts[1:] + cuts[:-1]) / 2).z_dot[:, 3:]) * scene.dry[3:]

    def evaluate(t: Array) -> Array:
        piece = np.searchsorted(cuts, t, side="right") - 1
        return np.asarray(torque.at(t) - turns[piece])

    return TorqueProfile.fit(cuts, evaluate, torque.coefficients.shape[2] - 1)


def find_between(plan: Trajectory) -> Trajectory:
    """The replay of a plan in its own problem, or the plan itself where that is not the same."""
    starts = plan.phase_starts
    times = np.linspace(starts[:-1], starts[1:], 400)
    try:
        problem = read_own_problem(plan.meta)
        replay = simulate(problem, plan.torque, times=times.ravel()).trajectory
    except WholearmError:
        return plan
    if len(replay.motions) != len(plan.motions):
        return plan
    late = np.abs(replay.phase_starts - starts).max()
    inside = np.clip(plan.t, 0.0, replay.duration)
    error = np.abs(replay.at(inside).z - plan.z) / [*2 * [problem.scene.scales.length], 1, 1, 1]
    # Rest is approached slowly: ends of phases may differ more.
    same = late < 1e-3 * problem.scene.scales.time and error.max() < SAME
    return replay if same else plan


def press_in(problem: Problem, stretch: EngineStretch, stiffness: Mapping[str, float]) -> Array:
    """The planned start with penetrations of planned force over stiffness [N/m], shape (5,).

    It is the nearest such configuration in the metric of the kinetic energy. Contacts without a
    force, such as released ones, get a small gap: oscillations at the start would hit them.
    """
    scene, formation = problem.scene, problem.phases[stretch.phases[0]].formation
    touching = find_touching(scene, stretch.z)
    contacts = formation.contacts + tuple(c for c in touching if c not in formation.contacts)
    A = Formation(scene, contacts).evaluate(stretch.z[None], stretch.z_dot[None]).A[0]
    weight = 1 / np.sqrt(scene.mass_diagonal)
    # Of others what is independent: contacts at one place share all of their rows but rounding.
    independent, count = Independent(0.1), formation.n_contacts
    rows = [k for k, row in enumerate(A * weight) if independent.add(row) or k < count]
    depth = np.full(len(contacts), -3e-7 * scene.scales.length)
    for k, name in enumerate(formation.names):
        depth[k] = stretch.c_n[name] / stiffness[name]
    return np.asarray(stretch.z - weight * (np.linalg.pinv((A * weight)[rows]) @ depth[rows]))


class EngineDrive:
    """Torques of a policy in an engine, sampled, delayed, and less regularized dry friction.

    It lasts for a `duration`, and two calls are `h` apart [s].
    """

    def __init__(self, scene: Scene, loop: ClosedLoop, duration: float, h: float) -> None:
        self.loop, self.h, self.dry = loop, h, scene.dry[3:]
        self.feedback, self.begun = Feedback(loop, duration), 0  # and its pieces so far
        inertia = np.array([finger.inertia for finger in scene.fingers])
        # Regularization speed of dry friction: ten times what it changes in a step.
        self.creep = np.maximum(10.0 * self.dry * h / inertia, np.finfo(float).tiny)

    def step(self, t: float, theta: Array, theta_dot: Array) -> Array:
        """Applied torques at a time, shape (2,) [N m]; times increase from zero."""
        torque = self.feedback.torque
        while t + 0.5 * self.h >= torque.breaks[self.begun] and self.begun < len(torque.breaks) - 1:
            self.feedback.begin(self.begun, theta, theta_dot, {})
            self.begun += 1
        tau = torque.coefficients[self.begun - 1, :, 0]
        return np.asarray(tau - self.dry * np.clip(theta_dot / self.creep, -1.0, 1.0))
