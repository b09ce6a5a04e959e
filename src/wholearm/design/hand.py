"""Optimal design of a hand: numbers within ranges, by COBYQA from several starts.

Each evaluation plans and replays the problems by `solve`; a hand without a plan is infeasible, for
a reason. COBYQA (SciPy) models the value by quadratics in a trust region, and allows points without
a value, as beyond the reach of a hand. The first start is the present hand, others are the first
feasible hands of Latin hypercubes. With several problems the cost is the weighted sum, or the
largest, of the values over those with the present hand.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..analysis.robustness import draw_cube
from ..common.arrays import Array
from ..common.document import Document, Result, Table
from ..common.errors import InfeasibleError, InputError
from ..common.fields import Range, choice
from ..common.parallel import run_tasks
from ..common.sharing import exclusive
from ..planning.options import Objective, PlanOptions
from ..planning.result import UNITS, Plan
from ..problem.definition import Problem
from ..search import solve
from .sweep import Parameter, Planner, find_parameter, read_vary, require_allowed

RADII = (0.3, 0.1)  # of the first trust region of each run of COBYQA, over half a range
FINAL_RADIUS = 1e-2  # radius at which a run ends
COST_TOLERANCE = 1e-3  # relative difference of the values of one optimum


class Choice(NamedTuple):
    """A design variable with its range, and factors of the dotted keys that depend on it."""

    parameter: Parameter
    low: float
    high: float
    factors: Mapping[str, float]

    def at(self, place: float) -> float:
        """The value at a place in the range, from -1 to 1, with six digits."""
        value = (self.low + self.high + place * (self.high - self.low)) / 2
        return float(f"{min(max(value, self.low), self.high):.6g}")


def read_choices(problem: Problem, texts: Sequence[str], symmetric: bool = False) -> list[Choice]:
    """Numbers and their ranges from texts ``NAME=LOW:HIGH``.

    In a symmetric hand each number of a finger holds for the other one, mirrored at x = 0.

    InputError if the problem has no such number, a file may not have LOW or HIGH, these are in the
    wrong order, or a number is chosen twice.
    """
    choices, keys = list[Choice](), set[str]()
    for name, (low, high) in read_vary(texts, 1, "--over").items():
        parameter = find_parameter(problem, name, "--over")
        for end in (low, high):
            require_allowed(problem, name, end, "--over")
        factors = dict.fromkeys(parameter.keys, 1.0)
        for key in parameter.keys if symmetric else ():
            other = re.sub(r"(finger(?:s\.)?)([12])", lambda m: m[1] + "21"[int(m[2]) - 1], key)
            factors.setdefault(other, -1.0 if key.endswith("base[1]") else 1.0)
        if keys & {*factors}:
            raise InputError("", f"--over {name}", "is chosen by what stands before, too")
        keys |= {*factors}
        choices.append(Choice(parameter, low, high, factors))
    return choices


class Hand(NamedTuple):
    """An evaluated hand."""

    start: int  # number of the search, from 1
    shares: tuple[float, ...]  # places in the ranges, from -1 to 1
    cost: float  # to be minimised; NaN without a plan
    reason: str = ""  # of a missing plan


@dataclass(frozen=True, eq=False)
class HandCost:
    """Objective function of a design."""

    choices: tuple[Choice, ...]
    planner: Planner
    today: tuple[float, ...]  # values of the problems with the present hand; NaN without a plan
    weights: Array
    worst: bool  # whether the cost is that of the worst problem, and not the weighted sum

    def find(self, hand: Hand) -> list[float]:
        """The numbers of a hand."""
        return [c.at(place) for c, place in zip(self.choices, hand.shares, strict=True)]

    def rate(self, start: int, shares: Sequence[float]) -> Hand:
        """Plan all problems with a hand; the hand with its cost."""
        hand, values = Hand(start, tuple(shares), math.nan), list[float]()
        sign = -1.0 if self.planner.options["objective"] == "margin" else 1.0
        for index, today in enumerate(self.today):
            row = self.planner.run((0, (index, *self.set(hand).values())))
            if row["value"] is None:
                return hand._replace(reason=row["reason"])
            single = len(self.today) == 1 or math.isnan(today)
            values.append(sign * row["value"] / (1.0 if single else abs(today)))
        return hand._replace(cost=max(values) if self.worst else float(values @ self.weights))

    def set(self, hand: Hand) -> dict[str, float]:
        """Values by dotted keys."""
        pairs = zip(self.choices, self.find(hand), strict=True)
        return {key: f * value for c, value in pairs for key, f in c.factors.items()}

    def search(self, start: int, budget: int, report: Callable[[str], None]) -> list[Hand]:
        """All hands that one search evaluates."""
        from scipy.optimize import minimize

        hands = dict[tuple[float, ...], Hand]()

        def judge(shares: Array) -> float:
            key = tuple(shares.tolist())
            hands[key] = hands.get(key) or self.rate(start, key)
            best = min((h.cost for h in hands.values() if not h.reason), default=math.nan)
            report(f"start {start}: {len(hands)} hands, best {best:.6g}")
            return hands[key].cost

        points = 2 * draw_cube(budget, len(self.choices), start) - 1
        if start == 1:
            present = [c.parameter.value for c in self.choices]
            ends = np.array([(c.low, c.high) for c in self.choices])
            shares = (2 * np.array(present) - ends.sum(axis=1)) / np.ptp(ends, axis=1)
            points = np.vstack([np.clip(np.nan_to_num(shares), -1, 1), points])
        feasible = next((point for point in points if math.isfinite(judge(point))), None)
        max_hands = len(hands) + budget
        for radius in RADII if feasible is not None else ():
            if len(hands) == max_hands:
                break
            # A new run from the best hand: models from far away are wrong along an edge.
            best = min((h for h in hands.values() if not h.reason), key=lambda hand: hand.cost)
            options = {"initial_tr_radius": radius, "final_tr_radius": FINAL_RADIUS}
            options |= {"maxfev": max_hands - len(hands)}
            bounds = [(-1.0, 1.0)] * len(self.choices)
            minimize(judge, best.shares, method="COBYQA", bounds=bounds, options=options)
        return [*hands.values()]


@dataclass(frozen=True, eq=False, repr=False)
class Design(Result):
    """The best hand, its plans, and all evaluated hands."""

    aim: HandCost
    plans: tuple[Plan, ...]  # of the problems, with the best hand
    hands: tuple[Hand, ...]

    @property
    def optima(self) -> list[Hand]:
        """The best hand of each start that has a feasible one, the best of all first."""
        ranked = sorted((hand for hand in self.hands if not hand.reason), key=lambda h: -h.cost)
        return sorted({hand.start: hand for hand in ranked}.values(), key=lambda h: h.cost)

    @property
    def label(self) -> str:
        """The cost, with its unit."""
        goal = Objective(self.aim.planner.options["objective"])
        text = f"{'-' * (goal is Objective.MARGIN)}{goal.value}"
        return f"{text} [{UNITS[goal]}]" if len(self.plans) == 1 else f"{text} over today's"

    @property
    def reasons(self) -> Counter[str]:
        """Numbers of hands without a plan, by reason."""
        return Counter(hand.reason for hand in self.hands if hand.reason)

    @property
    def values(self) -> dict[str, Any]:
        """The values of the JSON document."""
        names = [c.parameter.name for c in self.aim.choices]
        hands = {
            key: [
                {"start": hand.start, "cost": hand.cost, "reason": hand.reason}
                | dict(zip(names, self.aim.find(hand), strict=True))
                for hand in group
            ]
            for key, group in (("optima", self.optima), ("hands", self.hands))
        }
        values = {"value": [plan.value for plan in self.plans], "today": self.aim.today}
        return {"minimised": self.label, "reasons": self.reasons} | values | hands

    @property
    def document(self) -> Document:
        """The best hand, the optima of the starts, and reasons of missing plans."""
        optima, best, rows = self.optima, self.aim.find(self.optima[0]), list[Any]()
        for (parameter, *ends, _), value in zip(self.aim.choices, best, strict=True):
            edge = "at an end" * (value in ends)
            rows.append((parameter.name, parameter.value, value, ends, parameter.unit, edge))
        tables = [Table(["number", "today:.6g", "best:.6g", "range:.6g", "", ""], rows)]
        rows = []
        for hand in optima:
            planned = [not other.reason for other in self.hands if other.start == hand.start]
            rows.append((hand.start, len(planned), sum(planned), hand.cost, self.aim.find(hand)))
        heads = ["start:d", "hands:d", "planned:d", f"{self.label}:.6g", "numbers:.6g"]
        tables += [Table(heads, rows)]
        tables += [Table(["without a plan, by reason", "hands:d"], self.reasons.most_common())]
        equal = optima[-1].cost - optima[0].cost <= COST_TOLERANCE * abs(optima[0].cost)
        text = f"the starts lead to {'one optimum' if equal else 'different optima'}"
        lines = [text] if len(optima) > 1 else []
        for plan, today in zip(self.plans, self.aim.today, strict=True):
            rise = 100 * (plan.value / today - 1)
            change = f"{abs(rise):.2f} % {'more' if rise > 0 else 'less'} than today's {today:.6g}"
            change = change if math.isfinite(today) else "no plan today"
            lines.append(f"{plan.headline}; {change}")
        names = ", ".join(plan.problem.name for plan in self.plans)
        reason = f"{self.label} = {optima[0].cost:.6g}"
        return Document(names, reason=reason, parts=[*tables, *lines])


@exclusive
def design_hand(
    problems: Problem | Sequence[Problem],
    over: Sequence[str],
    minimise: str = "time",
    *,
    symmetric: bool = False,
    weights: Sequence[float] = (),
    worst: bool = False,
    starts: int = 3,
    budget: int = 80,
    jobs: int | None = None,
    progress: Callable[[str], None] = lambda text: None,
    **options: Any,
) -> Design:
    """Hand with the least cost over some problems.

    Parameters
    ----------
    over       numbers and their ranges, as ``length1=0.1:0.25``
    minimise   {"time", "effort", "-margin"}
    symmetric  whether numbers of one finger hold for the other
    weights    of several problems; equal ones if left out
    worst      whether the cost is that of the worst problem, and not the weighted sum
    starts     number of searches
    budget     most hands until the first feasible one of each search, and most after it
    jobs       processes; as many as cores if left out
    **options  as `wholearm.solve` takes them, such as `robust`

    InputError if a problem lacks a number, or a file may not have its range; InfeasibleError, with
    the most frequent reason, if no hand has a plan.
    """
    listed = (problems,) if isinstance(problems, Problem) else tuple(problems)
    choice("time", "effort", "-margin").read(minimise, "--minimise")
    counts = {"problems: COUNT": len(listed), "--over: COUNT": len(over)}
    for key, number in (counts | {"starts": starts, "budget": budget}).items():
        Range(1, 10**5).read(number, key)
    factors = np.array(weights if len(weights) else np.ones(len(listed)), dtype=float)
    if len(factors) != len(listed) or not (factors > 0).all():
        text = f"{weights} given; {len(listed)} positive numbers are needed, one for each problem"
        raise InputError("", "--weights", text)
    choices, *_ = (tuple(read_choices(problem, over, symmetric)) for problem in listed)
    chosen = {"objective": minimise.removeprefix("-"), **options}
    PlanOptions(**chosen)
    progress("planning with the present hand")
    planner = Planner(listed, (), chosen)
    rows = [planner.run((0, (index,))) for index in range(len(listed))]
    today = tuple(math.nan if row["value"] is None else row["value"] for row in rows)
    keys = tuple(key for c in choices for key in c.factors)
    aim = HandCost(choices, Planner(listed, keys, chosen), today, factors / factors.sum(), worst)
    tasks = [partial(aim.search, start, budget, progress) for start in range(1, starts + 1)]
    hands = tuple(hand for searched in run_tasks(tasks, jobs) for hand in searched)
    feasible = [hand for hand in hands if not hand.reason]
    if not feasible:
        reason, count = Counter(hand.reason for hand in hands).most_common(1)[0]
        text = f"none of {len(hands)} hands has a plan; the reason of {count} is: {reason}"
        raise InfeasibleError(text)
    best = aim.set(min(feasible, key=lambda hand: hand.cost))
    return Design(aim, tuple(solve(problem.with_(best), **chosen) for problem in listed), hands)
