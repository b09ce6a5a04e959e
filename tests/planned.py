"""Torques for tests: inverse dynamics along the curves, without a planner, and forward dynamics."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from shipped import HEPTAGON, problem_of
from wholearm import End, Phase, Problem, TorqueProfile, Until
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve, directions_of
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics import dynamics
from wholearm.mechanics.dynamics import LAMBDA, Directions, inverse
from wholearm.results.dwell_record import assemble
from wholearm.results.trajectory import Samples, Trajectory


def forward(
    formation: Formation, z: Array, v: Array, tau: Array, directions: Directions
) -> tuple[Array, Array]:
    """z'', shape (5,), and c, shape (n_c + R,), of one state."""
    at = formation.evaluate(z[None], v[None])
    acceleration, c = dynamics.forward(formation, at, v[None], tau[None], directions)
    return acceleration[0], c[0]


DEPENDENT = [1, 3, 4]
"""Coordinates y, theta_1 and theta_2, which follow from x and phi."""
SQUEEZES = np.geomspace(0.02, 40.0, 60)


@dataclass(frozen=True, eq=False)
class CosineMotion:
    """A phase run through as s = L/2 (1 - cos(pi t / T)).

    The squeeze is constant, or falls by `fade` times itself from start to end.
    """

    curve: Curve
    duration: float
    squeeze: float
    fade: float = 0.0

    @property
    def contacts(self) -> tuple[str, ...]:
        return self.curve.formation.names

    @property
    def turns(self) -> Array:
        """Times at which a contact or a joint reverses, shape (k,), with both ends."""
        places = [segment.start for segment in self.curve.segments]
        inner = np.arccos(1 - 2 * np.array(places[1:]) / self.curve.length) * self.duration / np.pi
        return np.array([0.0, *inner, self.duration])

    def law(self, t: Array) -> tuple[Array, Array, Array]:
        """Place, speed and acceleration along the curve."""
        length, rate = self.curve.length, np.pi / self.duration
        s = length / 2 * (1 - np.cos(rate * t))
        v = length / 2 * rate * np.sin(rate * t)
        return s, v, length / 2 * rate**2 * np.cos(rate * t)

    def evaluate(self, t: Array) -> Samples:
        t = np.clip(t, 0.0, self.duration)
        s, v, a = self.law(t)
        point = self.curve.evaluate(s)
        owner = np.clip(np.searchsorted(self.turns, t, side="right") - 1, 0, len(self.turns) - 2)
        formation, directions = self.curve.formation, directions_of(self.curve, owner)
        forces = inverse(formation, point, directions)
        # The sense of the null vector is that of the curve; here a squeeze always presses.
        sense = np.where(forces.of_c[..., LAMBDA].sum(axis=1) < 0, -1.0, 1.0)
        squeeze = sense * self.squeeze * (1 - self.fade * t / self.duration)
        c_n, tau = forces.c(a, v**2, squeeze), forces.tau(a, v**2, squeeze)
        z_dot = point.z_s * v[:, None]
        z_ddot = point.z_s * a[:, None] + point.z_ss * (v**2)[:, None]
        return Samples(point.z, z_dot, z_ddot, tau, c_n, -formation.friction * directions.Xi * c_n)


@dataclass(frozen=True, eq=False)
class DepartingMotion(CosineMotion):
    """A phase run through from rest to `place` on the curve, at `speed` there.

    The law is a cubic in time.
    """

    place: float = 0.0
    speed: float = 0.0

    def law(self, t: Array) -> tuple[Array, Array, Array]:
        s, v, a = hermite(0.0, 0.0, self.place, self.speed, self.duration, t)
        return s, v, a

    @property
    def turns(self) -> Array:
        places = [g.start for g in self.curve.segments[1:] if g.start < self.place]
        inner = [
            brentq(lambda t, p=p: self.law(np.array([t]))[0][0] - p, 0, self.duration, xtol=1e-15)
            for p in places
        ]
        return np.array([0.0, *inner, self.duration])


@dataclass(frozen=True, eq=False)
class LandingMotion:
    """Three contacts on the way from `start` and `start_dot`, (5,), to rest at (x, phi).

    phi is a cubic in time, and x one in phi, so that the direction of travel can be chosen: `slope`
    is dx/dphi at the end [m/rad].
    """

    formation: Formation
    start: Array
    start_dot: Array
    x: float
    phi: float
    slope: float
    duration: float

    @property
    def contacts(self) -> tuple[str, ...]:
        return self.formation.names

    def pose(self, t: Array) -> tuple[Array, Array]:
        """Pose x and phi with their first and second derivatives, each of shape (3, n)."""
        phi_0, rate = self.start[2], self.start_dot[2]
        phi = hermite(phi_0, rate, self.phi, 0.0, self.duration, t)
        slopes = self.start_dot[0] / rate, self.slope
        X = hermite(self.start[0], slopes[0], self.x, slopes[1], self.phi - phi_0, phi[0] - phi_0)
        x = np.array([X[0], X[1] * phi[1], X[1] * phi[2] + X[2] * phi[1] ** 2])
        return x, phi

    def close(self, x: Array, phi: Array) -> Array:
        """Configurations with every contact closed, shape (n, 5)."""
        z = np.tile(self.start, (len(x), 1))
        z[:, 0], z[:, 2] = x, phi
        for _ in range(50):
            C, A = self.formation.evaluate(z, np.zeros_like(z))[:2]
            step = np.linalg.solve(A[:, :, DEPENDENT], -C[..., None])[..., 0]
            # Far from the start a whole step could leave the solution's neighbourhood.
            z[:, DEPENDENT] += step / max(1.0, float(np.abs(step).max()) / 0.2)
        return z

    def move(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """z, z', z'' and the rates of sliding and of the joints, shape (n, n_c + 2)."""
        x, phi = self.pose(np.asarray(t))
        z = self.close(x[0], phi[0])
        z_dot, z_ddot = np.zeros_like(z), np.zeros_like(z)
        for rates, k in (z_dot, 1), (z_ddot, 2):
            rates[:, 0], rates[:, 2] = x[k], phi[k]
            P, bend = self.formation.evaluate(z, z_dot)[-2:]
            right = -np.einsum("nij,nj->ni", P, rates) - (bend if k == 2 else 0.0)
            rates[:, DEPENDENT] = np.linalg.solve(P[:, :, DEPENDENT], right[..., None])[..., 0]
        A_t = self.formation.evaluate(z, z_dot).A_t
        return z, z_dot, z_ddot, np.hstack([np.einsum("nij,nj->ni", A_t, z_dot), z_dot[:, 3:]])

    @cached_property
    def turns(self) -> Array:
        """Times at which a contact or a joint reverses, shape (k,), with both ends."""
        t = np.linspace(0.0, self.duration, 401)[:-1]
        rates = self.move(t)[3]
        found = [
            brentq(lambda u, k=k: self.move(np.array([u]))[3][0, k], t[i], t[i + 1], xtol=1e-15)
            for i, k in np.argwhere(rates[1:] * rates[:-1] < 0)
        ]
        return np.array([0.0, *sorted(found), self.duration])

    def signs(self, t: Array) -> Array:
        """Directions of sliding and of the joints: those in the middle between two reversals."""
        middle = self.move((self.turns[1:] + self.turns[:-1]) / 2)[3]
        owner = np.searchsorted(self.turns, t, side="right") - 1
        return np.asarray(np.sign(middle)[np.clip(owner, 0, len(middle) - 1)])

    def evaluate(self, t: Array) -> Samples:
        t = np.clip(t, 0.0, self.duration)
        scene, signs = self.formation.scene, self.signs(t)
        z, z_dot, z_ddot, _ = self.move(t)
        _, A, A_t = self.formation.evaluate(z, z_dot)[:3]
        slip = np.asarray(self.formation.friction * signs[:, :-2], dtype=float)
        # The five equations of motion, with the unknowns c_n and tau.
        matrix = np.zeros((len(t), 5, 5))
        matrix[:, :, :3] = (A - slip[..., None] * A_t).transpose(0, 2, 1)
        matrix[:, [3, 4], [3, 4]] = 1.0
        right = scene.mass_diagonal * z_ddot + scene.viscous * z_dot - scene.applied_force
        right[:, 3:] += scene.dry[3:] * signs[:, -2:]
        solution = np.linalg.solve(matrix, right[..., None])[..., 0]
        c_n, tau = np.asarray(solution[:, :3]), np.asarray(solution[:, 3:])
        return Samples(z, z_dot, z_ddot, tau, c_n, np.asarray(-slip * c_n))


