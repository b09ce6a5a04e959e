"""Hexagons between fingers that meet, thrown squares, and a box that tips over a vertex."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache, lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import quad

from once import once
from plane import make_formation, make_scene, rotate
from shipped import BOX, HEXAGON, plan_of, problem_of
from wholearm import End, Friction, Phase, Plan, Problem, Scene, TorqueProfile, Trajectory, Until
from wholearm.benchmark.refusals import separate
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger, place_flush
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation, find_touching
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem


@cache
def hexagon(
    lengths: tuple[float, float] = (0.18, 0.18), base: float = -0.08, solid: bool = True
) -> Problem:
    """The hexagon's problem; with links of equal length they touch halfway through the slide."""
    changes = {"length1": lengths[0], "length2": lengths[1], "fingers.2.base[1]": base}
    return problem_of(HEXAGON).with_(changes | {"fingers_collide": solid})


@once
def slid() -> Plan:
    """The hexagon's phases before it tips, the last of them to rest."""
    whole = problem_of(HEXAGON)
    *moving, last = whole.phases[:3]
    phases = (*moving, replace(last, end=End.REST))
    return solve(replace(whole, phases=phases), intervals=20, replay=False)


@cache
def make_way(solid: bool) -> Problem:
    """Finger 2 pushes the hexagon below a free finger 1, which has to make way for the other."""
    push = {"contacts": ["v0-palm", "v1-palm", "v5-finger2"], "until": {"x": 0.0}}
    changes = {"length": 0.19, "fingers.2.base[1]": -0.085, "x": -0.03, "phases": [push]}
    return problem_of(HEXAGON).with_(changes | {"fingers_collide": solid})


def measure_fingers(scene: Scene, z: Array) -> Array:
    """Gap between the links, shape (n,) [m]; negative: minus the least push that parts them."""
    segments = []
    for link, angle in zip(scene.fingers, z[:, 3:].T, strict=True):
        base = np.broadcast_to(np.asarray(link.base), (len(z), 2))
        tip = base + link.length * np.column_stack([np.cos(angle), np.sin(angle)])
        segments.append(np.stack([base, tip], axis=1))
    return separate(*segments) - sum(link.radius for link in scene.fingers)


LEVER = 0.03 * np.sqrt(2.0)
"""From the centroid of the square to a vertex [m]."""


@cache
def shove(run: float = 0.01, mu: float = 0.3) -> tuple[Problem, float]:
    """Finger 1 pushes the square over the palm, on which it then slides `run` [m] to rest.

    Two contacts, three freedoms: the square's x and both fingers. And the time that takes [s].
    """
    scene = make_scene(friction=mu)
    start = _close(scene, place_flush(scene, 0, 0.02), 0.6)
    phases = _let_go(scene, start, 2, 3, Until(None, "x", run), Until(None, "x", 0.0))
    return Problem("shove", scene, 0.05, start, phases), float(np.sqrt(2 * run / (mu * 9.81)))


@cache
def heave(turn: float = 0.15) -> tuple[Problem, float]:
    """Finger 1 heaves the square over vertex 0, which rolls; it then rises by `turn` [rad] to rest.

    One rolling contact, three freedoms: phi and both fingers. And the time that takes [s].
    """
    scene = _with_palm(0.1, 3.0)
    start = _close(scene, _tip(scene, 0.15), 0.6)
    ends = Until(None, "phi", 0.4 - turn), Until(None, "phi", 0.4)
    phases = _let_go(scene, start, 1, 2, *ends, rolls=True)
    return Problem("heave", scene, 0.05, start, phases), _rising_time(0.4 - turn, 0.4, True)


@cache
def lift(turn: float = 0.02) -> tuple[Problem, float]:
    """Both fingers lift the square over vertex 0, which then slides without friction.

    It rises by `turn` [rad] to rest, straight up, as nothing pushes it along the palm. One sliding
    contact, four freedoms: x, phi and both fingers. And the time that takes [s].
    """
    scene = _with_palm(0.02, 0.0)
    start = _close(scene, _tip(scene, 0.3), 0.0)
    ends = Until(None, "phi", 0.4), Until(None, "phi", 0.4 + turn)
    phases = _let_go(scene, start, 1, 3, *ends)
    return Problem("lift", scene, 0.05, start, phases), _rising_time(0.4, 0.4 + turn, False)


