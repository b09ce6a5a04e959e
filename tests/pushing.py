"""A box on the palm that a finger pushes, so that it sticks and slips, and torques for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from plane import accelerate, make_formation, make_scene, rotate, stack_rows
from wholearm import Formation, Friction, Phase, Problem, Scene, TorqueProfile, Until
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger, place_flush


@cache
def pushed(mu: float = 0.3, contacts: str = "v0-palm v1-palm v2-finger1") -> Problem:
    """A box on the palm that finger 1 leans on, and finger 2 far off; both slide freely.

    Finger 1 has dry friction, which finger 2 has not: that swings as its torque wants.
    """
    scene = make_scene(base=0.1)
    left = dataclasses.replace(scene.fingers[1], base=[-0.5, -0.01], viscous=0.0, dry=0.0)
    scene = Scene(scene.polygon, (scene.fingers[0], left), Friction(mu, 0.1, 0.1))
    q = place_flush(scene, 0, 0.0)
    z = np.array([*q, close_finger(scene, q, 0), np.pi / 2])
    never = Until(coordinate="x", value=-0.3)
    phase = Phase(0, make_formation(scene, contacts), never)
    return Problem("pushed box", scene, 0.0, z, (phase,))


def rocking(scale: float = 1.0) -> TorqueProfile:
    """Finger 1 pushes the box until it slides, eases off until it sticks, and does so again."""
    share = np.array([0.0, 1.4, 1.3, 0.35, 0.35, 1.5, 0.4])
    rows = [np.arange(7) / 10, 0.14 * scale * share, np.full(7, 1e-3)]
    return TorqueProfile.join_rows(np.column_stack(rows))


def fit_stages(torque: Callable[[float, int], Array], times: Sequence[float]) -> TorqueProfile:
    """Torques at a time of a stage as polynomials, which may step between the stages."""
    breaks, coefficients, degree = [0.0], [], 7
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    for stage, ends in enumerate(pairwise(times)):
        for low, high in pairwise(np.linspace(*ends, 7)):
            t = (low + high + nodes * (high - low)) / 2
            values = np.array([torque(float(one), stage) for one in t])
            coefficients.append(np.polynomial.polynomial.polyfit(nodes, values, degree).T)
            breaks.append(high)
    return TorqueProfile(np.array(breaks), np.array(coefficients))


class Push:
    """The box of `pushed` moved by plan: twice to the left by `run` [m], and still between.

    The torques of finger 1 follow by inverse dynamics, from the plain dynamics of the tests.
    """

    def __init__(self, soft: bool, run: float = 0.004) -> None:
        self.problem, self.soft, self.run = pushed(), soft, run
        self.times = (0.0, 0.2, 0.3, 0.5)

    def law(self, t: float, stage: int) -> tuple[float, float, float]:
        """x, x' and x'' at a time of a stage."""
        start, rate = self.times[stage], 2 * np.pi / (self.times[stage + 1] - self.times[stage])
        x = self.problem.start[0] - (self.run if stage else 0.0)
        if stage == 1:
            return x, 0.0, 0.0
        if self.soft:
            size, u = self.run / (2 * np.pi), rate * (t - start)
            way, speed, growth = u - np.sin(u), 1 - np.cos(u), np.sin(u)
        else:
            size, rate = self.run / 2, rate / 2
            u = rate * (t - start)
            way, speed, growth = 1 - np.cos(u), np.sin(u), np.cos(u)
        return x - size * way, -size * rate * speed, -size * rate**2 * growth

    def torque(self, t: float, stage: int) -> float:
        """Torque of finger 1 [N m]; within the cone while the box is still."""
        if stage == 1:
            return 0.07
        problem = self.problem
        x, x_dot, x_ddot = self.law(t, stage)
        q = place_flush(problem.scene, 0, x)
        z = np.array([*q, close_finger(problem.scene, q, 0), problem.start[4]])
        formation = problem.phases[0].formation
        normal, tangent = stack_rows(formation, z)
        turn = -normal[2, 0] * x_dot / normal[2, 3]
        v = np.array([x_dot, 0.0, 0.0, turn, 0.0])
        ahead = np.array([-1.0, 0.0, 0.0, normal[2, 0] / normal[2, 3], 0.0])
        Xi, sigma = np.sign(tangent @ ahead), np.array([np.sign(ahead[3]), 1.0])
        taus = np.array([[0.0, 1e-3], [1.0, 1e-3]])
        first, second = (accelerate(formation, z, v, tau, Xi, sigma)[0][0] for tau in taus)
        return float((x_ddot - first) / (second - first))

    def fit(self) -> TorqueProfile:
        return fit_stages(lambda t, stage: np.array([self.torque(t, stage), 1e-3]), self.times)


