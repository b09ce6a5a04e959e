"""Where the NLP starts from a fastest motion: a point near its central path, with multipliers.

At every node the motion is in a corner of what limits allow. Which limits these are is known, and
so are the multipliers for which the duration is stationary: those of least squares. The motion is
then moved inside the limits by as much as suits them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ..lower_bound.rows import Rows
from ..lower_bound.sweep import Mode
from ..options import Objective
from .corners import LimitSides
from .data import PhaseData
from .elements import DEGREE, FROM_REST, INSIDE, TO_REST, Grid, Profile, find_basis
from .fastest import Fastest
from .misses import PathSolution
from .nlp import PathNLP, Units
from .terms import LEAST_B

_MU = 1e-7
"""Complementarity of the multipliers: the barrier parameter to start from."""
_INSIDE = 1e-2
"""Largest slack of a limit that is kept with none, in the units of the NLP; others count as it."""
_FAR_MU, _FAR_INSIDE = 1e-2, 1e-3
"""The same two where nothing is known of a solution."""
_PLAIN = 1e-10
"""What is added to the squares of rows that may depend on each other, over the mean of all."""
_PICARD = 2
"""Rounds in which speeds and corners are made to agree."""
_WILD = 10.0
"""How much larger than usual s'' is in a corner of limits that hardly cross there."""
_NODES = DEGREE + 1


def balance(nlp: PathNLP, data: PhaseData, units: Units, profile: Profile) -> dict[str, Array]:
    """Multipliers with which any motion is near the central path, if it keeps limits at all."""
    slack = data.slack(data.nodes, profile) / units.of(data.limits)[data.limits.sides[0]]
    on_b = -_FAR_MU / np.maximum(profile.b / units.profile[0], _FAR_INSIDE)
    return _join(nlp, data, _FAR_MU / np.maximum(slack, _FAR_INSIDE), on_b)


def start_at(
    nlp: PathNLP, data: PhaseData, units: Units, found: Fastest
) -> tuple[PathSolution, Profile]:
    """A motion near a fastest one on the grid of `data`, with multipliers near those of a plan.

    And that in the corners themselves.
    """
    sides = LimitSides.of(data, data.nodes, found.margin)
    corners = _Corners.at(data.grid, sides, found)
    rows = data.limits.sides[0]
    scale = data.spans / units.of(data.limits)[rows]
    on_links, kept = _find_multipliers(data.grid, sides, corners, scale, units)
    rate = 1.0
    if nlp.objective is Objective.MARGIN:
        presses = np.isin(rows[corners.sides], nlp.shape.presses) & ~corners.held[:, None]
        # So much does the margin change with the duration.
        rate = 1 / max(float((kept * presses).sum()), _MU)
    on_links, kept = rate * on_links, np.maximum(rate * kept, _MU / _INSIDE)
    moved = corners.move_inside(sides, _MU / kept / scale[corners.sides])
    on_sides = _MU / np.maximum(sides.find_slack(moved) * scale, _INSIDE)
    free = np.flatnonzero(~corners.held)
    on_sides[free[:, None], corners.sides[free]] = kept[free]
    on_b = -_MU / np.maximum(moved.b / units.profile[0], _INSIDE)
    on_b[corners.held] += kept[corners.held, 0]
    multipliers = _join(nlp, data, on_sides, on_b, on_links, rate)
    return PathSolution(moved, found.margin, multipliers), corners.profile


def _join(
    nlp: PathNLP,
    data: PhaseData,
    on_sides: Array,
    on_b: Array,
    on_links: Array | float = 0.0,
    rate: float = 0.0,
) -> dict[str, Array]:
    """The NLP's multipliers from those of sides, (n, n_sides), of b, of links and the duration."""
    (rows, signs, _), sizes = data.limits.sides, nlp.columns.g.sizes
    on_rows = np.zeros((len(on_sides), nlp.shape.rows))
    for side, row in enumerate(rows.tolist()):
        on_rows[:, row] -= signs[side] * on_sides[:, side]
    on_x = np.zeros(nlp.free.shape)
    on_x[:, 0] = on_b
    # The margin at each node is held by what presses from there on.
    chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
    on_g = nlp.columns.g.join(
        links=on_links + np.zeros(sizes["links"]),
        chain=chain[: sizes["chain"]],
        limits=on_rows.ravel(),
        duration=np.full(sizes["duration"], rate),
        **{name: np.zeros(sizes[name]) for name in ("rates", "commands", "joins", "begins")},
    )
    return {"lam_x0": on_x[nlp.free], "lam_g0": on_g}