@cache
def raised(stop: float = 0.5) -> Problem:
    """Both fingers turn the square over vertex 0 to `stop` [rad], from rest to rest.

    The vertex slides without friction, so that either finger may go either way.
    """
    problem, _ = lift()
    phase = Phase(0, problem.phases[0].formation, Until(None, "phi", stop))
    return replace(problem, name="raise", phases=(phase,))


def _with_palm(fingers: float, palm: float) -> Scene:
    scene = make_scene()
    return Scene(scene.polygon, scene.fingers, Friction(palm, fingers, fingers), scene.gravity)


def _tip(scene: Scene, phi: float) -> Array:
    """Pose with vertex 0 on the palm at x = 0.03 m."""
    return np.append([0.03, 0.0] - rotate(phi, scene.polygon.vertices[0]), phi)


def _close(scene: Scene, q: Array, away: float) -> Array:
    """Configuration with finger 1 closed and finger 2 turned `away` [rad] from the object."""
    return np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1) + away])


def _let_go(
    scene: Scene, z: Array, kept: int, count: int, first: Until, then: Until, rolls: bool = False
) -> tuple[Phase, Phase]:
    """Phases on the first `count` contacts that touch, and then on the first `kept` of them."""
    touching = find_touching(scene, z)
    assert len(touching) == count
    rolling = (parse_contact("v0-palm", scene),) if rolls else ()
    before, after = (Formation(scene, touching[:n], rolling) for n in (count, kept))
    return Phase(0, before, first, End.SMOOTH), Phase(1, after, then)


def _rising_time(start: float, stop: float, rolls: bool) -> float:
    """Time in which the square rises over vertex 0 from `start` to rest at `stop` [s].

    Its energy is kept. A vertex that rolls stays, one without friction stays below a centroid that
    rises straight.
    """
    body = make_scene().polygon
    assert body.inertia is not None
    inertia, mass = body.inertia, body.mass

    def slowness(s: float) -> float:
        # phi = stop - s^2 takes away the singularity at the end.
        angle, end = stop - s * s + np.pi / 4, stop + np.pi / 4
        share = 1.0 if rolls else np.cos(angle) ** 2
        rise = mass * 9.81 * LEVER * (np.sin(end) - np.sin(angle))
        return float(2 * s * np.sqrt((inertia + mass * LEVER**2 * share) / (2 * rise)))

    return float(quad(slowness, 0.0, np.sqrt(stop - start))[0])


POINTS = [[-0.02, -0.05], [0.02, -0.05], [0.02, 0.05], [-0.02, 0.05]]
"""A slender box; fallen over vertex 1, its centroid is ever farther right of it."""


def box() -> Problem:
    return problem_of(BOX)


def tipped() -> Trajectory:
    """The plan of the box for least time."""
    return plan_of(BOX)


PALM = box().scene.friction.palm
"""Friction with the palm."""


def tip() -> Curve:
    """The curve of the phase in which the box tips over vertex 1."""
    return trace_phases(box())[1]


@lru_cache(maxsize=1)
def tilting() -> Problem:
    """That phase alone, in which the vertex may slide as well."""
    problem = box().with_(friction_palm=0.5, torque_limit=2.0)
    formation = replace(problem.phases[1].formation, rolling=())
    phase = Phase(0, formation, problem.phases[1].until)
    return replace(problem, start=trace_phases(problem)[0].end, phases=(phase,))


def roll(formation: Formation, *names: str) -> Formation:
    """The formation with some of its contacts rolling."""
    rolling = tuple(contact for contact in formation.contacts if contact.name in names)
    assert len(rolling) == len(names)
    return replace(formation, rolling=rolling)


def falling(mu: float, lean: float) -> Problem:
    """A box that falls over vertex 1, with both fingers far away and without friction.

    At first the line from vertex 1 to the centroid leans by `lean` [rad] to the right of upright.
    """
    scene = make_scene(POINTS, base=0.4)
    free = [replace(link, viscous=0.0, dry=0.0) for link in scene.fingers]
    scene = Scene(scene.polygon, (free[0], free[1]), Friction(mu, 0.1, 0.1))
    phi = -lean - np.arctan2(0.02, 0.05)
    start = np.array([*-rotate(phi, POINTS[1]), phi, np.pi / 2, np.pi / 2])
    formation = roll(make_formation(scene, "v1-palm"), "v1-palm")
    phase = Phase(0, formation, Until(coordinate="phi", value=phi - 1.4))
    return Problem("falling box", scene, 0.0, start, (phase,))


