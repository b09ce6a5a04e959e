"""First points of the NLP along curves: motions, their multipliers, and the units of the NLP.

Without a minimum-time speed profile b is a parabola in s, the internal force is amid its range, and
multipliers are those near the central path. With one, the motion is at vertices of the polygon of
s'' and internal force that limits allow; multipliers are the least-squares solution of
stationarity, raised to those of a small complementarity. Ipopt then takes four iterations a solve
instead of fifteen.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.dynamics import A, V
from ...mechanics.path_limits import PathLimits
from ...mechanics.speed_sweep import SweepMode
from .elements import DEGREE, FROM_REST, INSIDE, NODES, TO_REST, Elements, Grid, Profile, find_basis
from .path_data import PhaseData
from .path_mesh import Fastest
from .path_nlp import LEAST_B, PathNLP, Units, list_slopes, pack, parameters

_SLOW = -12  # height of the slowest guess over that of a fall, as a power of two
_FIRM = 40.0  # largest range of lambda in a guess, over the scene's force or its least value
# Complementarity of multipliers, and slacks that larger ones count as or that are the least, in
# units of the NLP: near the central path, and at a vertex.
_CENTRAL, _SLACK = 1e-4, 1e-3
_MU, _INSIDE = 1e-7, 1e-2
_WILD = 10.0  # s'' over its median above which a vertex is of nearly parallel limits


def guess(data: PhaseData, time_weight: float = 0.0) -> tuple[Profile, Units]:
    """A guess with b as high as limits allow, by bisection.

    Where limits forbid even the slowest one, it is as quick as a fall: in units of a slow one the
    regularization would weigh too much.
    """
    b_max, fall, grid = data.largest_b(data.nodes), _fall(data), data.grid
    scene, most = data.curve.formation.scene, data.torque_limit

    def possible(height: float) -> bool:
        low, high = find_internal_force_range(data, height)
        a, b = _parabola(data, height)
        kept = bool(((low <= high) & (low < np.inf)).all() and (b <= b_max).all())
        if not (kept and grid.held):
            return kept
        # Torque rates and commands at the nodes.
        profile, lags = Profile(a, b, find_middle(data, low, high)[1]), scene.actuator_lag
        stretch = np.maximum(Elements(grid, profile).stretch, 1e-6)
        y_t = np.sqrt(b).reshape(-1, NODES) / stretch / np.diff(grid.edges)
        tau = data.nodes.forces.tau(*profile).reshape(-1, NODES, 2)
        rates = np.stack(list_slopes())[grid.kinds] @ tau * y_t[..., None]
        command = np.abs(tau + lags * rates) * (lags > 0)
        return bool((np.abs(rates) <= data.rate_limit).all() and (command <= most).all())

    # Bisection over heights from 2^-12 to 2^8 times that of a fall over this length.
    low_power, high_power = float(_SLOW), 8.0
    for _ in range(7):
        power = (low_power + high_power) / 2
        if possible(fall * 2**power):
            low_power = power
        else:
            high_power = power
    none = low_power == _SLOW
    return _guess_at(data, 0.7 * fall * (1.0 if none else 2**low_power), time_weight)


def guess_slowly(data: PhaseData) -> tuple[Profile, Units]:
    """A slow guess, whatever the limits."""
    return _guess_at(data, 0.7 * _fall(data) * 2.0**_SLOW)


def _fall(data: PhaseData) -> float:
    """The b of a fall over the length of the curve, or of what joints may do [m^2/s^2]."""
    length, forces = float(data.grid.s[-1]), data.nodes.forces
    fall = 2 * data.curve.formation.scene.scales.acceleration * length

    def usual(coefficients: Array) -> float:
        """Value at which this coefficient alone takes a joint to its torque limit."""
        return 1 / max(float((np.abs(coefficients) / data.torque_limit).max(axis=1).mean()), 1e-100)

    # The upper median; NumPy's takes 10 ms to import what it needs.
    b_max, middle = data.largest_b(data.nodes), len(data.grid.s) // 2
    median = float(np.partition(b_max, middle)[middle])
    inertia, drag = 2 * length * usual(forces.of_tau[..., A]), usual(forces.of_tau[..., V]) ** 2
    return min(fall, 30.0 * min(inertia, drag, median))  # above what torques alone allow


def _parabola(data: PhaseData, height: float) -> tuple[Array, Array]:
    """The a and b of a parabola in s of this height; its power 4/3 where a starts at zero."""
    length = data.grid.s[-1]
    x = data.grid.s / length
    if data.grid.held:
        arch = np.maximum(4 * x * (1 - x), 0.0)
        slope = 8 / 3 * (1 - 2 * x) / length
        return height * slope * np.cbrt(arch), height * arch * np.cbrt(arch)
    return height * 2 * (1 - 2 * x) / length, height * 4 * x * (1 - x)


def find_internal_force_range(data: PhaseData, height: float) -> tuple[Array, Array]:
    """Least and largest internal force that limits allow at each node."""
    return data.find_limits(data.nodes).find_internal_force_range(*_parabola(data, height))


def find_middle(data: PhaseData, low: Array, high: Array) -> tuple[Array, Array]:
    """The internal force amid its range, and amid at most `_FIRM` of it; zero without a range."""
    finite, force = np.isfinite(low + high) & (low <= high), data.curve.formation.scene.scales.force
    near = np.minimum(high, low + _FIRM * np.maximum(force, np.abs(low)))
    whole, part = (np.where(finite, (low + end) / 2, 0.0) for end in (high, near))
    return whole, part


def _guess_at(data: PhaseData, height: float, time_weight: float = 0.0) -> tuple[Profile, Units]:
    whole, middle = find_middle(data, *find_internal_force_range(data, height))
    length, weight = float(data.grid.s[-1]), data.curve.formation.scene.scales.force
    duration = np.pi / 2 * length / np.sqrt(height)
    force = max(0.5 * weight, data.epsilon, float(np.abs(middle).mean()))  # the least unit
    profile, torque = Profile(*_parabola(data, height), middle), data.torque_limit
    squares = np.minimum(np.abs(data.nodes.forces.tau(*profile)), torque) ** 2
    power = time_weight + float(squares.sum(axis=1).mean())
    most = max(force, float(np.abs(whole).mean()))
    return profile, Units(length, 0.6 * duration, force, torque, power, most)


def center(
    nlp: PathNLP, data: PhaseData, units: Units, profile: Profile, margin: float
) -> dict[str, Array]:
    """Multipliers with which a motion is near the central path."""
    slack = data.slack(data.nodes, profile, margin) / units.of(data.limits)[data.limits.sides[0]]
    on_b = -_CENTRAL / np.maximum(profile.b / units.profile[0], _SLACK)
    links = np.zeros(nlp.columns.g.sizes["links"])
    return _join(nlp, data, _CENTRAL / np.maximum(slack, _SLACK), on_b, links)


def start_at(
    nlp: PathNLP, data: PhaseData, units: Units, fastest: Fastest
) -> tuple[Profile, dict[str, Array]]:
    """A motion near the minimum-time profile, and estimated multipliers of the NLP.

    The profile is at vertices of the polygon of s'' and internal force that limits allow.
    """
    sides = data.find_limits(data.nodes)
    vertices = _Vertices.at(data.grid, sides, fastest)
    scale = data.spans / units.of(data.limits)[data.limits.sides[0]]
    on_links, kept = _find_multipliers(nlp, data, units, vertices)
    kept = np.maximum(kept, _MU / _INSIDE)
    (a, b, lam), slack = vertices.profile, _MU / kept / scale[vertices.sides]
    inner_a, inner_lam = sides.meet(b, vertices.sides, slack)
    stay = vertices.held | ~(np.isfinite(inner_a) & np.isfinite(inner_lam))
    moved = Profile(np.where(stay, a, inner_a), b, np.where(stay, lam, inner_lam))
    on_sides = _MU / np.maximum(sides.find_slack(*moved) * scale, _INSIDE)
    free = np.flatnonzero(~vertices.held)
    on_sides[free[:, None], vertices.sides[free]] = kept[free]
    on_b = -_MU / np.maximum(moved.b / units.profile[0], _INSIDE)
    on_b[vertices.held] += kept[vertices.held, 0]
    return moved, _join(nlp, data, on_sides, on_b, on_links)


def _join(
    nlp: PathNLP, data: PhaseData, on_sides: Array, on_b: Array, on_links: Array
) -> dict[str, Array]:
    """Multipliers of the NLP from those of sides, (n, n_sides), b and links; others are zero."""
    (rows, signs, _), sizes = data.limits.sides, nlp.columns.g.sizes
    on_rows = np.zeros((len(on_sides), nlp.shape.rows))
    for side, row in enumerate(rows.tolist()):
        on_rows[:, row] -= signs[side] * on_sides[:, side]
    on_x = np.zeros(nlp.free.shape)
    on_x[:, 0] = on_b
    # The chain's multiplier at a node is the sum of those of normal forces from there on.
    chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
    known = {"links": on_links, "chain": chain[: sizes["chain"]], "limits": on_rows.ravel()}
    on_g = nlp.columns.g.join(**{name: np.zeros(sizes[name]) for name in sizes} | known)
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
        of_nodes = np.repeat(modes, NODES)
        runs = np.split(np.arange(len(of_nodes)), np.flatnonzero(np.diff(of_nodes)) + 1)
        held, pushed = of_nodes == SweepMode.HELD, of_nodes == SweepMode.PUSH
        wanted = np.interp(grid.s, (fastest.s[1:] + fastest.s[:-1]) / 2, fastest.slopes)
        b, rows = np.interp(grid.s, fastest.s, fastest.b), sides.eliminate()
        pairs = []
        for largest in (True, False):
            # Other sides may take over at the ends of elements: there those of the next node.
            row = rows.extreme(b, largest).row.reshape(-1, NODES)
            row[:, 0], row[:, -1] = row[:, 1], row[:, -2]
            pairs.append(sides.pair(row.ravel()))
        most, least = pairs
        (high, press), (low, other) = (sides.meet(b, pair) for pair in (most, least))
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.nan_to_num(np.clip((wanted - low) / (high - low), 0.0, 1.0))
        a = np.where(held, wanted, np.where(pushed, high, low))
        between = share * press + (1 - share) * other
        lam = np.where(held, between, np.where(pushed, press, other))
        # Parallel rows, as those within ranges may be, meet nowhere or far off: no vertex.
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
    links = np.delete(np.arange(len(grid.steps)), vertices.jumps * NODES + DEGREE)
    free = np.flatnonzero(~vertices.held)
    limits = g["limits"].start + free[:, None] * nlp.shape.rows + rows[vertices.sides[free]]
    jacobian = nlp.solver.function.get_function("nlp_jac_g")(x, p)[1]
    bounds = ca.DM.eye(len(x))[table[vertices.held, 0].tolist(), :]
    active = ca.vertcat(jacobian[[*links.tolist(), *limits.ravel().tolist()], :], bounds)
    # Gradient of the duration over b, s'' and internal force, element by element.
    basis, count = find_basis(), len(grid.kinds)
    b_own, a_own = vertices.profile.b / units.profile[0], vertices.profile.a / units.profile[1]
    weights = basis.weights * np.diff(grid.edges) / units.length
    y = np.where((grid.kinds == INSIDE)[:, None], 0.5, basis.y[grid.kinds])
    slopes = np.zeros((count, 3, NODES))
    slopes[:, 0] = -weights * y * np.maximum(b_own, LEAST_B).reshape(count, -1) ** -1.5
    for e, node, kind in ((0, 0, FROM_REST), (-1, DEGREE, TO_REST)):
        if grid.kinds[e] == kind:
            end = a_own[node if e == 0 else -1]
            per_weight = (2 * (grid.edges[e, 1] - grid.edges[e, 0]) / units.length) ** -0.5
            slopes[e, 0, node] = 0.0
            slopes[e, 1, node] = -np.sign(end) * weights[e, node] * per_weight * abs(end) ** -1.5
    slope = slopes.transpose(0, 2, 1).reshape(-1, 3)[table[:, :3] >= 0]
    active = active[:, unknowns]
    squares = active @ active.T
    damping = 1e-10 * float(ca.trace(squares)) / squares.shape[0]  # rows may be dependent
    solved = ca.solve(squares + damping * ca.DM.eye(squares.shape[0]), active @ slope, "ldl")
    on_links, on_limits, on_b = np.split(-solved.full()[:, 0], np.cumsum([len(links), limits.size]))
    every_link, kept = np.zeros(len(grid.steps)), np.zeros((len(b), 2))
    every_link[links], kept[vertices.held, 0] = on_links, on_b
    kept[free] = -signs[vertices.sides[free]] * on_limits.reshape(-1, 2)
    return every_link, kept