class _Corners(NamedTuple):
    """A motion in corners of limits.

    Attributes
    ----------
    profile : Profile
    sides : ndarray of int, shape (n, 2)
        Which meet there.
    held : ndarray of bool, shape (n,)
        Where it is the speed that has a limit instead.
    jumps : ndarray of int
        Elements after which s'' jumps from its largest to its least.
    """

    profile: Profile
    sides: NDArray[np.int64]
    held: NDArray[np.bool_]
    jumps: NDArray[np.int64]

    @staticmethod
    def at(grid: Grid, sides: LimitSides, found: Fastest) -> _Corners:
        """The corners that a fastest motion is in.

        Speeds are integrated forwards where it has the largest s'', and backwards where the least.
        """
        modes = found.find_modes(grid.edges.mean(axis=1))
        of_nodes = np.repeat(modes, _NODES)
        runs = np.split(np.arange(len(of_nodes)), np.flatnonzero(np.diff(of_nodes)) + 1)
        held, pushed = of_nodes == Mode.HELD, of_nodes == Mode.PUSH
        wanted = np.interp(grid.s, (found.s[1:] + found.s[:-1]) / 2, found.slopes)
        b, rows = np.interp(grid.s, found.s, found.b), sides.eliminate()
        for _ in range(_PICARD):
            most, least = (_find_pairs(sides, rows, b, largest) for largest in (True, False))
            (high, press), (low, other) = (sides.meet(b, pair) for pair in (most, least))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.nan_to_num(np.clip((wanted - low) / (high - low), 0.0, 1.0))
            a = np.where(held, wanted, np.where(pushed, high, low))
            between = share * press + (1 - share) * other
            squeeze = np.where(held, between, np.where(pushed, press, other))
            # Rows within ranges may coincide, and then meet nowhere: those are no corner either.
            wild = ~(np.abs(a) <= _WILD * np.median(np.abs(found.slopes))) | ~np.isfinite(squeeze)
            if wild.any() and not wild.all():
                a = np.where(wild, wanted, a)
                squeeze[wild] = np.interp(grid.s[wild], grid.s[~wild], squeeze[~wild])
            rise = grid.integrate(a)
            for run in runs:
                end = run[0] if pushed[run[0]] else run[-1]
                if not held[run[0]]:
                    b[run] = np.maximum(b[end] + rise[run] - rise[end], 0.0)
        jumps = np.flatnonzero((modes[:-1] == Mode.PUSH) & (modes[1:] == Mode.BRAKE))
        pair = np.where(pushed[:, None], most, least)
        return _Corners(Profile(a, b, squeeze), pair, held, jumps)

    def move_inside(self, sides: LimitSides, slack: Array) -> Profile:
        """The motion with some slack of the sides that meet, shape (n, 2)."""
        a, b, squeeze = self.profile
        inner_a, inner_squeeze = sides.meet(b, self.sides, slack)
        stay = self.held | ~(np.isfinite(inner_a) & np.isfinite(inner_squeeze))
        return Profile(np.where(stay, a, inner_a), b, np.where(stay, squeeze, inner_squeeze))


def _find_pairs(sides: LimitSides, rows: Rows, b: Array, largest: bool) -> NDArray[np.int64]:
    """The sides that meet at the largest or the least s'' of each node, shape (n, 2).

    Where elements meet other sides may take over. There those that meet at the next node inside do.
    """
    row = rows.extreme(b, largest).row.reshape(-1, _NODES)
    row[:, 0], row[:, -1] = row[:, 1], row[:, -2]
    return sides.pair(row.ravel())