@dataclass(frozen=True, eq=False)
class Roll:
    """An object turned by plan over a vertex on the palm, which slides, rolls and slides again.

    Vertex 1 is on the palm, and both links touch; phi falls from rest. The torques follow by
    inverse dynamics: three normal forces and two torques from five equations, where the vertex has
    `share` of what friction could give as it rolls. It slides by `run` each time [m], and starts,
    rolls, slides again and ends at `times` [s].
    """

    formation: Formation
    start: Array
    share: float = 0.3
    run: float = 1e-3
    times: tuple[float, ...] = (0.0, 0.06, 0.1, 0.15)

    def law(self, t: float, stage: int) -> tuple[float, float, float, float]:
        """X' and x of the vertex, phi' and phi."""
        start, stop = self.times[stage : stage + 2]
        u, rate = np.pi * (t - start) / (stop - start), np.pi / (stop - start)
        x, slip = self.run if stage else 0.0, 0.0
        if stage != 1:
            x += self.run / 2 * (1 - np.cos(u))
            slip = self.run / 2 * rate * np.sin(u)
        return slip, x, -3.0 * t, self.start[2] - 1.5 * t**2

    def move(self, t: float, stage: int) -> tuple[Array, Array]:
        """Configuration and velocity, shape (5,) each."""
        scene = self.formation.scene
        slip, x, turning, phi = self.law(t, stage)
        vertex = rotate(phi, scene.polygon.vertices[1])
        origin = self.start[0] + rotate(self.start[2], scene.polygon.vertices[1])[0]
        q = np.array([origin + x - vertex[0], -vertex[1], phi])
        z = np.array([*q, *(close_finger(scene, q, k) for k in (0, 1))])
        q_dot = np.array([slip + turning * vertex[1], -turning * vertex[0], turning])
        normal, _ = stack_rows(self.formation, z)
        joints = -np.linalg.solve(normal[1:, 3:], normal[1:, :3] @ q_dot)
        return z, np.array([*q_dot, *joints])

    def torque(self, t: float, stage: int) -> Array:
        """Torques of both fingers, shape (2,)."""
        scene, h = self.formation.scene, 1e-6
        z, v = self.move(t, stage)
        a = (self.move(t + h, stage)[1] - self.move(t - h, stage)[1]) / (2 * h)
        normal, tangent = stack_rows(self.formation, z)
        # At the ends of a stage the directions are those inside.
        middle = np.clip(t, self.times[stage] + 1e-4, self.times[stage + 1] - 1e-4)
        inner, inner_dot = self.move(float(middle), stage)
        slips = np.sign(stack_rows(self.formation, inner)[1] @ inner_dot)
        if stage == 1:
            slips[0] = self.share
        force = normal - (self.formation.friction * slips)[:, None] * tangent
        drag = scene.viscous * v + scene.dry * np.sign(inner_dot)
        right = scene.mass_diagonal * a - scene.applied_force + drag
        answer = np.linalg.solve(np.hstack([force.T, np.eye(5)[:, 3:]]), right)
        return np.asarray(answer[3:])

    def fit(self) -> TorqueProfile:
        return fit_stages(self.torque, self.times)
