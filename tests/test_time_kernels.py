from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plane import make_formation, measure_gaps, measure_slip, unbalance
from timed import landing
from tipping import roll
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.mechanics.dynamics import split_forces
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain import stage_kernels as kernels
from wholearm.planning.time_domain.collocation import blend, make_scheme
from wholearm.planning.time_domain.guesses import guess_stages
from wholearm.planning.time_domain.nlp_layout import Kernel
from wholearm.planning.time_domain.search import TimeSearch
from wholearm.planning.time_domain.stage_kernels import (
    bend_kernel,
    collocation_kernel,
    effort_kernel,
    end_kernel,
    find_leaving,
    goal_kernel,
    impact_kernel,
    new_rows,
    opening_kernel,
    point_kernel,
)
from wholearm.problem.definition import Problem, Until
from wholearm.results.trajectory import Samples
from wholearm.scene.model import Scene

STEP = 1e-4
"""Of central differences along a motion; what they leave out is of the size of its square."""
NAMES = ["v1-palm", "v1-palm v3-finger1", "v1-palm v4-finger1 v6-finger2"]
NAMES += [
    "v0-palm v1-palm v3-finger1 v6-finger2",
    "v0-palm v1-palm v2-finger1 v3-finger1 v5-finger2",
]
ROLLING = {
    "v1-palm": ["v1-palm"],
    "v1-palm v3-finger1": ["v3-finger1"],
    "v1-palm v4-finger1 v6-finger2": ["v1-palm", "v6-finger2"],
}


def formations() -> list[Formation]:
    """One to five contacts, all of them sliding or some of them rolling."""
    scene = landing().scene
    sliding = [make_formation(scene, names) for names in NAMES]
    return sliding + [roll(make_formation(scene, n), *rolls) for n, rolls in ROLLING.items()]


FORMATIONS = formations()
every = pytest.mark.parametrize(
    "formation",
    FORMATIONS,
    ids=lambda f: " ".join(c.name + " rolls" * (c in f.rolling) for c in f.contacts),
)


def call(kernel: Kernel, x: list[Array], *p: Array) -> Array:
    given = np.concatenate([np.zeros(0), *p])
    return np.asarray(kernel.function(np.concatenate(x), given).full()[:, 0])


