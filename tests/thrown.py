"""A square that fingers shove, heave or lift and then let go, from which on it moves by itself.

What it does then is known in closed form, whatever the fingers do.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.integrate import quad

from plane import make_scene, rotate
from wholearm import End, Friction, Phase, Problem, Scene, Until
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger, place_flush
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation, find_touching

HALF = 0.03
"""Half a side of the square [m]."""
LEVER = HALF * np.sqrt(2.0)
"""From its centroid to a vertex [m]."""


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
    scene = _with_palm(0.02, 0.0)
    start = _close(scene, _tip(scene, 0.3), 0.0)
    phase = Phase(0, Formation(scene, find_touching(scene, start)), Until(None, "phi", stop))
    return Problem("raise", scene, 0.05, start, (phase,))


@cache
def parting() -> Problem:
    """Finger 1 pushes a box over the palm that finger 2 touches as well at the start."""
    corners = [[-0.045, -0.03], [0.045, -0.03], [0.045, 0.09], [-0.045, 0.09]]
    scene = make_scene(corners, base=0.1)
    start = _close(scene, place_flush(scene, 0, 0.0), 0.0)
    formation = Formation(scene, find_touching(scene, start)[:3])
    phase = Phase(0, formation, Until(None, "x", -0.015))
    return Problem("part", scene, 0.05, start, (phase,))


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

    def height(phi: float) -> float:
        return float(LEVER * np.sin(phi + np.pi / 4))

    def slowness(s: float) -> float:
        # phi = stop - s^2 takes away the singularity at the end.
        phi = stop - s * s
        share = 1.0 if rolls else np.cos(phi + np.pi / 4) ** 2
        rise = mass * 9.81 * (height(stop) - height(phi))
        return float(2 * s * np.sqrt((inertia + mass * LEVER**2 * share) / (2 * rise)))

    return float(quad(slowness, 0.0, np.sqrt(stop - start))[0])