def scale(joint: int, factor: float, start: float, stop: float) -> TorqueProfile:
    """The plan's torques with those of one joint multiplied from `start` to `stop` [s]."""
    torque = tipped().torque
    coefficients = torque.coefficients.copy()
    first = torque.breaks[:-1]
    coefficients[(first >= start - 1e-9) & (first < stop - 1e-9), joint] *= factor
    return TorqueProfile(torque.breaks, coefficients)


def constant(tau: ArrayLike, duration: float = 0.2) -> TorqueProfile:
    return TorqueProfile(np.array([0.0, duration]), np.reshape(tau, (1, 2, 1)).astype(float))


def ramp(start: tuple[float, float], rate: tuple[float, float], duration: float) -> TorqueProfile:
    """Torques that start and rise evenly [N m, N m/s]."""
    half: Array = np.array(rate) * duration / 2
    return TorqueProfile(
        np.array([0.0, duration]), np.column_stack([np.array(start) + half, half])[None]
    )


PENTAGON = """
epsilon = 0.05
object = { vertices = [[0, 0], [0.08, 0], [0.08, 0.03], [0.03, 0.09], [0, 0.09]], mass = 0.35 }
friction = { palm = 0.02, finger1 = 0.02, finger2 = 0.02 }
start = { flush = 0, x = 0.04 }
phases = [
  { contacts = ["v0-palm", "v1-palm", "v1-finger1", "v4-finger2"], until = "v2-finger1" },
  { contacts = ["v1-palm", "v1-finger1", "v2-finger1", "v4-finger2"], until = "v4-tip2", end = "smooth" },
  { contacts = ["v1-palm", "v1-finger1", "v2-finger1", "v4-tip2"], until = "e4-tip2", end = "smooth" },
  { contacts = ["v1-palm", "v1-finger1", "v2-finger1", "e4-tip2"], until = "v0-finger2" },
  { contacts = ["v1-palm", "v2-finger1", "v0-finger2"], until = { contact = "v3-finger1", x = 0.08804 } },
]
[fingers]
1 = { base = [0.09, -0.01], length = 0.17, radius = 0.006, inertia = 0.002, viscous = 0.01, dry = 0.01, torque_limit = 4.0 }
2 = { base = [-0.09, -0.01], length = 0.17, radius = 0.006, inertia = 0.002, viscous = 0.01, dry = 0.01, torque_limit = 4.0 }
"""  # noqa: E501
"""Five phases of a flip: a contact passes from a link over its tip to an edge; then a landing."""

LYING = """
epsilon = 0.05654
object = { vertices = [[0, 0], [0.07, 0], [0.09, 0.04], [0.03, 0.08], [-0.01, 0.04]], mass = 0.2261 }
friction = { palm = 0.05, finger1 = 0.05, finger2 = 0.05 }
start = { flush = 0, x = 0.01595 }
phases = [
  { contacts = ["v0-palm", "v1-palm", "v2-finger1", "v4-finger2"], until = "v0-finger2" },
  { contacts = ["v1-palm", "v2-finger1", "v0-finger2", "v4-finger2"], until = "v3-finger1" },
  { contacts = ["v1-palm", "v2-finger1", "e2-tip1", "v4-finger2"], until = "v3-tip1" },
  { contacts = ["v1-palm", "v2-finger1", "v3-finger1", "v4-finger2"], until = "v4-tip2", end = "smooth" },
  { contacts = ["v1-palm", "v2-finger1", "v3-finger1", "v4-tip2"], until = "e4-tip2", end = "smooth" },
  { contacts = ["v1-palm", "v2-finger1", "v3-finger1", "e4-tip2"], until = "v0-finger2", end = "impact" },
  { contacts = ["v1-palm", "v2-finger1", "v3-finger1", "v0-finger2"], until = "v2-palm" },
]
[fingers]
1 = { base = [0.08507, -0.01063], length = 0.1489, radius = 0.005317, inertia = 0.006393, viscous = 0.0124, dry = 0.01202, torque_limit = 2.405 }
2 = { base = [-0.08507, -0.01063], length = 0.1489, radius = 0.005317, inertia = 0.006393, viscous = 0.0124, dry = 0.01202, torque_limit = 2.405 }
"""  # noqa: E501
"""A flip in four phases of one motion: a link passes over its tip to an edge, and then lies on it,
by an impact that gives the tip a rate away from the edge."""


def read_lines(text: str) -> Problem:
    """The problem of a text in which lines that go on are indented by another four spaces."""
    return build_problem(tomllib.loads(" ".join(text.split("\n            "))))


