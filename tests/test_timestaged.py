"""The time-domain NLP with fatrop: the form that it asks for, and the optimum that Ipopt finds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest

from conftest import HEPTAGON
from timed import flip, landing
from tipping import box
from wholearm import fatrop
from wholearm.cli import main
from wholearm.contact import Expression
from wholearm.fatrop import Stages
from wholearm.model import Array
from wholearm.options import Objective, PlanOptions
from wholearm.outline import load
from wholearm.path import trace_phases
from wholearm.plan import solve
from wholearm.problem import End
from wholearm.timedomain import timenlp, timestaged
from wholearm.timedomain.collocation import make_scheme
from wholearm.timedomain.staging import outline_stages
from wholearm.timedomain.timelayout import pack
from wholearm.timedomain.timenlp import TimeNLP, build_time_nlp
from wholearm.timedomain.timesearch import Search, Solution

IMPACTS = HEPTAGON.with_name("heptagon_impact.toml")
GOALS = [Objective.TIME, Objective.EFFORT]


@lru_cache(maxsize=8)
def optimum(goal: Objective, solver: str) -> Solution:
    problem, scheme = flip(), make_scheme("radau", 3)
    search = Search(problem, PlanOptions(goal), scheme, None, goal, solver=solver)
    return search.solve(outline_stages(problem, problem.phases, problem.start, scheme, 8, 2.0))


class Staged(NamedTuple):
    """An NLP as fatrop gets it, and as Ipopt does, at a point.

    Attributes
    ----------
    stages : Stages
    values, plain : ndarray, shape (m,)
        Its rows.
    jacobian : ndarray, shape (m, n)
    hessian : ndarray, shape (n, n)
        Where the objective's Hessian may be other than zero.
    order : ndarray of int, shape (m,)
    """

    stages: Stages
    values: Array
    plain: Array
    jacobian: Array
    hessian: Array
    order: Array

    @property
    def owners(self) -> Array:
        """Stage of each unknown."""
        sizes = np.add(self.stages.states, self.stages.controls)
        return np.repeat(np.arange(len(sizes)), sizes)

    def blocks(self) -> Iterator[tuple[int, slice, slice]]:
        """Number of each stage, rows of the next stage's states, and its other rows."""
        position = 0
        for k, own in enumerate(self.stages.rows):
            middle = position + [*self.stages.states, 0][k + 1]
            yield k, slice(position, middle), slice(middle, middle + own)
            position = middle + own


def stage_up(case: str, patch: pytest.MonkeyPatch) -> Staged:
    name, goal = ("legendre", Objective.TIME) if case == "rolling" else ("radau", Objective.EFFORT)
    problem, first, last = {
        "four contacts": (flip(), 0, 1),
        "rolling": (box(), 1, 2),
        "landing": (landing(), 4, 6),
    }[case]
    start = trace_phases(problem)[first - 1].end if first else problem.start
    scheme = make_scheme(name, 3)
    stages = outline_stages(problem, problem.phases[first:last], start, scheme, 4, 2.0)
    taken: dict[str, Any] = {}

    def take(key: str, module: Any) -> None:
        build = module.build_solver

        def built(title: str, nlp: dict[str, Expression], *rest: Any, **options: Any) -> Any:
            taken[key] = nlp, rest
            return build(title, nlp, *rest, **options)

        patch.setattr(module, "build_solver", built)

    take("fatrop", timestaged)
    take("ipopt", timenlp)
    nlp = build_time_nlp(stages, scheme, goal, 1.0, 1, solver_name="fatrop")
    build_time_nlp(stages, scheme, goal, 1.0, 1)
    guess = pack([stage.guess for stage in stages], nlp.layouts, 0.0)
    x = guess + np.random.default_rng(3).normal(scale=0.01, size=guess.shape)
    (reordered, (sizes,)), (plain, _) = taken["fatrop"], taken["ipopt"]

    def evaluate(table: dict[str, Expression], what: Expression) -> Array:
        return np.asarray(ca.Function("value", [table["x"]], [what])(x).full())

    return Staged(
        sizes,
        evaluate(reordered, reordered["g"])[:, 0],
        evaluate(plain, plain["g"])[:, 0],
        evaluate(reordered, ca.jacobian(reordered["g"], reordered["x"])),
        ca.DM.ones(ca.hessian(reordered["f"], reordered["x"])[0].sparsity()).full(),
        nlp.solver.order,
    )


def differentiate(nlp: TimeNLP, x: Array) -> tuple[Array, Array]:
    """Gradient of the objective and Jacobian of the rows, as Ipopt gets them."""
    call = nlp.solver.get_function("nlp_jac_g")
    f = nlp.solver.get_function("nlp_grad_f")
    return f(x, [])[1].full()[:, 0], call(x, [])[1].full()


