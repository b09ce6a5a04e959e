"""An explicit Runge-Kutta step of order 8 on CasADi expressions.

The method is the embedded pair of order 8(5,3) of Dormand and Prince, as data. Nothing here knows
what is integrated.

References
----------
E. Hairer, S. P. Norsett and G. Wanner, "Solving Ordinary Differential Equations I", 2nd edition,
section II.5 and the code DOP853, whose coefficients these are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression

ORDER = 8

# fmt: off
ROWS: tuple[dict[int, float], ...] = (
    {},
    {
        0: 0.05260015195876773,
    },
    {
        0: 0.0197250569845379, 1: 0.0591751709536137,
    },
    {
        0: 0.02958758547680685, 2: 0.08876275643042054,
    },
    {
        0: 0.2413651341592667, 2: -0.8845494793282861, 3: 0.924834003261792,
    },
    {
        0: 0.037037037037037035, 3: 0.17082860872947386, 4: 0.12546768756682242,
    },
    {
        0: 0.037109375, 3: 0.17025221101954405, 4: 0.06021653898045596, 5: -0.017578125,
    },
    {
        0: 0.03709200011850479, 3: 0.17038392571223998, 4: 0.10726203044637328,
        5: -0.015319437748624402, 6: 0.008273789163814023,
    },
    {
        0: 0.6241109587160757, 3: -3.3608926294469414, 4: -0.868219346841726,
        5: 27.59209969944671, 6: 20.154067550477894, 7: -43.48988418106996,
    },
    {
        0: 0.47766253643826434, 3: -2.4881146199716677, 4: -0.590290826836843,
        5: 21.230051448181193, 6: 15.279233632882423, 7: -33.28821096898486,
        8: -0.020331201708508627,
    },
    {
        0: -0.9371424300859873, 3: 5.186372428844064, 4: 1.0914373489967295,
        5: -8.149787010746927, 6: -18.52006565999696, 7: 22.739487099350505,
        8: 2.4936055526796523, 9: -3.0467644718982196,
    },
    {
        0: 2.273310147516538, 3: -10.53449546673725, 4: -2.0008720582248625, 5: -17.9589318631188,
        6: 27.94888452941996, 7: -2.8589982771350235, 8: -8.87285693353063, 9: 12.360567175794303,
        10: 0.6433927460157636,
    },
)
"""Weights of the stages before, for each stage."""
NODES = (
    0.0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726,
    0.3333333333333333, 0.25, 0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1.0,
)
"""Times of the stages, as shares of a step."""
WEIGHTS = {
    0: 0.054293734116568765, 5: 4.450312892752409, 6: 1.8915178993145003, 7: -5.801203960010585,
    8: 0.3111643669578199, 9: -0.1521609496625161, 10: 0.20136540080403034,
    11: 0.04471061572777259,
}
"""Weights of order 8 by stage."""
ERROR_5 = {
    0: 0.01312004499419488, 5: -1.2251564463762044, 6: -0.4957589496572502, 7: 1.6643771824549864,
    8: -0.35032884874997366, 9: 0.3341791187130175, 10: 0.08192320648511571,
    11: -0.022355307863886294,
}
"""Differences of the weights of order 8 from those of order 5."""
_THIRD = {0: 0.2440944881889764, 8: 0.7338466882816118, 11: 0.022058823529411766}
ERROR_3 = {j: w - _THIRD.get(j, 0.0) for j, w in WEIGHTS.items()}
"""Differences of the weights of order 8 from those of order 3."""
WITHIN_ROWS: tuple[dict[int, float], ...] = (
    WEIGHTS,
    {
        0: 0.056167502283047954, 6: 0.25350021021662483, 7: -0.2462390374708025,
        8: -0.12419142326381637, 9: 0.15329179827876568, 10: 0.00820105229563469,
        11: 0.007567897660545699, 12: -0.008298,
    },
    {
        0: 0.03183464816350214, 5: 0.028300909672366776, 6: 0.053541988307438566,
        7: -0.05492374857139099, 10: -0.00010834732869724932, 11: 0.0003825710908356584,
        12: -0.00034046500868740456, 13: 0.1413124436746325,
    },
    {
        0: -0.42889630158379194, 5: -4.697621415361164, 6: 7.683421196062599,
        7: 4.06898981839711, 8: 0.3567271874552811, 12: -0.0013990241651590145,
        13: 2.9475147891527724, 14: -9.15095847217987,
    },
)
"""Weights of the stages before, for the end of a step and three more stages within it."""
WITHIN_NODES = (1.0, 0.1, 0.2, 0.7777777777777778)
"""Times of these stages."""
WITHIN: tuple[dict[int, float], ...] = (
    {
        0: -8.428938276109013, 5: 0.5667149535193777, 6: -3.0689499459498917,
        7: 2.38466765651207, 8: 2.117034582445028, 9: -0.871391583777973, 10: 2.2404374302607883,
        11: 0.6315787787694688, 12: -0.08899033645133331, 13: 18.148505520854727,
        14: -9.194632392478356, 15: -4.436036387594894,
    },
    {
        0: 10.427508642579134, 5: 242.28349177525817, 6: 165.20045171727028,
        7: -374.5467547226902, 8: -22.113666853125306, 9: 7.733432668472264,
        10: -30.674084731089398, 11: -9.332130526430229, 12: 15.697238121770845,
        13: -31.139403219565178, 14: -9.35292435884448, 15: 35.81684148639408,
    },
    {
        0: 19.985053242002433, 5: -387.0373087493518, 6: -189.17813819516758,
        7: 527.8081592054236, 8: -11.57390253995963, 9: 6.8812326946963, 10: -1.0006050966910838,
        11: 0.7777137798053443, 12: -2.778205752353508, 13: -60.19669523126412,
        14: 84.32040550667716, 15: 11.99229113618279,
    },
    {
        0: -25.69393346270375, 5: -154.18974869023643, 6: -231.5293791760455,
        7: 357.6391179106141, 8: 93.40532418362432, 9: -37.45832313645163, 10: 104.0996495089623,
        11: 29.8402934266605, 12: -43.53345659001114, 13: 96.32455395918828,
        14: -39.17726167561544, 15: -149.72683625798564,
    },
)
"""Weights of all stages in the last four terms of the continuous extension, of order 7."""
# fmt: on


def build_step(
    rate: Callable[[Expression, Expression], Expression],
    y: Expression,
    t: Expression,
    h: Expression,
    moving: int,
) -> tuple[Expression, Expression, Expression]:
    """One step of y' = rate(y[:moving], t), with its two error estimates.

    Parameters
    ----------
    rate : callable
        Right-hand side on expressions, shape (n,).
    y : expression, shape (n,)
    t, h : scalar expression, [s]
        Start and length of the step.
    moving : int
        The others are integrals along the motion of so many, which stages need not have.

    Returns
    -------
    end, fifth, third : expression, shape (n,), (moving,) and (moving,)
        The state at t + h, and the errors of the embedded formulas of order 5 and 3.
    """
    stages, last = _build_combinations(y.shape[0], moving)
    rates: list[Expression] = []
    for combine, row in zip(stages, ROWS, strict=True):
        place = combine(y, t, h, *(rates[j] for j in row)) if row else (y[:moving], t)
        rates.append(rate(*place))
    end, fifth, third = last(y, t, h, *rates)
    return end, fifth, third


@lru_cache(maxsize=8)
def _build_combinations(
    n: int, moving: int, within: bool = False
) -> tuple[list[Expression], Expression]:
    """CasADi functions of y, t, h and rates of stages, for states of length n.

    Those of the stages return where and when each one's rate is taken, from the rates that it
    takes in; the last one, from all rates, the end and both errors, or the terms of what is
    `within` the step. They are the same for every right-hand side, and each step calls them.
    """
    table, nodes = (*ROWS, *WITHIN_ROWS) if within else ROWS, (*NODES, *WITHIN_NODES)
    y, t, h = ca.SX.sym("y", n), ca.SX.sym("t"), ca.SX.sym("h")
    rates = [ca.SX.sym(f"rate_{j}", n) for j in range(len(table))]

    def combine(weights: dict[int, float], count: int = n) -> Expression:
        used = ca.horzcat(ca.SX(count, 0), *(rates[stage][:count] for stage in weights))
        return h * (used @ ca.DM(list(weights.values())))

    stages = []
    for node, row in zip(nodes, table, strict=False):
        place = [y[:moving] + combine(row, moving), t + node * h]
        stages.append(ca.Function("stage", [y, t, h, *(rates[j] for j in row)], place))
    if within:
        whole, first, last = combine(WEIGHTS), h * rates[0], h * rates[len(ROWS)]
        terms = [whole, first - whole, 2 * whole - (first + last), *map(combine, WITHIN)]
        ends = [ca.horzcat(*terms)]
    else:
        ends = [y + combine(WEIGHTS), combine(ERROR_5, moving), combine(ERROR_3, moving)]
    return stages, ca.Function("last", [y, t, h, *rates], ends)


def build_extension(
    rate: Callable[[Expression, Expression], Expression],
    y: Expression,
    t: Expression,
    h: Expression,
    moving: int,
) -> Expression:
    """Terms of the continuous extension of a step, shape (n, 7), for `interpolate`.

    Parameters
    ----------
    rate, y, t, h, moving
        As of `build_step`.
    """
    stages, last = _build_combinations(y.shape[0], moving, within=True)
    rates: list[Expression] = []
    for combine, row in zip(stages, (*ROWS, *WITHIN_ROWS), strict=True):
        place = combine(y, t, h, *(rates[j] for j in row)) if row else (y[:moving], t)
        rates.append(rate(*place))
    return last(y, t, h, *rates)


def interpolate(y: Array, terms: Array, x: Array) -> Array:
    """States within n steps, shape (n, m).

    Parameters
    ----------
    y : ndarray, shape (n, m)
        At the start of each step.
    terms : ndarray, shape (n, m, 7)
        See `build_extension`.
    x : ndarray, shape (n,)
        Where in the step, from 0 to 1.
    """
    value = np.zeros_like(y)
    for k in range(terms.shape[2] - 1, -1, -1):
        value = (value + terms[:, :, k]) * (1 - x if k % 2 else x)[:, None]
    return np.asarray(y + value)


def build_error(
    fifth: Expression,
    third: Expression,
    y: Expression,
    units: Expression,
    tolerance: Expression,
) -> Expression:
    """Size of a step's error over the tolerance, which counts in `units`, or in y above them.

    The combination of the two estimates is that of DOP853 and behaves like h^8.
    """
    scale = tolerance * (units + ca.fabs(y))
    high, low = ca.sumsqr(fifth / scale), ca.sumsqr(third / scale)
    return high / ca.sqrt(y.shape[0] * ca.fmax(high + 0.01 * low, 1e-300))
