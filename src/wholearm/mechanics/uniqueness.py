"""Uniqueness margin of contact forces (P-matrix): least principal minor of K over the frictionless.

Contact forces solve a linear complementarity problem with K = A M5^-1 (A - U Xi A_t)^T. It has one
solution for all loads if and only if det K_S > 0 for every set S of contacts (Cottle, Pang and
Stone, "The linear complementarity problem", theorem 3.3.7). Without friction the minors of
independent contacts are positive; the margin is the ratio of both.

A contact that does not slide sticks, with its tangential row as one more constraint and c_t as its
force, or slips with c_t = -U c_n or U c_n. Every choice of contacts and modes then has a minor;
with up to four modes in one place positive ones are necessary and sufficient (Kuhn and Loewen,
"Piecewise affine bijections of R^n, and the equation Sx+ - Tx- = y", 1987). Joint friction is
constant and does not enter K. With one sliding contact and a ratio r, friction may be 1 / (1 - r)
times as large before forces cease to be unique.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array, Numbers
from ..contacts.formation import Formation, Kinematics
from . import UNIQUENESS

UNIQUENESS_MARGIN: float = UNIQUENESS.default
_SLIDES, _STICKS, _SLIPS = " ", " sticking", (" slipping +", " slipping -")


def describe_uniqueness(ratio: float, contacts: str, place: str, least: float) -> str:
    """Message about a uniqueness margin that is too small."""
    return (
        f"ambiguous: {contacts}, uniqueness margin {ratio:.2f} at {place} (1 without friction); at "
        f"least {least:g} is asked for, and other contact forces are possible at 0 and below"
    )


class Minors(NamedTuple):
    """The least ratio of a principal minor to that without friction, at n places."""

    # (n,): 1 without effect of friction; forces are not unique at zero and below
    ratios: Array
    choices: Numbers  # (n,): index into `modes` of the least ratio
    modes: list[tuple[str, ...]]  # choices of contacts: the mode of each, empty if not chosen
    names: tuple[str, ...]  # of all contacts

    def find_least(self) -> tuple[float, str, int]:
        """The least ratio of all places, its contacts, and the index of the place."""
        row = int(self.ratios.argmin())
        pairs = zip(self.names, self.modes[self.choices[row]], strict=True)
        chosen = [(name + mode).strip() for name, mode in pairs if mode]
        return float(self.ratios[row]), " with ".join(chosen) or "no contact", row


def find_minors(
    formation: Formation, kinematics: Kinematics, Xi: Array, sticking: tuple[int, ...] = ()
) -> Minors:
    """Least ratio of a principal minor to that without friction, at n configurations.

    Signs Xi are (n_c,) or (n, n_c); `sticking` contacts do not slide, besides rolling ones.
    """
    non_sliding, friction = {*formation.rolling_rows, *sticking}, formation.friction
    kinds = tuple((k in non_sliding, mu > 0) for k, mu in enumerate(friction.tolist()))
    A, A_t = kinematics.A, kinematics.A_t
    slip = friction[:, None] * A_t
    G = A - np.broadcast_to(Xi, A.shape[:2])[..., None] * slip
    forces = [G, A, A_t, *([A - slip, A + slip] if non_sliding else [])]
    rows = np.concatenate([A, A_t], axis=1) if non_sliding else A
    K = (rows / formation.scene.mass_diagonal) @ np.concatenate(forces, axis=1).transpose(0, 2, 1)
    ratios, modes = [np.ones((len(A), 1))], [("",) * len(kinds)]
    for chosen, choices, force_rows in _list_choices(kinds):
        row_numbers = choices[:, :, None]
        frictionless = K[:, row_numbers, choices[:, None, :] + len(kinds)]
        frictional = K[:, row_numbers, force_rows[:, None, :]]
        minors = np.asarray(np.linalg.det(frictionless), dtype=float)
        ratio: Array = np.ones_like(minors)
        # Least Gram determinant of independent rows.
        threshold = 1e-12 * np.einsum("...ii->...i", frictionless).prod(axis=-1)
        np.divide(np.linalg.det(frictional), minors, out=ratio, where=minors > threshold)
        ratios.append(ratio)
        modes += chosen
    table = np.concatenate(ratios, axis=1)
    return Minors(table.min(axis=1), table.argmin(axis=1), modes, formation.names)


_Choices = tuple[tuple[tuple[str, ...], ...], Numbers, Numbers]


@lru_cache(maxsize=64)
def _list_choices(kinds: tuple[tuple[bool, bool], ...]) -> list[_Choices]:
    """All choices of contacts with friction, by number of constraints (at most 5).

    `kinds` has two flags of each contact: it does not slide; it has friction. Returns for m choices
    with k constraints each the mode of each contact, empty if not chosen; the constraints, (m, k),
    as rows of [A; A_t]; and the forces, (m, k), as rows of
    [A - U Xi A_t; A; A_t; A - U A_t; A + U A_t].
    """
    count = len(kinds)
    groups: dict[int, list[tuple[tuple[str, ...], list[int], list[int]]]] = {}
    options = [("", _STICKS, *_SLIPS) if non_sliding else ("", _SLIDES) for non_sliding, _ in kinds]
    block = {_SLIDES: 0, _STICKS: 1, _SLIPS[0]: 3, _SLIPS[1]: 4}
    for modes in product(*options):
        normal = [k for k, mode in enumerate(modes) if mode]
        sticking = [k for k in normal if modes[k] == _STICKS]
        if len(normal + sticking) > 5 or not any(kinds[k][1] for k in normal if k not in sticking):
            continue
        forces = [block[modes[k]] * count + k for k in normal] + [2 * count + k for k in sticking]
        rows = normal + [count + k for k in sticking]
        groups.setdefault(len(rows), []).append((modes, rows, forces))
    columns = (tuple(zip(*chosen, strict=True)) for chosen in groups.values())
    return [(modes, np.array(rows), np.array(forces)) for modes, rows, forces in columns]
