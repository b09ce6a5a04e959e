"""Contact formations: constraints P z' = 0 with their derivatives, and gap limits.

Eq. (4) reads A z' = 0; sliding velocities are v_t = A_t z', zero for rolling contacts, so that P =
[A; A_t(rolling)] (`mechanics/README.md`). Rolling is holonomic here: v_t is the rate of a slip
coordinate (`elemental`), which keeps its value from where the rolling begins.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Batch, exclusive, stored
from ..scene.model import Scene
from .contact_limits import build_clearance, list_limits
from .elemental import Contact, GapLimit, build_features, candidate_contacts


class Kinematics(NamedTuple):
    """A formation at n configurations."""

    C: Array  # (n, n_c) [m]
    A: Array  # A, A_t (n, n_c, 5):
    A_t: Array
    P: Array  # (n, n_c + R, 5): constraint rows [A; A_t(rolling)]; A itself where nothing rolls
    P_dot_v: Array  # (n, n_c + R): P' v for velocities v: P z'' = -P' z'

    def pick(self, rows: Any) -> Kinematics:
        """The kinematics at some of the configurations."""
        return Kinematics(*(array[rows] for array in self))


class CurvePoint(NamedTuple):
    """Curve at n places: z, tangent z_s and curvature z_ss, (n, 5) each, and kinematics there."""

    z: Array
    z_s: Array
    z_ss: Array
    kinematics: Kinematics

    def pick(self, rows: Any) -> CurvePoint:
        """Some of the places."""
        kinematics = self.kinematics.pick(rows)
        return CurvePoint(self.z[rows], self.z_s[rows], self.z_ss[rows], kinematics)


def _identify_limits(formation: Formation) -> Hashable:
    return formation.scene.shape, formation.scene.fingers_collide, formation.contacts


@dataclass(frozen=True)
class Formation:
    """A contact formation of a scene."""

    scene: Scene
    contacts: tuple[Contact, ...]  # in the order of every array over contacts
    rolling: tuple[Contact, ...] = ()  # contacts that roll; the others slide

    def __post_init__(self) -> None:
        if not set(self.rolling) <= set(self.contacts):
            raise ValueError(f"{describe(self.rolling)} roll, which are no contacts")

    def __repr__(self) -> str:
        rolls = [" rolling" if contact in self.rolling else "" for contact in self.contacts]
        return f"Formation({', '.join(map(str.__add__, self.names, rolls))})"

    @property
    def n_contacts(self) -> int:
        """Number of contacts n_c."""
        return len(self.contacts)

    @property
    def n_rolling(self) -> int:
        """Number of rolling contacts R."""
        return len(self.rolling)

    @property
    def n_constraints(self) -> int:
        """Number of constraint rows, n_c + R, and of independent contact forces."""
        return len(self.contacts) + len(self.rolling)

    def add(self, contact: Contact | None) -> Formation:
        """The formation with one more (sliding) contact; the same formation if it is None."""
        return self if contact is None else replace(self, contacts=(*self.contacts, contact))

    @cached_property
    def rolling_rows(self) -> tuple[int, ...]:
        """Indices of the rolling contacts, in the order of every array over rolling contacts."""
        return tuple(self.contacts.index(c) for c in self.contacts if c in self.rolling)

    @cached_property
    def rubbing_rows(self) -> tuple[int, ...]:
        """Indices of the contacts that slide with friction, whose sliding direction matters."""
        return tuple(np.flatnonzero(self.sliding_friction).tolist())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the contacts."""
        return tuple(contact.name for contact in self.contacts)

    def turn_with(self, row: int) -> tuple[int, ...]:
        """Rows of (contacts, joints) that reverse with a row: both of a flush edge, or the row."""
        surfaces = [(contact.surface, contact.finger) for contact in self.contacts]
        if row >= len(surfaces) or surfaces[row][0] == "tip":
            return (row,)
        return tuple(k for k, surface in enumerate(surfaces) if surface == surfaces[row])

    @cached_property
    def friction(self) -> Array:
        """Diagonal of U, shape (n_c,)."""
        return np.array([self.scene.friction.of(contact.finger) for contact in self.contacts])

    @cached_property
    def sliding_friction(self) -> Array:
        """Diagonal of U, shape (n_c,), with zeros for rolling contacts: their c_t is free."""
        friction = self.friction.copy()
        friction[list(self.rolling_rows)] = 0.0
        return friction

    @property
    def equations(self) -> tuple[object, ...]:
        """Key of the dynamics: equal for formations with the same equations of motion."""
        return (self.scene.equations, self.contacts, self.rolling)

    @property
    def function(self) -> Expression:
        """CasADi function (z, v) -> (gaps and slips of rolling contacts [m], A, A_t, P' v)."""
        return _build_function(self).function

    def build_constraints(self, z: Expression, v: Expression) -> tuple[Expression, ...]:
        """Expressions of z and v: gaps and slip coordinates [m] in one column, P, P' v and A_t."""
        gaps, A, A_t, P_dot_v = self.function(z, v)
        P = ca.vertcat(A, A_t[list(self.rolling_rows), :]) if self.rolling else A
        return gaps, P, P_dot_v, A_t

    @property
    @stored(_identify_limits)
    def limits(self) -> tuple[GapLimit, ...]:
        """Gap limits at which the formation ceases to be valid, expressions of the symbol z."""
        return tuple(list_limits(self.scene, self.contacts))

    def evaluate(self, z: Array, v: Array) -> Kinematics:
        """Evaluate the formation at n configurations z and velocities v, shape (n, 5) each."""
        gaps, A, A_t, P_dot_v = _build_function(self)(z, v)
        P = np.concatenate([A, A_t[:, list(self.rolling_rows)]], axis=1) if self.rolling else A
        return Kinematics(gaps[:, : self.n_contacts, 0], A, A_t, P, P_dot_v[..., 0])

    def evaluate_slip(self, z: Array) -> Array:
        """Slip coordinates of the rolling contacts at n configurations, shape (n, R) [m]."""
        if not self.rolling:
            return np.zeros((len(z), 0))
        return _build_function(self)(z, z)[0][:, self.n_contacts :, 0]

    def evaluate_limits(self, z: Array) -> Array:
        """Values of `limits` at n configurations, shape (n, n_limits) [m]."""
        return _build_limit_function(self)(z)[0][..., 0]


