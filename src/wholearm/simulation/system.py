"""Rigid bodies with pairs of features that may touch: gaps, sliding and their Jacobians.

The motion is M z'' = f + S tau - B z' - friction + A^T c_n + A_t^T c_t with a constant diagonal M.
A pair of features has a gap C(z), whose gradient is its row of A, and a slip coordinate s(z), whose
gradient is its row of A_t: how far the features have slid over each other while they touch.

What is compiled is a `Structure`, which knows of no numbers; a `System` has those of one scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Batch, Keeper, kept_property
from ..scene.model import Scales


@dataclass(frozen=True, eq=False)
class ContactPair:
    """Two features that may touch."""

    name: str
    gap: Expression  # [m]: positive when apart
    slip: Expression  # [m]: its rate is the sliding velocity v_t while they touch
    # [m]: all positive where the two face each other; the gap means nothing elsewhere
    ranges: tuple[Expression, ...] = ()
    text: str = ""  # what has happened when the gap closes, in words


class ContactRows(NamedTuple):
    """Pairs at one state: A z' = 0 and A_t z' = 0 keep them closed and stuck."""

    A: Array  # A, A_t (m, n):
    A_t: Array
    bend: Array  # bend, bend_t (m,): A' z' and A_t' z'
    bend_t: Array


@dataclass(frozen=True, eq=False)
class Structure(Keeper):
    """Coordinates and features of bodies of any size and weight."""

    z: Expression  # (n,)
    geometry: Expression  # (g,): numbers that gaps and slip coordinates depend on besides
    pairs: tuple[ContactPair, ...]
    driven: tuple[int, ...]  # coordinates that the two torques act on; empty where there are none
    turns: tuple[bool, ...]  # which coordinates are angles

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.turns)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all pairs."""
        return tuple(pair.name for pair in self.pairs)

    def build_rows(self, chosen: Sequence[int], v: Expression) -> tuple[Expression, ...]:
        """Gaps, slips, A, A_t, A' v and A_t' v of some pairs, as expressions of z and v."""
        parts: list[Expression] = []
        for values in ([self.pairs[k].gap for k in chosen], [self.pairs[k].slip for k in chosen]):
            column = ca.vertcat(ca.SX(0, 1), *values)
            rows = ca.jacobian(column, self.z)
            parts.append((column, rows, ca.jtimes(rows @ v, self.z, v)))
        (gap, A, bend), (slip, A_t, bend_t) = parts
        return gap, slip, A, A_t, bend, bend_t

    @kept_property
    def gap_function(self) -> Expression:
        """CasADi function (z, geometry) -> gaps and ranges of all pairs, shape (N, 2)."""
        gaps = ca.vertcat(ca.SX(0, 1), *(pair.gap for pair in self.pairs))
        least = [ca.mmin(ca.vertcat(1e9, *pair.ranges)) for pair in self.pairs]
        both = ca.densify(ca.horzcat(gaps, ca.vertcat(ca.SX(0, 1), *least)))
        return ca.Function("gaps", [self.z, self.geometry], [both])

    @kept_property
    def gaps(self) -> Batch:
        """The same for many places."""
        return Batch(self.gap_function)


@lru_cache(maxsize=256)
def _build_rows(structure: Structure, chosen: tuple[int, ...]) -> Batch:
    """A, A_t, A' v, A_t' v and slips of some pairs as columns, of z, v and the geometry."""
    v = ca.SX.sym("v", structure.n)
    _, slip, *rows = structure.build_rows(chosen, v)
    both = ca.densify(ca.horzcat(*rows, slip))
    return Batch(ca.Function("rows", [structure.z, v, structure.geometry], [both.T]))


@dataclass(frozen=True, eq=False)
class System:
    """A structure with its numbers."""

    structure: Structure
    geometry: Array  # (g,)
    mass: Array  # (n,): diagonal of M
    applied: Array  # (n,): gravity as a force on z
    # viscous, dry (n,): friction of the coordinates themselves: B, and the largest dry one
    viscous: Array
    dry: Array
    friction: Array  # (N,): Coulomb's coefficient of each pair
    scales: Scales  # units that tolerances count in

    @cached_property
    def n(self) -> int:
        """Number of coordinates."""
        return self.structure.n

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all pairs."""
        return self.structure.names

    @property
    def driven(self) -> tuple[int, ...]:
        """Coordinates that the two torques act on."""
        return self.structure.driven

    @cached_property
    def units(self) -> Array:
        """Units of z, then of z', shape (2 n,)."""
        place = np.where(self.structure.turns, 1.0, self.scales.length)
        return np.concatenate([place, place / self.scales.time])

    def is_slower(self, v: Array, bound: float) -> bool:
        """Whether no component of z', shape (n,), exceeds `bound` times its unit."""
        return bool((np.abs(v) < bound * self.units[self.n :]).all())

    @cached_property
    def friction_units(self) -> Array:
        """Units of the friction of coordinates, shape (n,) [N, N m]."""
        return np.where(self.structure.turns, self.scales.torque, self.scales.force)

    def evaluate(self, z: Array, v: Array, chosen: Sequence[int]) -> ContactRows:
        """Rows of some pairs at one state."""
        n, found = self.n, self._evaluate(z, v, chosen)
        return ContactRows(found[:, :n], found[:, n : 2 * n], found[:, 2 * n], found[:, 2 * n + 1])

    def evaluate_slip(self, z: Array, chosen: Sequence[int]) -> Array:
        """Slip coordinates of some pairs, shape (m,) [m]."""
        return self._evaluate(z, z, chosen)[:, -1]

    def _evaluate(self, z: Array, v: Array, chosen: Sequence[int]) -> Array:
        if not len(chosen):
            return np.zeros((0, 2 * self.n + 3))
        return _build_rows(self.structure, tuple(chosen)).at(z, v, self.geometry)[0]

    def look(self, z: Array) -> tuple[Array, Array]:
        """As `measure`, at one place: shape (N,) each [m]."""
        gaps, ranges = self.structure.gaps.at(z, self.geometry)[0]
        return gaps, ranges

    def measure(self, z: Array) -> tuple[Array, Array]:
        """Gaps of all pairs and distances inside their ranges, (m, N) each [m], at z (m, n)."""
        geometry = np.broadcast_to(self.geometry, (len(z), len(self.geometry)))
        both = self.structure.gaps(z, geometry)[0]
        return both[:, :, 0], both[:, :, 1]

    def stored(self, z: Array, v: Array) -> Array:
        """Kinetic energy less the work of the applied force, shape (...) [J]."""
        return np.asarray(0.5 * (v**2) @ self.mass - z @ self.applied)

    def push(self, v: Array, tau: Array, sigma: Array) -> Array:
        """Forces on z but those of contacts, with dry friction in the directions `sigma`, (n,)."""
        force = self.applied - self.viscous * v - self.dry * sigma
        force[list(self.driven)] += tau[: len(self.driven)]
        return force