@pytest.mark.parametrize("case", ["four contacts", "rolling", "landing"])
def test_rows_have_the_form_that_fatrop_asks_for(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    staged = stage_up(case, monkeypatch)
    np.testing.assert_array_equal(np.sort(staged.order), np.arange(len(staged.plain)))
    np.testing.assert_allclose(staged.values, staged.plain[staged.order], rtol=1e-12, atol=1e-14)
    owners, end = staged.owners, 0
    for k, links, alone in staged.blocks():
        depends = staged.jacobian[alone] != 0
        assert not depends[:, owners != k].any()
        assert all(staged.stages.equations[links])
        end = alone.stop
        if links.stop == links.start:
            continue
        # x_k+1 - F(x_k, u_k): each state of the next stage by itself, in its place.
        later = staged.jacobian[links][:, owners == k + 1]
        states = staged.stages.states[k + 1]
        np.testing.assert_array_equal(later[:, :states], np.eye(states))
        assert not later[:, states:].any()
        assert not staged.jacobian[links][:, (owners < k) | (owners > k + 1)].any()
    assert end == len(staged.values) == len(staged.stages.equations)
    assert staged.jacobian.shape[1] == len(owners)
    assert not staged.hessian[owners[:, None] != owners].any()
    # Every row says something, and there are equations and inequalities of stages alone.
    assert (staged.jacobian != 0).any(axis=1).all()
    kinds = [set(staged.stages.equations[alone]) for _, _, alone in staged.blocks()]
    assert {True, False} in kinds


@pytest.mark.parametrize("goal", GOALS)
def test_the_optimum_is_that_of_ipopt(goal: Objective) -> None:
    one, other = optimum(goal, "ipopt"), optimum(goal, "fatrop")
    assert one.success and other.success
    assert other.cost == pytest.approx(one.cost, rel=1e-6)
    for ours, theirs in zip(one.stages, other.stages, strict=True):
        assert theirs.guess.duration == pytest.approx(ours.guess.duration, rel=1e-4)
        np.testing.assert_allclose(theirs.guess.z, ours.guess.z, rtol=0, atol=1e-3)


@pytest.mark.parametrize("goal", GOALS)
def test_multipliers_are_those_of_the_rows_as_built(goal: Objective) -> None:
    """Stationarity, with the rows in the order in which Ipopt has them."""
    solution, theirs = optimum(goal, "fatrop"), optimum(goal, "ipopt")
    nlp = theirs.nlp
    gradient, jacobian = differentiate(
        nlp, pack([s.guess for s in solution.stages], nlp.layouts, 0.0)
    )
    lam_g, lam_x = (solution.multipliers[f"{key}0"] for key in ("lam_g", "lam_x"))
    residual = gradient + jacobian.T @ lam_g + lam_x
    assert np.abs(residual).max() < 1e-6
    assert np.abs(gradient + jacobian.T @ lam_g[::-1] + lam_x).max() > 1e-2


def test_plans_by_fatrop_say_so() -> None:
    plan = solve(flip(), transcription="time", solver="fatrop", time_intervals=6)
    other = solve(flip(), transcription="time", time_intervals=6)
    assert (plan.meta["solver"], plan.meta["solvers"]) == ("fatrop", ["fatrop"])
    assert (other.meta["solver"], other.meta["solvers"]) == ("ipopt", ["ipopt"])
    assert plan.duration == pytest.approx(other.duration, rel=1e-4)
    assert np.nanmin(plan.c_n) > flip().epsilon - 1e-6
    assert np.abs(plan.tau).max() < 2.0 + 1e-6


def test_phases_with_impacts_are_left_to_ipopt() -> None:
    problem = load(str(IMPACTS))
    two = replace(problem, phases=(problem.phases[0], replace(problem.phases[1], end=End.REST)))
    plan = solve(two, solver="fatrop", transcription="time", time_intervals=4)
    assert plan.meta["solvers"] == ["ipopt", "ipopt"]
    assert [row["possible"] for row in plan.meta["transitions"]] == [True]


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let fatrop give up at once."""
    build = fatrop.build_solver

    def hasten(*arguments: Any, **options: Any) -> Any:
        return build(*arguments, **(options | {"max_iter": 1}))

    monkeypatch.setattr(timestaged, "build_solver", hasten)


@pytest.mark.usefixtures("stuck")
def test_ipopt_plans_what_fatrop_cannot() -> None:
    plan = solve(flip(), transcription="time", solver="fatrop", time_intervals=4)
    expected = solve(flip(), transcription="time", time_intervals=4)
    assert (plan.meta["solver"], plan.meta["solvers"]) == ("fatrop", ["ipopt"])
    np.testing.assert_array_equal(plan.z, expected.z)
    np.testing.assert_array_equal(plan.tau, expected.tau)


@pytest.mark.usefixtures("stuck")
def test_the_command_line_names_phases_that_ipopt_planned(
    tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    output = str(tmp_path / "plan.npz")
    arguments = ["solve", str(HEPTAGON), "-o", output, "--transcription", "time"]
    arguments += ["--time-intervals", "4", "--solver"]
    assert main([*arguments, "fatrop"]) == 0
    line = "fatrop does not converge: Ipopt planned 1, 2, 3, 4, 5"
    assert line in capsys.readouterr().out.splitlines()
    assert main([*arguments, "ipopt"]) == 0
    assert "does not converge" not in capsys.readouterr().out