@cache
def fading() -> Problem:
    """A small hexagon: its motion of the largest margin along a curve ends slowly."""
    return read_lines("""
        epsilon = 0.000704
        object.mass = 0.00834
        object.vertices = [[0.0068, -0.000469], [0.00489, 0.00278], [-0.00306, 0.00417],
            [-0.0068, 0.0006], [-0.00506, -0.00265], [0.00226, -0.00434]]
        fingers.1 = {base = [0.00659, -0.00168], length = 0.00747, radius = 0.0017,
            inertia = 1.04e-9, viscous = 5.25e-7, dry = 3.97e-9, torque_limit = 0.000929}
        fingers.2 = {base = [-0.0108, 0.000832], length = 0.00957, radius = 0.000594,
            inertia = 1.6e-6, viscous = 8.83e-7, dry = 5.49e-6, torque_limit = 0.00338}
        friction = {palm = 0.111, finger1 = 0.0, finger2 = 0.0735}
        start = {flush = 4, x = -0.00318}
        phases = [{contacts = ["v4-palm", "v5-palm", "v0-finger1", "v3-finger2"],
            until = {x = -0.004}}]
    """)


@cache
def turning() -> Problem:
    """A tall pentagon between pointed tips, one of which turns onto a vertex with its link."""
    return read_lines("""
        epsilon = 0.00852
        object.mass = 0.301
        object.vertices = [[-0.125, 0.925], [-0.089, 0.249], [0.0861, -0.814], [0.14, -0.808],
            [0.0173, 0.265]]
        fingers.1 = {base = [0.82, 0.0434], length = 1.54, radius = 0.0, inertia = 0.000156,
            viscous = 0.0108, dry = 0.00427, torque_limit = 32.0}
        fingers.2 = {base = [-0.922, -0.247], length = 1.74, radius = 0.0, inertia = 0.00823,
            viscous = 2.05e-05, dry = 0.655, torque_limit = 36.3}
        friction = {palm = 0.619, finger1 = 0.932, finger2 = 0.743}
        start = {flush = 2, x = 0.597}
        phases = [{contacts = ["v2-palm", "e4-tip1", "e1-tip2"],
            until = {contact = "v4-finger1", x = 0.424}}]
    """)


@cache
def reversing() -> Problem:
    """A decagon that leaves a border where its motion turns back."""
    return read_lines("""
        epsilon = 0.3034
        object.mass = 20.97
        object.vertices = [[-0.1425, 0.3496], [-0.3208, 0.199], [-0.3765, -0.02752],
            [-0.2884, -0.2436], [-0.09018, -0.3666], [0.1425, -0.3496], [0.3208, -0.199],
            [0.3765, 0.02752], [0.2884, 0.2436], [0.09018, 0.3666]]
        fingers.1 = {base = [0.5257, -0.05926], length = 1.127, inertia = 13.59,
            viscous = 0.00709, dry = 12.67, torque_limit = 2190.0}
        fingers.2 = {base = [-0.6599, -0.09831], length = 0.9127, inertia = 0.0001223,
            viscous = 0.01548, dry = 2.911, torque_limit = 848.9}
        friction = {palm = 0.2212, finger1 = 0.1368, finger2 = 0.0138}
        start = {flush = 4, x = -0.3186}
        phases = [{contacts = ["v4-palm", "v5-palm", "v8-finger1", "v2-finger2"],
            until = {x = -0.4109}, end = "smooth"},
            {contacts = ["v5-palm", "v8-finger1", "v2-finger2"],
            until = {x = -0.3511, phi_deg = -6.519}}]
    """)


@cache
def grazing() -> Problem:
    """A quadrangle whose edge comes to a fingertip along its tangent."""
    return read_lines("""
        epsilon = 0.001509
        object.mass = 0.02129
        object.vertices = [[0.1948, 0.1413], [-0.02686, 0.0126], [-0.1794, -0.1426],
            [-0.000713, -0.03288]]
        fingers.1 = {base = [0.2756, -0.05723], length = 0.5746, radius = 0.01182,
            inertia = 1.247e-05, viscous = 1.478e-06, dry = 0.001399, torque_limit = 0.2809}
        fingers.2 = {base = [-0.3172, -0.1024], length = 0.4376, radius = 0.002831,
            inertia = 5.116e-07, viscous = 9.438e-08, dry = 0.0018, torque_limit = 0.3006}
        friction = {palm = 0.07068, finger1 = 0.1866, finger2 = 0.1219}
        start = {flush = 2, x = 0.02019}
        phases = [{contacts = ["v2-palm", "v3-palm", "v0-finger1", "v2-finger2"],
            until = "e1-tip2"}]
    """)
