from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from planned import CosineMotion
from shipped import HEPTAGON
from timed import drive
from tipping import roll
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve, tangent_basis
from wholearm.geometry.path_guess import load
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import Directions, metric_weights
from wholearm.planning.options import Objective
from wholearm.planning.time_domain.collocation import Scheme, make_scheme
from wholearm.planning.time_domain.equations import Target
from wholearm.planning.time_domain.nlp_layout import pack
from wholearm.planning.time_domain.stage import LimitMisses, Stage, StagePoints
from wholearm.planning.time_domain.time_nlp import (
    TimeNLP,
    bound_unknowns,
    build_time_nlp,
    raise_bounds,
)

PHASE = 3
"""Of the heptagon, without a reversal."""
SCHEMES = [("radau", 2), ("radau", 3), ("legendre", 2), ("legendre", 3)]
EXACT = 1e-7
"""What the reference leaves of rows that are about one: it differentiates contacts by differences
over a microsecond."""
DURATION = 0.06


@lru_cache(maxsize=1)
def curve() -> Curve:
    return trace_phases(load(str(HEPTAGON)))[PHASE]


@lru_cache(maxsize=32)
def driven(name: str, degree: int, count: int, contacts: int = 4) -> Stage:
    """A motion from rest under torques that are linear in time, by plain Newton and Euler."""
    formation, segment = curve().formation, curve().segments[0]
    start = CosineMotion(curve(), 0.2, 15.0).evaluate(np.zeros(1))
    formation = Formation(formation.scene, formation.contacts[:contacts])
    directions = Directions(segment.Xi[:contacts], segment.sigma)
    tau = np.stack([start.tau[0], 0.9 * start.tau[0]])
    sample = drive(formation, start.z[0], tau, directions, DURATION)
    return Stage(PHASE, formation, directions, sample(make_scheme(name, degree), count))


def build(
    stages: list[Stage], scheme: Scheme, objective: Objective = Objective.TIME, weight: float = 3.0
) -> TimeNLP:
    return build_time_nlp(stages, scheme, Target(objective, 0.05, weight), 1)


def call(nlp: TimeNLP, part: str, x: Array) -> Array:
    values: Any = nlp.solver.function.get_function(part)(x, [])
    return np.asarray(values.full()[:, 0])


def packed(nlp: TimeNLP, stages: list[Stage], margin: float = 0.0) -> Array:
    return pack([stage.guess for stage in stages], nlp.layouts, margin)


def misses(nlp: TimeNLP, x: Array) -> tuple[Array, Array]:
    """What equations and inequalities miss; inequalities are negative where they hold."""
    low, high = nlp.rows.bounds
    values = call(nlp, "nlp_g", x)
    miss = np.maximum(low - values, values - high)
    return np.where(low == high, np.abs(miss), 0.0), np.where(low == high, -np.inf, miss)


def collocation(name: str, degree: int, count: int, contacts: int) -> tuple[Array, Array]:
    """What collocation misses at inner points and at the ends of intervals."""
    scheme, stage = make_scheme(name, degree), driven(name, degree, count, contacts)
    nlp = build([stage], scheme)
    equations, _ = misses(nlp, packed(nlp, [stage]))
    rows = nlp.rows_of[0]
    own = equations[rows.states]
    assert own.shape == (count, 2, degree + (not scheme.ends), 5 - stage.formation.n_constraints)
    # Everything else holds at once: contacts, balances, and contacts at the ends.
    assert equations[rows.chain].max(initial=0.0) < EXACT
    assert equations[rows.points].max() < EXACT
    return own[:, :, :-1].max(), own[:, :, -1].max()


@pytest.mark.parametrize(
    "name, degree, contacts", [*((*scheme, 4) for scheme in SCHEMES), ("radau", 3, 3)]
)
def test_a_known_motion_satisfies_the_equations_to_the_schemes_order(
    name: str, degree: int, contacts: int
) -> None:
    scheme = make_scheme(name, degree)
    # Three contacts let the object go astray ever faster, so intervals have to be shorter, but
    # not so short that the reference's own 1e-11 counts.
    short = (8, 16) if scheme.order == 6 else (16, 32)
    counts = short if contacts == 3 else (4, 8) if degree == 2 else (2, 4)
    coarse, fine = (collocation(name, degree, count, contacts) for count in counts)
    inner, ends = np.log2(np.array(coarse) / np.array(fine))
    # To inner points integrals are exact for degree d - 1, to the end for that of the order.
    assert inner == pytest.approx(degree + 1, abs=0.4)
    assert ends == pytest.approx(scheme.order + 1, abs=0.5)
    assert max(fine) < 1e-3


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_a_known_motion_keeps_the_limits(name: str, degree: int) -> None:
    scheme, stage = make_scheme(name, degree), driven(name, degree, 8)
    nlp = build([stage], scheme)
    x = packed(nlp, [stage])
    low_x, high_x = bound_unknowns(nlp, [stage], scheme)
    low, _ = raise_bounds(nlp, [stage], [LimitMisses.none(stage)], (low_x, high_x))
    nlp.rows.bounds[0][:] = low
    _, inequalities = misses(nlp, x)
    # Slip and joint speeds start from nothing.
    assert inequalities.max() < 1e-9 and (x > low_x - 1e-9).all() and (x < high_x + 1e-9).all()


@pytest.mark.parametrize("change, least", [("tau", 0.5), ("forces", 0.1), ("z", 1e-2), ("v", 1e-3)])
@pytest.mark.parametrize("name", ["radau", "legendre"])
def test_every_unknown_matters(name: str, change: str, least: float) -> None:
    scheme, stage = make_scheme(name, 3), driven(name, 3, 8)
    nlp = build([stage], scheme)
    rest = misses(nlp, packed(nlp, [stage]))[0]
    off = stage.guess._replace(**{change: getattr(stage.guess, change) + 1.0})
    equations, _ = misses(nlp, pack([off], nlp.layouts, 0.0))
    assert (equations - rest).max() > least


