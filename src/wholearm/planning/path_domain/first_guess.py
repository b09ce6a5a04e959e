"""First points of the NLP along curves: motions, their multipliers, and the units of the NLP.

Without a minimum-time speed profile b is a parabola in s, and the internal force is amid its range.
With one, the motion is at vertices of the polygon of s'' and internal force that limits allow.
Multipliers are those near the central path.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.dynamics import A, V
from ...mechanics.path_limits import PathLimits
from ...mechanics.speed_sweep import SweepMode
from .elements import DEGREE, Profile
from .path_data import PhaseData
from .path_mesh import Fastest
from .path_nlp import PathNLP, Units
from .rate_terms import exceeds_rates

_SLOW = -12  # height of the slowest guess over that of a fall, as a power of two
_QUICK = 30.0  # largest b of a guess, over that which the torque limits alone allow
_FIRM = 40.0  # largest range of lambda in a guess, over the scene's force or its least value
_LIGHT = 0.5  # least unit of force, over the scene's
_AT_VERTICES = 1e-6, 1e-4  # complementarity and least slack (`center`) of a first guess there
_WILD = 10.0  # s'' over its median above which a vertex is of nearly parallel limits
_NODES = DEGREE + 1


def guess(data: PhaseData, time_weight: float = 0.0) -> tuple[Profile, Units]:
    """A guess with b as high as limits allow, by bisection.

    Where limits forbid even the slowest one, it is as quick as a fall: in units of a slow one the
    regularization would weigh too much.
    """
    b_max = data.largest_b(data.nodes)
    fall = _fall(data)

    def possible(height: float) -> bool:
        low, high = find_internal_force_range(data, height)
        a, b = _parabola(data, height)
        kept = bool(((low <= high) & (low < np.inf)).all() and (b <= b_max).all())
        return kept and not exceeds_rates(data, Profile(a, b, find_middle(data, low, high)[1]))

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
    return min(fall, _QUICK * min(inertia, drag, median))


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
    force = max(_LIGHT * weight, data.epsilon, float(np.abs(middle).mean()))
    profile, torque = Profile(*_parabola(data, height), middle), data.torque_limit
    squares = np.minimum(np.abs(data.nodes.forces.tau(*profile)), torque) ** 2
    power = time_weight + float(squares.sum(axis=1).mean())
    most = max(force, float(np.abs(whole).mean()))
    return profile, Units(length, 0.6 * duration, force, torque, power, most)


def center(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    profile: Profile,
    margin: float,
    complementarity: float = 1e-4,
    least: float = 1e-3,
) -> dict[str, Array]:
    """Multipliers with which a motion is near the central path.

    Their products with slacks, which count as at least `least`, are the `complementarity`, in units
    of the NLP. Those of the links are zero.
    """
    (rows, signs, _), sizes = data.limits.sides, nlp.columns.g.sizes
    slack = data.slack(data.nodes, profile, margin) / units.of(data.limits)[rows]
    on_sides = complementarity / np.maximum(slack, least)
    on_rows = np.zeros((len(on_sides), nlp.shape.rows))
    for side, row in enumerate(rows.tolist()):
        on_rows[:, row] -= signs[side] * on_sides[:, side]
    on_x = np.zeros(nlp.free.shape)
    on_x[:, 0] = -complementarity / np.maximum(profile.b / units.profile[0], least)
    # The chain's multiplier at a node is the sum of those of normal forces from there on.
    chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
    known = {"chain": chain[: sizes["chain"]], "limits": on_rows.ravel()}
    on_g = nlp.columns.g.join(**{name: np.zeros(sizes[name]) for name in sizes} | known)
    return {"lam_x0": on_x[nlp.free], "lam_g0": on_g}


def start_at(
    nlp: PathNLP, data: PhaseData, units: Units, fastest: Fastest
) -> tuple[Profile, dict[str, Array]]:
    """The minimum-time profile at the nodes, and multipliers near the central path.

    It is at vertices of the polygon of s'' and internal force that limits allow. Speeds are
    integrated forwards where s'' is the largest, and backwards where the least.
    """
    grid, sides = data.grid, data.find_limits(data.nodes)
    of_nodes = np.repeat(fastest.find_modes(grid.edges.mean(axis=1)), _NODES)
    runs = np.split(np.arange(len(of_nodes)), np.flatnonzero(np.diff(of_nodes)) + 1)
    held, pushed = of_nodes == SweepMode.HELD, of_nodes == SweepMode.PUSH
    wanted = np.interp(grid.s, (fastest.s[1:] + fastest.s[:-1]) / 2, fastest.slopes)
    b, rows = np.interp(grid.s, fastest.s, fastest.b), sides.eliminate()
    most, least = (_find_pairs(sides, rows, b, largest) for largest in (True, False))
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
    profile = Profile(a, b, lam)
    return profile, center(nlp, data, units, profile, 0.0, *_AT_VERTICES)


def _find_pairs(sides: PathLimits, rows: PathLimits, b: Array, largest: bool) -> NDArray[np.int64]:
    """The sides that meet at the largest or least s'' of each node, shape (n, 2).

    Other sides may take over at element ends: there those of the next node inside are taken.
    """
    row = rows.extreme(b, largest).row.reshape(-1, _NODES)
    row[:, 0], row[:, -1] = row[:, 1], row[:, -2]
    return sides.pair(row.ravel())
