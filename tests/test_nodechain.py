from __future__ import annotations

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest

from wholearm.curve import Curve
from wholearm.ipopt import build_solver
from wholearm.model import Array
from wholearm.options import Objective
from wholearm.pathdomain.nodechain import Chain, Links, StagedSolver, stage
from wholearm.pathdomain.pathdata import prepare
from wholearm.pathdomain.pathmotion import make_grid
from wholearm.pathdomain.pathnlp import Tightening, build_path_nlp, make_bounds, pack, parameters
from wholearm.pathdomain.pathplan import guess

NODES = 7
WIDTHS = (1, 3, 2, 3, 3, 2, 1)


@pytest.fixture(scope="module")
def chain() -> Chain:
    """Nodes of different sizes, linked by sums; every node is pulled to a random place."""
    rng = np.random.default_rng(11)
    parts = [ca.SX.sym(f"x{k}", width) for k, width in enumerate(WIDTHS)]
    p = ca.SX.sym("p")
    links = [ca.sum1(after) - p * before[0] - 0.3 for before, after in pairwise(parts)]
    costs = [
        ca.exp(0.2 * (before[0] + after[-1])) + 0.1 * (before[-1] - after[0]) ** 2
        for before, after in pairwise(parts)
    ]
    pulls = [ca.sumsqr(part - rng.uniform(-2, 2, part.numel())) for part in parts]
    rows = [ca.horzcat(ca.sum1(part), part[0] - 0.5 * part[-1]) for part in parts]
    return Chain(
        ca.vertcat(*parts),
        p,
        np.repeat(np.arange(NODES), WIDTHS),
        # The second row of interval 2 comes after those of all others.
        Links(ca.vertcat(*links, parts[2][0] - parts[3][1]), np.array([*range(NODES - 1), 2])),
        ca.vertcat(*rows),
        ca.vertcat(*costs),
        ca.vertcat(*pulls),
    )


def as_nlp(chain: Chain) -> dict[str, Any]:
    return {
        "x": chain.x,
        "p": chain.p,
        "f": ca.sum1(chain.link_costs) + ca.sum1(chain.node_costs),
        "g": ca.vertcat(chain.links.values, ca.vec(chain.rows.T)),
    }


def miss_optimality(nlp: dict[str, Any], found: dict[str, Any], p: Any) -> Array:
    """Gradient of the Lagrangian of an NLP, which is zero at its solutions."""
    multipliers = ca.SX.sym("multipliers", nlp["g"].numel())
    lagrangian = nlp["f"] + ca.dot(multipliers, nlp["g"])
    slope = ca.Function(
        "slope", [nlp["x"], nlp["p"], multipliers], [ca.gradient(lagrangian, nlp["x"])]
    )
    gradient = slope(found["x"], p, found["lam_g"]) + found["lam_x"]
    return np.asarray(gradient.full()[:, 0])


def test_both_solvers_find_the_same(chain: Chain) -> None:
    nlp = as_nlp(chain)
    staged, plain = stage("toy", chain), build_solver("toy", nlp, 1e-9)
    count, equal = chain.x.numel(), chain.links.values.numel()
    rows = nlp["g"].numel()
    low = np.concatenate([np.zeros(equal), np.full(rows - equal, -0.4)])
    high = np.concatenate([np.zeros(equal), np.full(rows - equal, 0.9)])
    problem = {
        "x0": np.zeros(count),
        "p": np.array([0.7]),
        "lbx": np.full(count, -1.5),
        "ubx": np.full(count, 1.0),
        "lbg": low,
        "ubg": high,
    }
    ours, theirs = staged(**problem), plain(**problem)
    assert staged.stats()["success"] and staged.stats()["return_status"] == "solved"
    np.testing.assert_allclose(ours["x"].full(), theirs["x"].full(), rtol=0, atol=1e-6)
    assert float(ours["f"]) == pytest.approx(float(theirs["f"]), rel=1e-7)
    for key in ("lam_x", "lam_g"):
        np.testing.assert_allclose(ours[key].full(), theirs[key].full(), rtol=0, atol=1e-5)
    # Both kinds of bounds and a link are active, so that none of the multipliers is idle.
    assert np.abs(ours["lam_x"].full()).max() > 0.1 and np.abs(ours["lam_g"].full()).min() < 1e-6
    assert np.abs(miss_optimality(nlp, ours, 0.7)).max() < 1e-8


def test_start_and_multipliers_that_it_has_no_use_for(chain: Chain) -> None:
    staged = stage("toy", chain, max_iter=0)
    count, rows = chain.x.numel(), as_nlp(chain)["g"].numel()
    start = np.random.default_rng(2).uniform(-1, 1, count)
    free = np.full(count, np.inf)
    found = staged(
        x0=start,
        p=np.array([0.7]),
        lbx=-free,
        ubx=free,
        lbg=np.full(rows, -9.0),
        ubg=np.full(rows, 9.0),
        lam_x0=np.ones(count),
    )
    np.testing.assert_array_equal(found["x"].full()[:, 0], start)


@pytest.mark.parametrize("objective", [Objective.TIME, Objective.EFFORT])
def test_a_staged_path_nlp_solves_the_path_nlp(
    curves: tuple[Curve, ...], objective: Objective
) -> None:
    """Its answer satisfies the optimality conditions of the NLP that Ipopt is given."""
    intervals = 40
    plain = build_path_nlp(4, intervals, objective)
    staged = build_path_nlp(4, intervals, objective, solver="fatrop")
    assert isinstance(staged.solver, StagedSolver)
    data = prepare(curves[0], 0.05, make_grid(curves[0], intervals), 1)
    profile, scales = guess(data)
    bounds = make_bounds(plain, data, scales, Tightening.none(data, None))
    p, x0 = parameters(plain, data, scales, 1.0), pack(plain, profile, scales, 0.0)
    found = staged.solver(x0=x0, p=p, **bounds)
    assert staged.solver.stats()["success"]
    x, q = plain.solver.oracle().sx_in()
    f, g = plain.solver.oracle()(x, q)
    nlp = {"x": x, "p": q, "f": f, "g": g}
    assert np.abs(miss_optimality(nlp, found, p)).max() < 1e-8
    values = plain.solver.oracle()(found["x"], p)[1].full()[:, 0]
    assert (values - bounds["lbg"]).min() > -1e-14 and (bounds["ubg"] - values).min() > -1e-14
    exact = plain.solver(x0=x0, p=p, **bounds)
    assert float(found["f"]) == pytest.approx(float(exact["f"]), rel=1e-7)