@exclusive
def find_touching(scene: Scene, z: Array) -> tuple[Contact, ...]:
    """Return the contacts that touch at `z`, in the order palm, finger 1, finger 2."""
    candidates, function = _build_clearances(scene)
    flags = np.abs(function(z[None])[0][0, :, 0]) < scene.touching
    return tuple(c for c, flag in zip(candidates, flags, strict=True) if flag)


@stored(lambda scene: scene.shape)
def _build_clearances(scene: Scene) -> tuple[tuple[Contact, ...], Batch]:
    """All contacts of a scene, and a function z -> their clearances [m]."""
    candidates = tuple(c for part in (None, 0, 1) for c in candidate_contacts(scene, part))
    values = ca.vertcat(*(build_clearance(c, scene, False).value for c in candidates))
    function = ca.Function("clearances", [build_features(scene).z], [ca.densify(values)])
    return candidates, Batch(function)


def describe(contacts: Sequence[Contact]) -> str:
    """Names of the contacts in one line."""
    return " ".join(sorted(contact.name for contact in contacts)) or "nothing"


_V = ca.SX.sym("v", 5)  # shared by all scenes, as z is


@stored(lambda contact, scene: (contact, scene.shape))
def _build_part(contact: Contact, scene: Scene) -> tuple[Expression, ...]:
    """Gap, rows A and A_t, A' v, slip coordinate [m] and A_t' v of a contact."""
    features = build_features(scene)
    pair, z = features.pairs[contact], features.z
    A, A_t = (ca.jacobian(value, z) for value in (pair.gap, pair.slip))
    if contact.finger is not None and (contact.feature, contact.surface) == ("v", "tip"):
        # The slip is that of a point on the arc, A_t that of the vertex at any gap.
        A_t *= 1 + pair.gap / scene.fingers[contact.finger].radius
    A_dot_v, A_t_dot_v = (ca.jtimes(rows @ _V, z, _V) for rows in (A, A_t))
    return tuple(ca.cse([pair.gap, A, A_t, A_dot_v, pair.slip, A_t_dot_v]))


@stored(lambda formation: (formation.scene.shape, formation.contacts, formation.rolling))
def _build_function(formation: Formation) -> Batch:
    parts = [_build_part(contact, formation.scene) for contact in formation.contacts]
    rolling = [parts[row] for row in formation.rolling_rows]
    rows = (
        (1, [part[0] for part in parts] + [part[4] for part in rolling]),
        (5, [part[1] for part in parts]),
        (5, [part[2] for part in parts]),
        (1, [part[3] for part in parts] + [part[5] for part in rolling]),
    )
    outputs = [ca.densify(ca.vertcat(ca.SX(0, width), *values)) for width, values in rows]
    return Batch(ca.Function("formation", [build_features(formation.scene).z, _V], outputs))


@stored(_identify_limits)
def _build_limit_function(formation: Formation) -> Batch:
    values = ca.densify(ca.vertcat(*(limit.value for limit in formation.limits)))
    return Batch(ca.Function("limits", [build_features(formation.scene).z], [values]))
