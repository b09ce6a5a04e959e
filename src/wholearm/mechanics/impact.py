"""Plastic impacts: projection of the velocity onto the next formation, by impulses with friction.

Equations: `README.md`, with P in place of A if contacts roll; their impulses stay in the cones. The
energy loss is half (v+ - v-)^T M5 (v+ - v-) plus the work |v_t|^T U p against sliding friction.
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

ROUNDING = 1e-6  # relative momentum or speed below which violations count as rounding errors


class ViolationKind(Enum):
    """Reasons why an impact onto a formation is not possible."""

    JAM = "jam"  # jamming: the reduced inertia with friction is not positive
    HELD = "held"  # no sliding directions agree with the velocity after the impact
    PULL = "pull"  # the normal impulse of a contact is negative
    SLIP = "slip"  # the impulse of a rolling contact is outside its friction cone
    CLOSING = "closing"  # a touching contact outside of the formation has a closing velocity


class ImpactViolation(NamedTuple):
    """A violated condition of an impact."""

    kind: ViolationKind
    name: str  # the contact, or the event in words
    # impulse or margin to slipping [N s], rate [m/s], or the reduced inertia over that without
    # friction
    value: float

    def describe(self, suffix: str = "") -> str:
        """The violation in words; `suffix` follows the units, such as " per m/s"."""
        if self.kind is ViolationKind.PULL:
            return f"impulse on {self.name} would be {self.value:.3g} N s{suffix}"
        if self.kind is ViolationKind.SLIP:
            return f"{self.name} would slip, {-self.value:.3g} N s{suffix} beyond its friction cone"
        if self.kind is ViolationKind.CLOSING:
            return f"{self.name}, at {-self.value:.3g} m/s{suffix}"
        if self.kind is ViolationKind.HELD:
            return f"friction would hold {self.name}"
        return f"{self.name} would jam, with {self.value:.3g} of the reduced inertia"


@dataclass(frozen=True, eq=False)
class Impact:
    """Velocity and impulses after a plastic impact."""

    formation: Formation  # after the impact
    v: Array  # (5,): v+, in m/s and rad/s; NaN if the formation jams
    # (n_c + R,) [N s]: impulses of the contacts: normal, then tangential of rolling ones; NaN if
    # the formation jams
    p: Array
    Xi: Array  # (n_c,): assumed sliding directions, zero for rolling contacts
    # by kind, the largest first; empty if the impact is possible
    violations: tuple[ImpactViolation, ...]

    @property
    def possible(self) -> bool:
        """Whether the motion continues in the formation."""
        return not self.violations

    @property
    def least_impulse(self) -> tuple[str, float]:
        """The contact with the least normal impulse, and that impulse [N s]."""
        k = int(self.p[: self.formation.n_contacts].argmin())
        return self.formation.names[k], float(self.p[k])


def compute_impact(before: Formation, after: Formation, z: Array, v: Array) -> Impact:
    """Plastic impact of a velocity `v` at `z`, (5,) each, between closed formations."""
    kinematics, mass = after.evaluate(z[None], v[None]), after.scene.mass_diagonal
    P, A_t = kinematics.P[0], kinematics.A_t[0]
    sliding = np.ones(after.n_contacts)
    sliding[list(after.rolling_rows)] = 0.0
    rolling_names = [after.names[row] for row in after.rolling_rows]

    def find_sliding(velocity: Array) -> tuple[float, ...]:
        return tuple(sliding * np.where(A_t @ velocity < 0, -1.0, 1.0))

    def strike(Xi: Array) -> Impact:
        """The impact for assumed sliding directions."""
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
            (ViolationKind.SLIP, momentum, [*rolling_names, *rolling_names], cones),
            (ViolationKind.CLOSING, speed, *_rates(before, after, z, v_after)),
        )
        violations = [
            ImpactViolation(kind, names[k], float(amounts[k]))
            for kind, unit, names, amounts in values
            for k in np.argsort(amounts)
            if amounts[k] < -ROUNDING * unit
        ]
        return Impact(after, v_after, p, Xi, tuple(violations))

    # Fixed-point iterations of the sliding directions, first from those without friction.
    guess = find_sliding(solve_impulses(mass, P, P, v)[0])
    others = product(*((1.0, -1.0) if slides else (0.0,) for slides in sliding))
    impacts: dict[tuple[float, ...], Impact] = {}
    for choice in (guess, *others):
        Xi = choice
        while Xi not in impacts:
            impacts[Xi] = impact = strike(np.array(Xi))
            if not {h.kind for h in impact.violations} & {ViolationKind.JAM, ViolationKind.HELD}:
                return impact
            Xi = find_sliding(impact.v)
    return impacts[guess]


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
    """Texts and opening rates [m/s] of touching contacts that are not in the new formation."""
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
        later, earlier = after.evaluate_limits(np.array([z + h * v, z - h * v]))[:, others]
        rates += list((later - earlier) / (2 * h))
        texts += [after.limits[k].text for k in others]
    return tuple(texts), np.array(rates)