def hermite(p: float, p_dot: float, q: float, q_dot: float, duration: float, t: Array) -> Array:
    """The cubic from p to q with the given slopes, and two derivatives, shape (3, n)."""
    u = t / duration
    a, b, rise = p_dot * duration, q_dot * duration, q - p
    c, d = 3 * rise - 2 * a - b, a + b - 2 * rise
    value = p + a * u + c * u**2 + d * u**3
    first = (a + 2 * c * u + 3 * d * u**2) / duration
    return np.array([value, first, (2 * c + 6 * d * u) / duration**2])


def fit(
    motion: CosineMotion | LandingMotion, pieces: int, degree: int, turns: Array | None = None
) -> TorqueProfile:
    """The torques of a motion as polynomials, broken at `turns`: where a direction reverses."""
    turns = motion.turns if turns is None else turns
    counts = np.maximum(1, np.ceil(pieces * np.diff(turns) / motion.duration)).astype(int)
    grids = [
        np.linspace(*ends, n + 1)[:-1] for ends, n in zip(pairwise(turns), counts, strict=True)
    ]
    breaks = np.append(np.concatenate(grids), motion.duration)
    return TorqueProfile.fit(breaks, lambda t: motion.evaluate(t).tau, degree)


def choose_squeeze(curve: Curve, duration: float, least: float, limit: float) -> float:
    """Constant squeeze with every c_n above `least`, as far as possible from the torque limit."""
    t = np.linspace(0.0, duration, 101)
    for squeeze in SQUEEZES:
        samples = CosineMotion(curve, duration, float(squeeze)).evaluate(t)
        if samples.c_n.min() > least:
            if np.abs(samples.tau).max() > limit:
                break
            return float(squeeze)
    raise ValueError(f"no constant squeeze carries the phase in {duration} s")


