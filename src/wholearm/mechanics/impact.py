"""Plastic impacts: projection of the velocity onto the next formation, by impulses with friction.

Equations: `README.md`, with P of rolling contacts in place of A; their impulses stay in the cones.
The energy lost is half (v+ - v-)^T M5 (v+ - v-) plus the work |v_t|^T U p against sliding friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import product
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from .dynamics import Directions, force_rows, measure_speed, metric_weights, reduced_inertia
from .limits import force_limit_rows

ROUNDING = 1e-6  # momentum or speed, in the metric of curves, that counts as rounding


class ViolationKind(Enum):
    """What keeps an impact from throwing the velocity onto a formation."""

    JAM = "jam"  # friction makes the reduced inertia vanish or turn negative
    HELD = "held"  # no sliding directions are those of the velocity that they give
    PULL = "pull"  # a contact would have to pull
    SLIP = "slip"  # a rolling contact would leave its friction cone
    CLOSING = "closing"  # something that touches, but is not in the formation, would be driven into


class ImpactViolation(NamedTuple):
    """One reason why an impact is not possible."""

    kind: ViolationKind
    name: str  # the contact, or what would happen
    # its impulse or margin to slipping [N s], or rate [m/s]; the reduced inertia over that without
    # friction
    value: float

    def describe(self, per: str = "") -> str:
        """Say it in words; `per` is what the numbers are for, if not for the velocity itself."""
        if self.kind is ViolationKind.PULL:
            return f"impulse on {self.name} would be {self.value:.3g} N s{per}"
        if self.kind is ViolationKind.SLIP:
            return f"{self.name} would slip, {-self.value:.3g} N s{per} beyond its friction cone"
        if self.kind is ViolationKind.CLOSING:
            return f"{self.name}, at {-self.value:.3g} m/s{per}"
        if self.kind is ViolationKind.HELD:
            return f"friction would hold {self.name}"
        return f"{self.name} would jam, with {self.value:.3g} of the reduced inertia"


@dataclass(frozen=True, eq=False)
class Impact:
    """What an impact does to a velocity."""

    formation: Formation  # the new one
    v: Array  # (5,): v+, in m/s and rad/s; NaN if the formation jams
    # (n_c + R,) [N s]: impulses of the contacts: normal, then tangential of rolling ones. NaN
    # likewise.
    p: Array
    Xi: Array  # (n_c,): sliding directions that friction assumes, zero for rolling contacts
    # why it is not possible, the worst first; empty if it is
    violations: tuple[ImpactViolation, ...]

    @property
    def possible(self) -> bool:
        """Whether the motion goes on in the new formation."""
        return not self.violations

    @property
    def least(self) -> tuple[str, float]:
        """The contact with the least normal impulse, and that impulse [N s]."""
        k = int(self.p[: self.formation.n_contacts].argmin())
        return self.formation.names[k], float(self.p[k])


def compute_impact(before: Formation, after: Formation, z: Array, v: Array) -> Impact:
    """Plastic impact of a velocity `v` at `z`, (5,) each, between closed formations."""
    kinematics, mass = after.evaluate(z[None], v[None]), after.scene.mass_diagonal
    P, A_t = kinematics.P[0], kinematics.A_t[0]
    slides = np.ones(after.n_contacts)
    slides[list(after.rolling_rows)] = 0.0
    rolls = [after.names[row] for row in after.rolling_rows]

    def find_sliding(velocity: Array) -> tuple[float, ...]:
        return tuple(slides * np.where(A_t @ velocity < 0, -1.0, 1.0))

    def strike(Xi: Array) -> Impact:
        """The impact with given sliding directions."""
        directions = Directions(Xi, np.ones(2))
        ratio = float(reduced_inertia(after, kinematics, directions)[0])
        if not ratio > 0:
            jam = ImpactViolation(ViolationKind.JAM, " ".join(after.names), ratio)
            return Impact(after, np.full(5, np.nan), np.full(len(P), np.nan), Xi, (jam,))
        v_after, p = solve_impulses(mass, P, force_rows(after, kinematics, directions)[0], v)
        speed = measure_speed(after.scene, v)
        momentum = float(np.abs(mass * v / np.sqrt(metric_weights(after.scene))).max())
        normal, cones = np.split(force_limit_rows(after) @ p, [after.n_contacts])
        values = (
            (ViolationKind.HELD, speed, after.names, Xi * (A_t @ v_after)),
            (ViolationKind.PULL, momentum, after.names, normal),
            (ViolationKind.SLIP, momentum, [*rolls, *rolls], cones),
            (ViolationKind.CLOSING, speed, *_rates(before, after, z, v_after)),
        )
        violations = [
            ImpactViolation(kind, names[k], float(amounts[k]))
            for kind, unit, names, amounts in values
            for k in np.argsort(amounts)
            if amounts[k] < -ROUNDING * unit
        ]
        return Impact(after, v_after, p, Xi, tuple(violations))

    # Try the sliding of the frictionless impact, then that of each answer; rarely any other.
    likely = find_sliding(solve_impulses(mass, P, P, v)[0])
    others = product(*((1.0, -1.0) if one else (0.0,) for one in slides))
    tried: dict[tuple[float, ...], Impact] = {}
    for choice in (likely, *others):
        Xi = choice
        while Xi not in tried:
            tried[Xi] = impact = strike(np.array(Xi))
            if not {h.kind for h in impact.violations} & {ViolationKind.JAM, ViolationKind.HELD}:
                return impact
            Xi = find_sliding(impact.v)
    return tried[likely]


def solve_impulses(mass: Array, rows: Array, force_rows: Array, v: Array) -> tuple[Array, Array]:
    """Velocity and impulses p of the jump M5 (v+ - v) = force_rows^T p with rows v+ = 0.

    Without friction both (r, 5) are equal: v+ is nearest to v in the metric M5, `mass` (5,).
    """
    lift = force_rows.T / mass[:, None]
    p = -np.linalg.solve(rows @ lift, rows @ v)
    return np.asarray(v + lift @ p), np.asarray(p)


def _rates(
    before: Formation, after: Formation, z: Array, v: Array
) -> tuple[tuple[str, ...], Array]:
    """Names and opening rates [m/s] of what touches but is not in the new formation."""
    released = {k: c for k, c in enumerate(before.contacts) if c not in after.contacts}
    texts = [f"{contact.name} would not part" for contact in released.values()]
    rates = list((before.evaluate(z[None], v[None]).A[0] @ v)[list(released)])
    values = after.evaluate_limits(z[None])[0]
    others = [
        k
        for k, limit in enumerate(after.limits)
        if abs(values[k]) < after.scene.touching and limit.gained not in released.values()
    ]
    if others:
        scene = after.scene
        h = 1e-5 * scene.scales.length / max(measure_speed(scene, v), np.finfo(float).tiny)
        ahead, behind = after.evaluate_limits(np.array([z + h * v, z - h * v]))[:, others]
        rates += list((ahead - behind) / (2 * h))
        texts += [after.limits[k].text for k in others]
    return tuple(texts), np.array(rates)