@pytest.mark.parametrize("row", range(6))
def test_friction_the_wrong_way_breaks_a_limit(row: int) -> None:
    scheme, stage = make_scheme("radau", 3), driven("radau", 3, 8)
    signs = np.concatenate(stage.directions)
    signs[row] *= -1
    wrong = replace(stage, directions=Directions(signs[:4], signs[4:]))
    nlp = build([wrong], scheme)
    x = packed(nlp, [wrong])
    low, high = bound_unknowns(nlp, [wrong], scheme)
    worst = max(misses(nlp, x)[1].max(), (low - x).max(), (x - high).max())
    assert worst > 0.02


@pytest.mark.parametrize("objective", [Objective.TIME, Objective.EFFORT, Objective.MARGIN])
def test_what_is_made_least(objective: Objective) -> None:
    scheme, stage = make_scheme("radau", 3), driven("radau", 3, 8)
    nlp = build([stage], scheme, objective)
    cost = call(nlp, "nlp_f", packed(nlp, [stage], 0.7))[0]
    first, last = stage.guess.tau[0, 0], stage.guess.tau[-1, 1]
    squares = DURATION / 3 * (first @ first + first @ last + last @ last)
    least = {
        Objective.TIME: DURATION,
        Objective.EFFORT: squares + 3.0 * DURATION,
        Objective.MARGIN: -0.7,
    }
    assert cost == pytest.approx(least[objective], rel=1e-12)


@pytest.mark.parametrize("name", ["radau", "legendre"])
def test_the_margin_raises_what_forces_have_to_exceed(name: str) -> None:
    scheme, stage = make_scheme(name, 3), driven(name, 3, 8)
    nlp = build([stage], scheme, Objective.MARGIN)
    low_x, high_x = bound_unknowns(nlp, [stage], scheme)
    low, _ = raise_bounds(nlp, [stage], [LimitMisses.none(stage)], (low_x, high_x))
    assert not np.isfinite(low_x[nlp.layouts[0].forces]).any()
    # The polynomial through the points may pass a little below them at the ends of an interval.
    room = stage.guess.forces.min() - 0.05
    for extra, kept in ((0.9 * room, True), (1.02 * room, False)):
        values = call(nlp, "nlp_g", packed(nlp, [stage], extra))
        assert bool((values - low)[nlp.rows_of[0].limits.presses].min() > 0) is kept


def cut(stage: Stage, count: int) -> list[Stage]:
    """Two stages, the first one of `count` intervals."""
    part, K = stage.guess, stage.intervals
    halves = []
    for own, nodes in ((slice(None, count), slice(None, count + 1)), (slice(count, None),) * 2):
        share = float(part.fractions[own].sum())
        guess = StagePoints(
            part.duration * share,
            part.fractions[own] / share,
            part.nodes[nodes],
            part.z[own],
            part.v[own],
            part.a[own],
            part.forces[own],
            part.tau[own],
            np.zeros(0),
        )
        halves.append(replace(stage, guess=guess))
    assert sum(half.intervals for half in halves) == K
    return halves


def test_derivatives_of_the_whole_are_its_differences() -> None:
    scheme = make_scheme("legendre", 2)
    first, second = cut(driven("legendre", 2, 6), 3)
    rolling = roll(first.formation, first.formation.names[0])
    table = np.zeros((*first.guess.forces.shape[:2], 5))
    table[..., :4] = first.guess.forces
    first = replace(first, formation=rolling, guess=first.guess._replace(forces=table))
    nlp = build([first, second], scheme, Objective.MARGIN)
    rng = np.random.default_rng(4)
    x = packed(nlp, [first, second], 0.1)
    step = rng.normal(size=len(x))
    jacobian: Any = nlp.solver.function.get_function("nlp_jac_g")
    hessian: Any = nlp.solver.function.get_function("nlp_hess_l")
    lam = rng.normal(size=len(nlp.rows.bounds[0]))

    def slope(x: Array) -> Any:
        return jacobian(x, [])[1].sparse()

    h = 1e-6
    exact = slope(x) @ step
    change = (call(nlp, "nlp_g", x + h * step) - call(nlp, "nlp_g", x - h * step)) / (2 * h)
    np.testing.assert_allclose(change, exact, atol=1e-6 * np.abs(exact).max())
    upper = hessian(x, [], 1.0, lam).full()
    bend = (upper + np.triu(upper, 1).T) @ step
    change = (slope(x + h * step).T @ lam - slope(x - h * step).T @ lam) / (2 * h)
    np.testing.assert_allclose(change, bend, atol=1e-6 * np.abs(bend).max())


@pytest.mark.parametrize("contacts", [4, 3])
def test_the_tangent_basis_is_what_contacts_leave_free(contacts: int) -> None:
    stage = driven("radau", 3, 8, contacts)
    z, formation = stage.guess.nodes[0, 0], stage.formation
    N = tangent_basis(formation, z)
    assert N.shape == (5, 5 - contacts)
    P = formation.evaluate(z[None], np.zeros((1, 5))).P[0]
    # Along the columns of N over the metric contacts stay closed; N^T are coordinates along them.
    metric = metric_weights(formation.scene)[:, None] / formation.scene.polygon.gyration_radius**2
    np.testing.assert_allclose(P @ (N / metric), 0.0, atol=1e-13)
    np.testing.assert_allclose(N.T @ (N / metric), np.eye(5 - contacts), atol=1e-13)