def _find_multipliers(
    grid: Grid, sides: LimitSides, corners: _Corners, scale: Array, units: Units
) -> tuple[Array, Array]:
    """Multipliers of the links, shape (N,), and of the sides that meet, shape (n, 2).

    Of a speed limit instead of the first of them where there is one. The duration is stationary
    with them but for what no multipliers can balance. Unknowns and rows are put together by
    elements, of which only neighbours have to do with each other.
    """
    own, across = _list_rows(grid, sides, corners, scale, units)
    slope = _find_slopes(grid, corners.profile, units)
    ahead = np.concatenate([own[1:], np.zeros_like(own[:1])])
    squares = own @ own.transpose(0, 2, 1) + across @ across.transpose(0, 2, 1)
    squares += _PLAIN * np.trace(squares, axis1=1, axis2=2).mean() * np.eye(own.shape[1])
    beside = across @ ahead.transpose(0, 2, 1)
    pull = -(own @ slope[..., None])
    pull[:-1] -= across[:-1] @ slope[1:, :, None]
    for e in range(len(own) - 1):
        solved = np.linalg.solve(squares[e], np.hstack([beside[e], pull[e]]))
        squares[e + 1] -= beside[e].T @ solved[:, :-1]
        pull[e + 1] -= beside[e].T @ solved[:, -1:]
        beside[e], pull[e] = solved[:, :-1], solved[:, -1:]
    pull[-1] = np.linalg.solve(squares[-1], pull[-1])
    for e in reversed(range(len(own) - 1)):
        pull[e] -= beside[e] @ pull[e + 1]
    found = pull[..., 0]
    on_sides = -found[:, _NODES:].reshape(-1, 2, _NODES).transpose(0, 2, 1)
    return found[:, :_NODES].ravel()[:-1], on_sides.reshape(-1, 2)


def _list_rows(
    grid: Grid, sides: LimitSides, corners: _Corners, scale: Array, units: Units
) -> tuple[Array, Array]:
    """Rows of each element, and what they are of the next one's unknowns, (E, 3 p + 3, 3 p + 3).

    Unknowns are b, a and the squeeze at its nodes; rows are the links to each next node and the
    sides that meet at its nodes.
    """
    count, inner = len(grid.kinds), np.arange(DEGREE)
    lengths = np.diff(grid.edges) / units.length
    own = np.zeros((count, 3 * _NODES, 3 * _NODES))
    across = np.zeros_like(own)
    own[:, inner, inner], own[:, inner, inner + 1] = -1.0, 1.0
    own[:, :DEGREE, _NODES : 2 * _NODES] = -lengths[..., None] * find_basis().links[grid.kinds]
    own[:-1, DEGREE, DEGREE], across[:-1, DEGREE, 0] = -1.0, 1.0
    # Where s'' jumps the duration does not depend on the speed.
    own[corners.jumps, DEGREE], across[corners.jumps, DEGREE] = 0.0, 0.0
    k = np.arange(len(grid.s))[:, None]
    speed = np.sqrt(np.maximum(corners.profile.b, LEAST_B * units.profile[0]))[:, None]
    of_b = (sides.bend + sides.drag / (2 * speed))[k, corners.sides]
    parts = np.stack([of_b, sides.rate[k, corners.sides], sides.press[k, corners.sides]], axis=-1)
    parts *= scale[corners.sides][..., None] * units.profile
    parts[corners.held] = 0.0
    parts[corners.held, 0, 0] = -1.0
    parts = parts.reshape(count, _NODES, 2, 3)
    node = np.arange(_NODES)
    for side in range(2):
        for unknown in range(3):
            rows, columns = node + (1 + side) * _NODES, node + unknown * _NODES
            own[:, rows, columns] = parts[:, :, side, unknown]
    own[0, :, 0] = own[-1, :, DEGREE] = 0.0
    return own, across


def _find_slopes(grid: Grid, profile: Profile, units: Units) -> Array:
    """How the duration depends on b and a at the nodes of each element, (E, 3 p + 3).

    Of the quadrature of `terms`.
    """
    basis, count = find_basis(), len(grid.kinds)
    b, a = (profile.b / units.profile[0], profile.a / units.profile[1])
    weights = basis.weights * np.diff(grid.edges) / units.length
    y = np.where((grid.kinds == INSIDE)[:, None], 0.5, basis.y[grid.kinds])
    slope = np.zeros((count, 3, _NODES))
    slope[:, 0] = -weights * y * np.maximum(b, LEAST_B).reshape(count, -1) ** -1.5
    for e, node, kind in ((0, 0, FROM_REST), (-1, DEGREE, TO_REST)):
        if grid.kinds[e] == kind:
            end = a[node if e == 0 else -1]
            per_weight = (2 * (grid.edges[e, 1] - grid.edges[e, 0]) / units.length) ** -0.5
            slope[e, 0, node] = 0.0
            slope[e, 1, node] = -np.sign(end) * weights[e, node] * per_weight * abs(end) ** -1.5
    return slope.reshape(count, -1)