@lru_cache(maxsize=4)
def plan(
    duration: float = 0.4, least: float = 0.2, pieces: int = 60, degree: int = 7
) -> tuple[Problem, Trajectory]:
    """The heptagon's problem and a trajectory that carries it through, `duration` a phase."""
    problem = problem_of(HEPTAGON)
    motions = [
        CosineMotion(curve, duration, choose_squeeze(curve, duration, least, 2.0))
        for curve in trace_phases(problem)
    ]
    torque = TorqueProfile.chain([fit(motion, pieces, degree) for motion in motions])
    return problem, assemble(motions, torque, {"epsilon": problem.epsilon}, 201)


@lru_cache(maxsize=4)
def plan_landing(duration: float = 0.2, squeeze: float = 12.0) -> tuple[Problem, Trajectory]:
    """The heptagon lets vertex 3 go at speed and lands on edge 1, at rest after `duration`.

    Four contacts from rest at the start of the last phase of `plan`, then three. A squeeze of 4
    is too weak for the first phase.
    """
    problem, trajectory = plan()
    last = trajectory.motions[-1]
    assert isinstance(last, CosineMotion)
    scene, curve = problem.scene, last.curve
    departing = DepartingMotion(curve, 0.5, squeeze, place=0.06, speed=0.2)
    at = departing.evaluate(np.array([departing.duration]))
    names = ("v1-palm", "v4-finger1", "v6-finger2")
    formation = Formation(scene, tuple(parse_contact(name, scene) for name in names))
    phi = scene.polygon.flush_angle(1)
    landing = LandingMotion(formation, at.z[0], at.z_dot[0], 0.016, phi, 0.0, duration)
    phases = (
        Phase(0, curve.formation, Until(), End.SMOOTH),
        Phase(1, formation, Until(contact=parse_contact("v2-palm", scene))),
    )
    motions: tuple[DepartingMotion, LandingMotion] = (departing, landing)
    torque = TorqueProfile.chain([fit(motion, 60, 7) for motion in motions])
    one = dataclasses.replace(problem, start=curve.start, phases=phases)
    return one, assemble(motions, torque, {"epsilon": problem.epsilon}, 201)


def change(profile: TorqueProfile, edit: Callable[[Array, Array], Array]) -> TorqueProfile:
    """The profile with coefficients edit(piece starts, coefficients)."""
    return TorqueProfile(profile.breaks, edit(profile.breaks[:-1], profile.coefficients.copy()))


def brake_less(starts: Array, c: Array) -> Array:
    """An edit of `plan`, with which the first phase does not quite come to rest."""
    c[(starts > 0.3) & (starts < 0.4 - 1e-9)] *= 0.97
    return c