def draw(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Random z near the heptagon's start, w and u; contacts do not have to be closed."""
    z = landing().start + 0.05 * rng.normal(size=5) * [0.2, 0.2, 1, 1, 1]
    return z, 0.3 * rng.normal(size=5), rng.normal(size=5)


def constraints(formation: Formation, z: Array, w: Array, u: Array) -> tuple[Array, Array]:
    """First and second derivatives of the gaps, and v_t and its derivative where contacts roll."""
    rolling = list(formation.rolling_rows)

    def move(s: float) -> tuple[Array, Array]:
        return z + s * w + s**2 / 2 * u, w + s * u

    before, here, after = (measure_gaps(formation, move(k * STEP)[0]) for k in (-1, 0, 1))
    slip = [measure_slip(formation, *move(k * STEP))[rolling] for k in (-1, 0, 1)]
    first = np.append((after - before) / (2 * STEP), slip[1])
    second = np.append((after - 2 * here + before) / STEP**2, (slip[2] - slip[0]) / (2 * STEP))
    return first, second


@every
def test_points_have_newton_and_euler_and_closed_contacts(formation: Formation) -> None:
    rng = np.random.default_rng(formation.n_constraints)
    n_c, n_p = formation.n_contacts, formation.n_constraints
    for _ in range(3):
        z, v, a = draw(rng)
        forces, tau = rng.normal(size=n_p), rng.normal(size=(3, 2))
        shares = rng.uniform(0.1, 0.3, 3)
        Xi, sigma = rng.choice([-1.0, 1.0], n_c), rng.choice([-1.0, 1.0], 2)
        first, least = (z + 0.02 * rng.normal(size=5) if formation.rolling else z[:0]), 0.3
        x = [z, v, a, forces, tau.ravel(), first]
        y = call(
            point_kernel(formation, 3),
            x,
            Xi,
            sigma,
            np.array([*shares, *[least] * formation.n_contacts]),
        )
        gaps, rates, bends, balance, senses = np.split(y, np.cumsum([n_p, n_p, n_p, 5]))
        np.testing.assert_allclose(gaps[:n_c], measure_gaps(formation, z), atol=1e-13)
        expected = constraints(formation, z, v, a)
        for got, one, size in zip((rates, bends), expected, (1e-7, 1e-5), strict=True):
            np.testing.assert_allclose(got, one, atol=size)
        now = shares @ tau
        c_n, c_t = split_forces(formation, forces, Xi)
        row = Samples(z, v, a, now, c_n, c_t)
        missing, size_of = unbalance(formation, row, sigma)
        # The kernel's rows are masses times accelerations less forces.
        np.testing.assert_allclose(balance, -missing, atol=1e-12 * size_of.max())
        slip = measure_slip(formation, z, v)
        sliding = [k for k in range(n_c) if k not in formation.rolling_rows]
        np.testing.assert_allclose(senses, (Xi * slip - least)[sliding], atol=1e-12)


@every
def test_rolling_contacts_keep_what_has_rolled_by(formation: Formation) -> None:
    rng = np.random.default_rng(3)
    n_c = formation.n_contacts
    z, w, _ = draw(rng)
    first = draw(rng)[0] if formation.rolling else z[:0]
    y = call(end_kernel(formation), [z, w, first])
    assert y.shape == (2 * formation.n_constraints,)
    np.testing.assert_allclose(y[:n_c], measure_gaps(formation, z), atol=1e-13)
    rates, _ = constraints(formation, z, w, 0 * w)
    np.testing.assert_allclose(y[formation.n_constraints :], rates, atol=1e-7)
    if formation.rolling:
        # Sliding velocities add up to the slip coordinates' change, along any path.
        places, weights = np.polynomial.legendre.leggauss(12)
        run = z - first
        rows = list(formation.rolling_rows)
        speeds = [measure_slip(formation, first + (s + 1) / 2 * run, run)[rows] for s in places]
        expected = weights / 2 @ np.array(speeds)
        np.testing.assert_allclose(y[n_c : formation.n_constraints], expected, atol=1e-12)


@pytest.mark.parametrize("until", [None, "v5-finger2", ("x", 0.01), ("phi", -0.3)])
@pytest.mark.parametrize("turns", [(), (1, 4)])
def test_ends_are_where_gaps_coordinates_and_rates_vanish(
    until: str | tuple[str, float] | None, turns: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(11)
    scene = landing().scene
    formation = make_formation(scene, "v0-palm v1-palm v3-finger1")
    gained = roll(make_formation(scene, "v0-palm v1-palm v5-finger2"), "v0-palm")
    z, w, _ = draw(rng)
    expected: list[float] = []
    end = None
    if isinstance(until, str):
        end = Until(parse_contact(until, scene))
        expected.append(measure_gaps(make_formation(scene, until), z)[0])
    elif until is not None:
        end = Until(None, *until)
        expected.append(z[0] - 0.01 if until[0] == "x" else z[2] + 0.3)
    rates = [*measure_slip(formation, z, w), *w[3:]]
    expected += [rates[row] for row in turns]
    # A finger's contact comes up, and a contact with the palm stops sliding.
    assert new_rows(formation, gained) == [2, 3]
    one = make_formation(scene, "v5-finger2")
    opening = constraints(one, z, w, 0 * w)[0][0]
    expected += [opening, measure_slip(formation, z, w)[0]]
    kernel = goal_kernel(formation, end, turns, gained)
    assert kernel is not None
    np.testing.assert_allclose(call(kernel, [z, w]), expected, atol=1e-6)


def test_gaps_open_with_their_second_derivative() -> None:
    rng = np.random.default_rng(5)
    formation = FORMATIONS[2]
    for contact in formation.contacts:
        z, w, u = draw(rng)
        kernel = opening_kernel(formation, contact)
        one = Formation(formation.scene, (contact,))
        second = constraints(one, z, w, u)[1][0]
        np.testing.assert_allclose(call(kernel, [z, w, u]), second, atol=1e-5)


@pytest.mark.parametrize("name, degree", [("radau", 3), ("legendre", 2)])
@pytest.mark.parametrize("freedoms", [1, 2])
def test_collocation_holds_for_what_polynomials_integrate(
    name: str, degree: int, freedoms: int
) -> None:
    rng = np.random.default_rng(7)
    scheme, h = make_scheme(name, degree), 0.3
    # Rates that are polynomials of degree d - 1 are integrated exactly to every point and the end.
    powers = rng.normal(size=(5, degree))
    N, start = rng.normal(size=(5, freedoms)), rng.normal(size=5)

    def state(x: float) -> Array:
        parts = [h * powers[:, k] * x ** (k + 1) / (k + 1) for k in range(degree)]
        return np.asarray(start + np.sum(parts, axis=0))

    places = [*scheme.points, *([] if scheme.ends else [1.0])]
    rates = [powers @ x ** np.arange(degree) for x in scheme.points]
    x = [start, *map(state, places), *rates, np.array([h])]
    kernel = collocation_kernel(name, degree, freedoms)
    np.testing.assert_allclose(call(kernel, x, N.ravel(order="F")), 0.0, atol=1e-13)
    # What is missed is missed along the columns of N, point after point.
    shift = rng.normal(size=5)
    x[1] = x[1] + shift
    missed = call(kernel, x, N.ravel(order="F")).reshape(-1, freedoms)
    np.testing.assert_allclose(missed[0], N.T @ shift, atol=1e-13)
    np.testing.assert_allclose(missed[1:], 0.0, atol=1e-13)


def test_only_what_bends_within_an_interval_costs() -> None:
    straight, weight = np.linspace([1.0, 2.0], [3.0, -1.0], 4), np.array([0.5, 2.0])
    bent = straight + np.array([0.0, 0.0, 0.3, 0.0])[:, None] * [1.0, 0.0]
    got = [call(bend_kernel(4), [own.ravel(), np.array([0.1])], weight) for own in (straight, bent)]
    np.testing.assert_allclose(got[0], 0.0, atol=1e-13)
    # Second differences of 0.3 and -0.6 of the first torque.
    np.testing.assert_allclose(got[1], 0.1 * 0.5 * (0.3**2 + 0.6**2), rtol=1e-12)


@pytest.mark.parametrize("controls", [2, 3, 5])
def test_effort_is_the_integral_of_squares(controls: int) -> None:
    rng = np.random.default_rng(8)
    tau, h = rng.normal(size=(controls, 2)), 0.02
    places, weights = np.polynomial.legendre.leggauss(controls)
    values = blend((places + 1) / 2, controls) @ tau
    expected = h * weights / 2 @ (values**2).sum(axis=1)
    got = call(effort_kernel(controls), [tau.ravel(), np.array([h])])
    np.testing.assert_allclose(got, expected, rtol=1e-14)


@pytest.mark.parametrize("rolls", [(), ("v4-finger1",)])
def test_impacts_balance_the_momentum_of_every_body(rolls: tuple[str, ...]) -> None:
    rng = np.random.default_rng(9)
    scene = landing().scene
    before = make_formation(scene, "v1-palm v3-finger1 v6-finger2")
    after = roll(make_formation(scene, "v1-palm v4-finger1 v6-finger2"), *rolls)
    # An impact is over at once: what has no impulse is left out of the balance.
    bare = [replace(link, viscous=0.0, dry=0.0) for link in scene.fingers]
    still = Scene(scene.polygon, (bare[0], bare[1]), scene.friction, 0.0)
    n_p, n_c = after.n_constraints, after.n_contacts
    assert find_leaving(before, after) == [1]
    for _ in range(3):
        z, v_after, v_before = draw(rng)
        impulses, Xi = rng.normal(size=n_p), rng.choice([-1.0, 1.0], n_c)
        x = [v_after, v_before, z, impulses]
        y = call(impact_kernel(before, after), x, Xi)
        jump, held, leaving, cones = np.split(y, np.cumsum([5, n_p, 1]))
        p_n, p_t = split_forces(after, impulses, Xi)
        row = Samples(z, v_before, v_after - v_before, np.zeros(2), p_n, p_t)
        missing, _ = unbalance(replace(after, scene=still), row, np.ones(2))
        np.testing.assert_allclose(jump, -missing, atol=1e-13 * np.abs(missing).max())
        rates, _ = constraints(after, z, v_after, 0 * z)
        np.testing.assert_allclose(held, rates, atol=1e-6)
        opening, _ = constraints(Formation(scene, before.contacts[1:2]), z, v_after, 0 * z)
        np.testing.assert_allclose(leaving, opening, atol=1e-6)
        rows = list(after.rolling_rows)
        grip = after.friction[rows] * p_n[rows]
        np.testing.assert_allclose(cones, [*(grip - p_t[rows]), *(grip + p_t[rows])], atol=1e-14)


def test_limits_are_no_part_of_kernels(heptagon: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """With other torque limits, nothing that has been built is built again."""
    weaker = heptagon.with_(torque_limit=1.9, speed_limit2=20.0)
    before, after = (problem.phases[0].formation for problem in (heptagon, weaker))
    assert before is not after and point_kernel(before, 2) is point_kernel(after, 2)
    assert before.function is after.function
    stronger = heptagon.with_(torque_limit=2.1)
    other = heptagon.with_(friction_palm=0.11).phases[0].formation
    assert point_kernel(other, 2) is not point_kernel(before, 2)

    def build(problem: Problem) -> None:
        search = TimeSearch.of(problem, PlanOptions())
        given = problem, problem.phases[:1], problem.start, search.scheme
        assert search.build(guess_stages(*given, 4, 2.0)).solver is not None

    build(weaker)

    def refuse(*_: object) -> Kernel:
        raise AssertionError("a kernel is built again")

    monkeypatch.setattr(kernels, "build_kernel", refuse)
    build(stronger)
