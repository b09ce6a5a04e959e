"""Explicit Runge-Kutta step of order 8 in CasADi: the pair 8(5,3) of Dormand and Prince.

The coefficients are those of DOP853 (E. Hairer, S. P. Norsett and G. Wanner, "Solving Ordinary
Differential Equations I", 2nd edition, section II.5).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca

from ..common.arrays import Expression

ORDER = 8

# fmt: off
ROWS: tuple[dict[int, float], ...] = (
    {},
    {0: 0.05260015195876773},
    {0: 0.0197250569845379, 1: 0.0591751709536137},
    {0: 0.02958758547680685, 2: 0.08876275643042054},
    {0: 0.2413651341592667, 2: -0.8845494793282861, 3: 0.924834003261792},
    {0: 0.037037037037037035, 3: 0.17082860872947386, 4: 0.12546768756682242},
    {0: 0.037109375, 3: 0.17025221101954405, 4: 0.06021653898045596, 5: -0.017578125},
    {0: 0.03709200011850479, 3: 0.17038392571223998, 4: 0.10726203044637328,
     5: -0.015319437748624402, 6: 0.008273789163814023},
    {0: 0.6241109587160757, 3: -3.3608926294469414, 4: -0.868219346841726,
     5: 27.59209969944671, 6: 20.154067550477894, 7: -43.48988418106996},
    {0: 0.47766253643826434, 3: -2.4881146199716677, 4: -0.590290826836843,
     5: 21.230051448181193, 6: 15.279233632882423, 7: -33.28821096898486,
     8: -0.020331201708508627},
    {0: -0.9371424300859873, 3: 5.186372428844064, 4: 1.0914373489967295,
     5: -8.149787010746927, 6: -18.52006565999696, 7: 22.739487099350505,
     8: 2.4936055526796523, 9: -3.0467644718982196},
    {0: 2.273310147516538, 3: -10.53449546673725, 4: -2.0008720582248625, 5: -17.9589318631188,
     6: 27.94888452941996, 7: -2.8589982771350235, 8: -8.87285693353063, 9: 12.360567175794303,
     10: 0.6433927460157636},
)
"""Weights of the stages before, for each stage."""
NODES = (
    0.0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726,
    0.3333333333333333, 0.25, 0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1.0,
)
"""Times of the stages, as shares of a step."""
INNER_STAGES = (3, 5, 9, 10)  # stages spread over the step that approximate the state well
WEIGHTS = {
    0: 0.054293734116568765, 5: 4.450312892752409, 6: 1.8915178993145003, 7: -5.801203960010585,
    8: 0.3111643669578199, 9: -0.1521609496625161, 10: 0.20136540080403034, 11: 0.04471061572777259,
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
# fmt: on


def build_step(
    rate: Callable[[Expression, Expression], Expression],
    y: Expression,
    t: Expression,
    h: Expression,
    moving: int,
) -> tuple[Expression, Expression, Expression]:
    """Step of y' = rate(y[:moving], t) of length h: the end, and errors of order 5 and 3.

    Components of y (n,) from `moving` on are integrals along the motion; errors do not cover them.
    """
    stages, last = _build_combinations(y.shape[0], moving)
    rates: list[Expression] = []
    for combine, row in zip(stages, ROWS, strict=True):
        place = combine(y, t, h, *(rates[j] for j in row)) if row else (y[:moving], t)
        rates.append(rate(*place))
    end, fifth, third = last(y, t, h, *rates)
    return end, fifth, third


@lru_cache(maxsize=8)
def _build_combinations(n: int, moving: int) -> tuple[list[Expression], Expression]:
    """CasADi functions of y, t, h and rates of stages, for any right-hand side of length n.

    Those of the stages return state and time of each stage, the last one the end and both errors.
    """
    y, t, h = ca.SX.sym("y", n), ca.SX.sym("t"), ca.SX.sym("h")
    rates = [ca.SX.sym(f"rate_{j}", n) for j in range(len(ROWS))]

    def combine(weights: dict[int, float], count: int = n) -> Expression:
        used = ca.horzcat(ca.SX(count, 0), *(rates[stage][:count] for stage in weights))
        return h * (used @ ca.DM(list(weights.values())))

    stages = []
    for node, row in zip(NODES, ROWS, strict=True):
        place = [y[:moving] + combine(row, moving), t + node * h]
        stages.append(ca.Function("stage", [y, t, h, *(rates[j] for j in row)], place))
    ends = [y + combine(WEIGHTS), combine(ERROR_5, moving), combine(ERROR_3, moving)]
    return stages, ca.Function("last", [y, t, h, *rates], ends)


def build_error(
    fifth: Expression, third: Expression, y: Expression, units: Expression, tolerance: Expression
) -> Expression:
    """Error over the tolerance in `units` or y, if larger, combined as in DOP853 (like h^8)."""
    scale = tolerance * (units + ca.fabs(y))
    high, low = ca.sumsqr(fifth / scale), ca.sumsqr(third / scale)
    return high / ca.sqrt(y.shape[0] * ca.fmax(high + 0.01 * low, 1e-300))
