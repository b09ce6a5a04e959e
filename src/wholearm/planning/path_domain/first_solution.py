"""First solution of the path-domain NLP from a minimum-time speed profile, with its multipliers.

The motion is at vertices of the polygon of s'' and internal force that limits allow; multipliers
are the least-squares solution of stationarity, raised to those of a small complementarity. Ipopt
then takes about six iterations instead of fifty.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.path_limits import PathLimits
from ...mechanics.speed_sweep import SweepMode
from ..options import Objective
from .elements import DEGREE, FROM_REST, INSIDE, TO_REST, Grid, Profile, find_basis
from .path_data import PhaseData
from .path_nlp import PathNLP, Units, pack, parameters
from .speed_profile import Fastest
from .terms import LEAST_B

_MU = 1e-7  # initial barrier parameter: complementarity of the multipliers
_INSIDE = 1e-2  # larger slacks count as this one [units of the NLP]
_DAMPING = 1e-10  # of normal equations with dependent rows, over their mean diagonal
_PICARD = 2  # Picard iterations between speeds and vertices
_WILD = 10.0  # s'' over its median above which a vertex is of nearly parallel limits
_NODES = DEGREE + 1


def start_at(
    nlp: PathNLP, data: PhaseData, units: Units, fastest: Fastest
) -> tuple[Profile, dict[str, Array]]:
    """A motion near the minimum-time profile, and estimated multipliers of the NLP.

    The profile is at vertices of the polygon of s'' and internal force that limits allow.
    """
    sides = data.find_limits(data.nodes, fastest.margin)
    vertices = _Vertices.at(data.grid, sides, fastest)
    rows = data.limits.sides[0]
    scale = data.spans / units.of(data.limits)[rows]
    on_links, kept = _find_multipliers(nlp, data, units, vertices)
    rate = 1.0
    if nlp.objective is Objective.MARGIN:
        presses = np.isin(rows[vertices.sides], nlp.shape.presses) & ~vertices.held[:, None]
        # Slope of the margin over the duration.
        rate = 1 / max(float((kept * presses).sum()), _MU)
    on_links, kept = rate * on_links, np.maximum(rate * kept, _MU / _INSIDE)
    (a, b, lam), slack = vertices.profile, _MU / kept / scale[vertices.sides]
    inner_a, inner_lam = sides.meet(b, vertices.sides, slack)
    stay = vertices.held | ~(np.isfinite(inner_a) & np.isfinite(inner_lam))
    moved = Profile(np.where(stay, a, inner_a), b, np.where(stay, lam, inner_lam))
    on_sides = _MU / np.maximum(sides.find_slack(*moved) * scale, _INSIDE)
    free = np.flatnonzero(~vertices.held)
    on_sides[free[:, None], vertices.sides[free]] = kept[free]
    on_b = -_MU / np.maximum(moved.b / units.profile[0], _INSIDE)
    on_b[vertices.held] += kept[vertices.held, 0]
    return moved, _join(nlp, data, on_sides, on_b, on_links, rate)


def _join(
    nlp: PathNLP,
    data: PhaseData,
    on_sides: Array,
    on_b: Array,
    on_links: Array,
    rate: float,
) -> dict[str, Array]:
    """Multipliers of the NLP from those of sides, (n, n_sides), b, links and duration."""
    (rows, signs, _), sizes = data.limits.sides, nlp.columns.g.sizes
    on_rows = np.zeros((len(on_sides), nlp.shape.rows))
    for side, row in enumerate(rows.tolist()):
        on_rows[:, row] -= signs[side] * on_sides[:, side]
    on_x = np.zeros(nlp.free.shape)
    on_x[:, 0] = on_b
    # The chain's multiplier at a node is the sum of those of normal forces from there on.
    chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
    on_g = nlp.columns.g.join(
        links=on_links,
        chain=chain[: sizes["chain"]],
        limits=on_rows.ravel(),
        duration=np.full(sizes["duration"], rate),
        **{name: np.zeros(sizes[name]) for name in ("rates", "commands", "joins", "begins")},
    )
    return {"lam_x0": on_x[nlp.free], "lam_g0": on_g}


class _Vertices(NamedTuple):
    """A motion at vertices of the polygon of s'' and internal force that limits allow."""

    profile: Profile
    sides: NDArray[np.int64]  # (n, 2): which meet there
    held: NDArray[np.bool_]  # (n,): where a speed limit is active instead
    jumps: NDArray[np.int64]  # elements after which s'' jumps from its largest to its least

    @staticmethod
    def at(grid: Grid, sides: PathLimits, fastest: Fastest) -> _Vertices:
        """The vertices of a minimum-time profile.

        Speeds are integrated forwards where s'' is the largest, and backwards where the least.
        """
        modes = fastest.find_modes(grid.edges.mean(axis=1))
        of_nodes = np.repeat(modes, _NODES)
        runs = np.split(np.arange(len(of_nodes)), np.flatnonzero(np.diff(of_nodes)) + 1)
        held, pushed = of_nodes == SweepMode.HELD, of_nodes == SweepMode.PUSH
        wanted = np.interp(grid.s, (fastest.s[1:] + fastest.s[:-1]) / 2, fastest.slopes)
        b, rows = np.interp(grid.s, fastest.s, fastest.b), sides.eliminate()
        for _ in range(_PICARD):
            most, least = (_find_pairs(sides, rows, b, largest) for largest in (True, False))
            (high, press), (low, other) = (sides.meet(b, pair) for pair in (most, least))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.nan_to_num(np.clip((wanted - low) / (high - low), 0.0, 1.0))
            a = np.where(held, wanted, np.where(pushed, high, low))
            between = share * press + (1 - share) * other
            lam = np.where(held, between, np.where(pushed, press, other))
            # Rows within ranges may coincide, and then meet nowhere: no vertex either.
            wild = ~(np.abs(a) <= _WILD * np.median(np.abs(fastest.slopes))) | ~np.isfinite(lam)
            if wild.any() and not wild.all():
                a = np.where(wild, wanted, a)
                lam[wild] = np.interp(grid.s[wild], grid.s[~wild], lam[~wild])
            rise = grid.integrate(a)
            for run in runs:
                end = run[0] if pushed[run[0]] else run[-1]
                if not held[run[0]]:
                    b[run] = np.maximum(b[end] + rise[run] - rise[end], 0.0)
        jumps = np.flatnonzero((modes[:-1] == SweepMode.PUSH) & (modes[1:] == SweepMode.BRAKE))
        pair = np.where(pushed[:, None], most, least)
        return _Vertices(Profile(a, b, lam), pair, held, jumps)


def _find_pairs(sides: PathLimits, rows: PathLimits, b: Array, largest: bool) -> NDArray[np.int64]:
    """The sides that meet at the largest or least s'' of each node, shape (n, 2).

    Other sides may take over at element ends: there those of the next node inside are taken.
    """
    row = rows.extreme(b, largest).row.reshape(-1, _NODES)
    row[:, 0], row[:, -1] = row[:, 1], row[:, -2]
    return sides.pair(row.ravel())


def _find_multipliers(
    nlp: PathNLP, data: PhaseData, units: Units, vertices: _Vertices
) -> tuple[Array, Array]:
    """Least-squares multipliers of the links, (N,), and of the sides that meet, (n, 2).

    From stationarity of the duration, with the Jacobian of the NLP. Where a speed limit is active,
    its multiplier is in the first column.
    """
    (a, b, lam), grid, g = vertices.profile, data.grid, nlp.columns.g
    # The duration has no slope at rest, nor without acceleration there.
    a, b = a.copy(), np.maximum(b, LEAST_B * units.profile[0])
    a[[0, -1]] = np.maximum(np.abs(a[[0, -1]]), LEAST_B * units.profile[1]) * [1.0, -1.0]
    x, p = pack(nlp, Profile(a, b, lam), units, 0.0, grid.sizes), parameters(nlp, data, units, 0.0)
    table = np.full(nlp.free.shape, -1)
    table[nlp.free] = np.arange(len(x))
    unknowns = table[:, :3][table[:, :3] >= 0].tolist()
    rows, signs, _ = data.limits.sides
    # Where s'' jumps the duration does not depend on the speed.
    links = np.delete(np.arange(len(grid.steps)), vertices.jumps * _NODES + DEGREE)
    free = np.flatnonzero(~vertices.held)
    limits = g["limits"].start + free[:, None] * nlp.shape.rows + rows[vertices.sides[free]]
    jacobian = nlp.solver.function.get_function("nlp_jac_g")(x, p)[1]
    bounds = ca.DM.eye(len(x))[table[vertices.held, 0].tolist(), :]
    active = ca.vertcat(jacobian[[*links.tolist(), *limits.ravel().tolist()], :], bounds)
    slope = _find_slopes(grid, vertices.profile, units)[table[:, :3] >= 0]
    active = active[:, unknowns]
    squares = active @ active.T
    damping = _DAMPING * float(ca.trace(squares)) / squares.shape[0]
    solved = ca.solve(squares + damping * ca.DM.eye(squares.shape[0]), active @ slope, "ldl")
    on_links, on_limits, on_b = np.split(-solved.full()[:, 0], np.cumsum([len(links), limits.size]))
    every_link, kept = np.zeros(len(grid.steps)), np.zeros((len(b), 2))
    every_link[links], kept[vertices.held, 0] = on_links, on_b
    kept[free] = -signs[vertices.sides[free]] * on_limits.reshape(-1, 2)
    return every_link, kept


def _find_slopes(grid: Grid, profile: Profile, units: Units) -> Array:
    """Gradient of the NLP's duration at each node over b, s'' and internal force, (n, 3)."""
    basis, count = find_basis(), len(grid.kinds)
    b, a = profile.b / units.profile[0], profile.a / units.profile[1]
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
    return slope.transpose(0, 2, 1).reshape(-1, 3)
