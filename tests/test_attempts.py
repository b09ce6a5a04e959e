"""Initial guesses of phases, friction homotopy, and ends that are given in full."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from functools import cache, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import Chebyshev, Polynomial
from scipy.optimize import linprog, minimize

from plane import make_formation, measure_gaps
from planned import plan_landing
from scenes import shove
from shipped import FOLDER, HEPTAGON, problem_of, tipping
from timed import landing, stages_of, tables, total
from timed import plan_landing as plan_landing_over_time
from wholearm import End, InputError, Phase, PlanOptions, Problem, simulate, verify
from wholearm.common.arrays import Array
from wholearm.geometry.curve import find_tied, tangent_basis
from wholearm.geometry.explore import close_contacts
from wholearm.geometry.path_guess import find_end, guess_phase, list_ends
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import metric_weights
from wholearm.planning.plan import solve
from wholearm.planning.time_domain import guesses, time_plan
from wholearm.planning.time_domain.collocation import Scheme, make_scheme
from wholearm.planning.time_domain.guesses import (
    GRADUAL,
    LONGER,
    MOST,
    NEAREST,
    ONSETS,
    OTHER,
    STRAIGHT,
    Guess,
    Guesses,
    PathMargin,
    find_modes,
    guess_stages,
    split_by_signs,
)
from wholearm.planning.time_domain.mode_search import LEAST_INTERVALS, mode_of
from wholearm.planning.time_domain.refinement import SETTINGS, count_halvings, find_least
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stage import (
    Stage,
    StagePoints,
    bisect,
    bisect_intervals,
    in_own_units,
    resample,
)
from wholearm.planning.time_domain.time_motion import StageMotion
from wholearm.planning.time_domain.time_nlp import goal_kernel, pack
from wholearm.planning.time_domain.time_plan import GAIN, choose_end, plan_phases, try_phases
from wholearm.problem.read import build_problem, read_problem
from wholearm.verification.verdict import Allowance, describe_ends

OPTIONS = PlanOptions(time_intervals=12, transcription="time")


def test_an_end_that_is_known_is_first_looked_for_straight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on a route, which is given it: pinned in a file the first guess is the same."""
    problem = tipping()
    monkeypatch.setattr(guesses, "find_margin", lambda *_, **__: PathMargin(0.1))
    (phase,), start = problem.phases, problem.start
    goal = find_end(phase, start)
    pinned = replace(phase, until=replace(phase.until, pins=(("x", float(goal[0])),)))
    search = TimeSearch.of(problem, OPTIONS)
    for own, given in ((phase, goal), (pinned, None)):
        first, second, *_ = Guesses(problem, [own], start, search).every(given)
        assert [first.name, second.name] == [STRAIGHT, NEAREST]
        found = first.stages[-1].guess.nodes[-1, 0]
        np.testing.assert_allclose(found[:2] * problem.scene.scales.length, goal[:2], atol=1e-9)

    names = [guess.name for guess in Guesses(problem, [phase], start, search).every()]
    assert names[:3] == [NEAREST, NEAREST + GRADUAL, OTHER]


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> list[str]:
    """Names of guesses in the order in which they are tried; one leads to a plan."""
    names, good = list[str](), request.param

    def pretend(search: TimeSearch, guess: Guess, most: int = 0) -> TimeSolution:
        names.append(guess.name)
        nlp, success = search.build(guess.stages), guess.name == good
        return TimeSolution(guess.stages, 1.0, 0.0, "Ipopt stopped", success, nlp, {})

    monkeypatch.setattr(time_plan, "solve_coarse", pretend)
    monkeypatch.setattr(time_plan, "may_gain", lambda *_: False)
    monkeypatch.setattr(time_plan, "finish", lambda _, solution: solution)
    monkeypatch.setattr(time_plan, "list_plans", lambda *given: [given[-1]])
    return names


@pytest.mark.parametrize("tried", [NEAREST], indirect=True)
def test_a_single_guess_straight_to_a_place_is_no_other(
    tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where limits exclude the straight path there is none; goal 15 of the corpus."""
    problem = landing()
    start, phase = trace_phases(problem)[-1].end, replace(problem.phases[4], end=End.REST)
    goal = find_end(phase, start, problem.phases[5:])
    monkeypatch.setattr(Guesses, "straight", lambda *_: None)
    assert try_phases(problem, [phase], start, OPTIONS, goal, single_guess=True) is None
    assert tried == []


LATER = LONGER.format(NEAREST, 4.0)


@pytest.mark.parametrize(
    ("tried", "order"),
    [
        (NEAREST, [NEAREST]),
        (NEAREST + GRADUAL, [NEAREST, NEAREST + GRADUAL]),
        (LATER, [NEAREST, NEAREST + GRADUAL, LATER]),
    ],
    indirect=["tried"],
)
def test_a_plan_names_the_guess_that_led_to_it(tried: list[str], order: list[str]) -> None:
    problem, _ = shove()
    plans: list[Any] = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    assert plans == [order[-1]]
    assert tried == order


LANDS = 0.016
"""Where `plan_landing` ends [m]."""


def pin(problem: Problem, index: int, *pins: tuple[str, float]) -> Problem:
    phases = list(problem.phases)
    until = dataclasses.replace(phases[index].until, pins=pins)
    phases[index] = dataclasses.replace(phases[index], until=until)
    return dataclasses.replace(problem, phases=tuple(phases))


def test_a_landing_comes_to_rest_where_it_is_pinned() -> None:
    """Also beside the end that is the fastest, and far from the nearest."""
    problem = pin(landing(), 5, ("x", 0.0195))
    start = trace_phases(problem)[-1].end
    # All guesses: what a single one leads to depends on the last bits.
    options = PlanOptions(time_intervals=6)
    plans = plan_phases(problem, problem.phases[4:], start, options)
    motion = plans[-1].motion
    end = motion.evaluate(np.array([motion.duration]))
    size, speed = problem.scene.scales.length, problem.scene.scales.speed
    assert end.z[0, 0] == pytest.approx(0.0195, abs=1e-7 * size)
    assert np.abs(end.z_dot[0, :2]).max() < 1e-6 * speed
    formation = make_formation(
        problem.scene, " ".join([*problem.phases[5].formation.names, "v2-palm"])
    )
    assert np.abs(measure_gaps(formation, end.z)).max() < 1e-6 * size


def test_with_one_freedom_pins_have_to_agree_with_the_curve() -> None:
    problem = problem_of(HEPTAGON)
    x, phi = trace_phases(problem)[0].end[[0, 2]].tolist()
    same = pin(problem, 0, ("x", x), ("phi", phi))
    assert trace_phases(same)[0].end.tolist() == trace_phases(problem)[0].end.tolist()
    with pytest.raises(InputError, match=r"v3-finger1 at x = .* is never reached") as caught:
        trace_phases(pin(problem, 0, ("x", x + 1e-3)))
    assert caught.value.key == "phases[1].until"
    assert caught.value.problem.endswith("; one freedom leaves no choice")


def test_another_place_than_the_one_pinned_fails() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque)
    allowance, length = Allowance(), problem.scene.scales.length
    for off, missed in ((0.0, False), (0.9, False), (1.1, True)):
        x = LANDS + off * allowance.departure * length
        failures = describe_ends(pin(problem, 1, ("x", x)), simulation, allowance)
        assert bool(failures) == missed
        for failure in failures:
            assert failure.text.startswith("phase 2 ends at x = 16 mm, phi = ")
            assert failure.text.endswith(f"and not with v2-palm at x = {x:g} m")


def with_phase(name: str, contacts: str, until: object) -> tuple[Problem, Phase]:
    """A shipped problem with another last phase."""
    table = dict(read_problem(str(FOLDER / f"{name}.toml")).table)
    phases = [table["phases"][0], {"contacts": contacts.split(), "until": until}]
    problem = build_problem({**table, "phases": phases})
    return problem, problem.phases[1]


@cache
def corner() -> tuple[Problem, Phase, Array]:
    """The triangle turns about its vertex in the corner of palm and link, which first goes back."""
    problem, phase = with_phase("triangle", "v1-palm v1-finger1 v0-finger2", "v2-finger1")
    near = np.array([0.030153, 0.02887, -1e-9, 1.032, 2.713])
    z = close_contacts(phase.formation, near, np.zeros(0), ((2, 0.0),))
    assert z is not None
    return problem, phase, z


SMALL = 0.005
"""How much the link turns back and forth, so little that all that is not tied to it goes on."""


def turned(rates: Polynomial | Chebyshev) -> tuple[TimeSearch, Stage]:
    """The triangle turns on and on; the link, and its vertex, goes at such rates back and forth.

    No forces are looked for: every motion of two freedoms is one of the contacts.
    """
    problem, phase, z = corner()
    search = TimeSearch.of(problem, PlanOptions())
    (stage, *_) = Guesses(problem, [phase], z, search).nearest.stages
    (stage,) = bisect_intervals([stage], search.scheme, [np.full(stage.intervals, 2)])
    part, formation = stage.guess, stage.formation
    scale = np.abs(rates(np.linspace(0, 1, 99))).max()
    link, start = SMALL / scale * rates.integ(), part.nodes[0, 0]

    def state(share: float) -> tuple[Array, Array]:
        fixed = ((2, start[2] - 0.05 * share), (3, start[3] + link(share)))
        z = close_contacts(formation, start, np.zeros(0), fixed)
        assert z is not None
        A = formation.evaluate(z[None], np.zeros((1, 5))).A[0]
        moving = np.append(np.zeros(3), [-0.05, SMALL / scale * rates(share)])
        return z, np.linalg.solve(np.vstack([A, np.eye(5)[2:4]]), moving) / part.duration

    states = [[state(share) for share in own] for own in part.places(search.scheme.points)]
    nodes = np.array([state(share) for share in part.breaks])
    z, v = np.moveaxis(np.array(states), 2, 0)
    return search, replace(stage, guess=part._replace(nodes=nodes, z=z, v=v))


def test_what_is_in_the_corner_turns_with_the_link() -> None:
    problem, phase, z = corner()
    formation = phase.formation
    N = tangent_basis(formation, z) / metric_weights(problem.scene)[:, None]
    A_t = formation.evaluate(z[None], np.zeros((1, 5))).A_t[0]
    rates = np.vstack([A_t / problem.scene.scales.length, np.eye(5)[3:]]) @ N
    for row in range(5):
        # What moves the others while the row stands still.
        still = np.array([-rates[row, 1], rates[row, 0]])
        moving = np.abs(rates @ still) > 1e-6 * np.abs(rates).max() ** 2
        assert set(find_tied(formation, z, row)) == set(np.flatnonzero(~moving).tolist())
    assert set(find_tied(formation, z, 0)) == {0, 1, 3}


TIED = {0, 1, 3}
"""Rows of (contacts, joints) that turn together in the corner."""


def test_pieces_move_one_way_and_make_up_the_stage() -> None:
    for places in (), (0.3,), (0.2, 0.7):
        search, stage = turned(Polynomial.fromroots(places) if places else Polynomial([1.0]))
        pieces = split_by_signs(stage, search.scheme)
        shares = np.diff([0.0, *places, 1.0])
        # Turns are found by straight lines between points.
        lasts = [own.guess.duration / stage.guess.duration for own in pieces]
        np.testing.assert_allclose(lasts, shares, atol=0.01)
        for one, other in pairwise(pieces):
            assert one.guess.nodes[-1] == pytest.approx(other.guess.nodes[0], abs=1e-9)
            signs = np.array([mode_of(one).signs, mode_of(other).signs])
            assert {0, 3} <= set(np.flatnonzero(signs[0] != signs[1]).tolist()) <= TIED
        for own in pieces:
            senses = own.measure_senses(
                own.guess.z[1:-1].reshape(-1, 5), own.guess.v[1:-1].reshape(-1, 5)
            )
            assert senses.min() > -1e-4 * np.abs(senses).max()
        assert pieces[-1].until is not None and all(own.until is None for own in pieces[:-1])


class Given(TimeSearch):
    """A search whose solutions are all one motion."""

    motion: Stage
    onsets: list[float]

    def solve(
        self,
        stages: list[Stage],
        before: TimeSolution | None = None,
        most: int = 0,
        raised: Any = None,
    ) -> TimeSolution:
        (stage,) = stages
        self.onsets.append(stage.onset)
        found = [replace(stage, guess=self.motion.guess)]
        return TimeSolution(found, 1.0, 0.0, "", True, None, {})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "rates",
    [Polynomial([1.0]), Polynomial.fromroots([0.3]), Chebyshev.basis(15, domain=[0.0, 1.0])],
    ids=["on", "turning back", "trembling"],
)
def test_modes_are_those_of_the_motion_with_friction_that_sets_in_gradually(
    rates: Polynomial | Chebyshev,
) -> None:
    plain, stage = turned(rates)
    search = Given(**vars(plain))
    search.motion, search.onsets = stage, []
    found = find_modes(search, [stage])
    assert search.onsets == list(ONSETS)
    assert found.success == (rates.degree() < MOST)
    if found.success:
        assert len(found.stages) == rates.degree() + 1
        assert all(own.onset == 0 for own in found.stages)
        assert (
            {0, 3} <= set(found.stages[0].turns) <= TIED
            if rates.degree()
            else not found.stages[0].turns
        )


def test_a_motion_that_slides_while_it_tips_is_planned() -> None:
    problem = tipping()
    options = PlanOptions(time_intervals=4, accuracy=1e-2)
    (plan,) = plan_phases(problem, problem.phases, problem.start, options, explained=False)
    samples = plan.motion.evaluate(np.linspace(0.0, plan.motion.duration, 50))
    assert np.degrees(samples.z[-1, 2]) == pytest.approx(9.5, abs=1e-5)
    assert samples.c_n.min() > problem.epsilon - 1e-6


def test_a_vertex_in_a_corner_may_go_back_first() -> None:
    """The modes of its outline lead nowhere."""
    problem, phase, z = corner()
    own = replace(problem, start=z, phases=(replace(phase, index=0),))
    plan = solve(own, time_intervals=10, replay=False).trajectory
    report = verify(own, plan)
    assert report.ok, report.to_text()


def test_an_end_where_a_contact_changes_its_name_has_a_slope() -> None:
    """The distance to the tip has none there: it would leave open where the phase ends."""
    problem, phase = with_phase("hexagon", "v1-palm v1-finger1 v4-finger2", "v4-tip2")
    z = np.array([0.06, 0.045, -0.05, 1.3, 2.2])
    end = list_ends(phase)[0]
    goal = close_contacts(phase.formation, z, np.zeros(0), (), end.active)
    assert goal is not None
    kernel = goal_kernel(phase.formation, phase.until, (), None)
    assert kernel is not None
    x = np.append(goal, np.zeros(5))
    assert np.abs(kernel.function(x, []).full()).max() < 1e-9 * problem.scene.scales.length
    slope = np.abs(kernel.jacobian(x, []).full()).max()
    assert slope > 0.1 * problem.scene.scales.length


SCHEMES = [("radau", 2), ("radau", 4), ("legendre", 3)]


class Course:
    """Polynomials of a scheme's degree in each interval: z and v of d, z'' and forces of d - 1.

    One polynomial over all intervals, so that any others give the same one back.
    """

    def __init__(self, degree: int) -> None:
        rng = np.random.default_rng(degree)
        self.z, self.v = rng.normal(size=(2, degree + 1, 5))
        self.a, self.forces = rng.normal(size=(degree, 5)), rng.normal(size=(degree, 3))
        self.tau = rng.normal(size=(2, 2))

    def at(self, name: str, places: Array) -> Array:
        table = getattr(self, name)
        return np.asarray(places[..., None] ** np.arange(len(table)) @ table)

    def sample(self, scheme: Scheme, breaks: Array) -> StagePoints:
        fractions = np.diff(breaks)
        t = breaks[:-1, None] + fractions[:, None] * scheme.points
        ends = np.stack([breaks[:-1], breaks[1:]], axis=1)
        return StagePoints(
            0.3,
            fractions,
            np.stack([self.at("z", breaks), self.at("v", breaks)], axis=1),
            self.at("z", t),
            self.at("v", t),
            self.at("a", t),
            self.at("forces", t),
            self.at("tau", ends),
            np.array([1.0, 2.0]),
        )


def check(got: StagePoints, expected: StagePoints) -> None:
    for one, other in zip(tables(got), tables(expected), strict=True):
        # Rounding, which inverting powers enlarges.
        np.testing.assert_allclose(one, other, atol=1e-11)


def random_breaks(rng: np.random.Generator, count: int) -> Array:
    return np.array([0.0, *np.sort(rng.uniform(0.05, 0.95, count - 1)), 1.0])


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_polynomials_of_the_degree_are_carried_over_exactly(name: str, degree: int) -> None:
    scheme, course = make_scheme(name, degree), Course(degree)
    rng = np.random.default_rng(degree)
    old = random_breaks(rng, 4)
    new = np.sort(np.append(old, rng.uniform(0, 1, 5)))
    check(resample(course.sample(scheme, old), scheme, new), course.sample(scheme, new))


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_part_of_a_stage_is_cut_out(name: str, degree: int) -> None:
    scheme, course = make_scheme(name, degree), Course(degree)
    part = course.sample(scheme, np.array([0.0, 0.2, 0.5, 1.0]))
    breaks = np.array([0.0, 0.25, 1.0])
    got = resample(part, scheme, breaks, 0.2, 0.5)
    own = course.sample(scheme, 0.2 + 0.3 * breaks)
    check(got, own._replace(duration=0.09, fractions=np.diff(breaks), impulses=np.zeros(0)))
    # What ends the stage is left only to its last part.
    last = resample(part, scheme, breaks, 0.5, 1.0)
    np.testing.assert_array_equal(last.impulses, part.impulses)


@pytest.mark.parametrize("name, degree", SCHEMES)
def test_halved_intervals_hold_the_same_motion(name: str, degree: int) -> None:
    scheme = make_scheme(name, degree)
    rng = np.random.default_rng(degree + 10)
    breaks = random_breaks(rng, 4)
    part = Course(degree).sample(scheme, breaks)
    # Torques and motions that step or bend from interval to interval, unlike one polynomial.
    part = part._replace(tau=rng.normal(size=(4, 2, 2)), forces=rng.normal(size=part.forces.shape))
    finer = bisect(part, scheme, np.array([1, 0, 2, 0]))
    widths = np.diff(breaks)
    halves = [*[widths[0] / 2] * 2, widths[1], *[widths[2] / 4] * 4, widths[3]]
    np.testing.assert_allclose(finer.fractions, halves, atol=1e-13)
    assert finer.duration == part.duration
    owners = [(0, 0), (0, 1), (1, 0), *[(2, k) for k in range(4)], (3, 0)]
    for k, (parent, inside) in enumerate(owners):
        width = finer.fractions[k] / widths[parent]
        start = inside * width
        table = scheme.interpolate(start + width * scheme.points)
        np.testing.assert_allclose(finer.forces[k], table @ part.forces[parent], atol=1e-11)
        ends = np.array([[1 - start, start], [1 - start - width, start + width]])
        np.testing.assert_allclose(finer.tau[k], ends @ part.tau[parent], atol=1e-12)


def make_stages(motions: list[StageMotion]) -> list[Stage]:
    return [Stage(0, motion.formation, motion.directions, motion.points) for motion in motions]


@pytest.fixture(scope="module")
def stages() -> list[Stage]:
    """Those of the landing; every direction of friction is that of the motion."""
    return make_stages(stages_of(plan_landing_over_time(time_intervals=6)))


@pytest.mark.parametrize("name, degree", [("radau", 2), ("radau", 3), ("legendre", 3)])
def test_defects_that_shrink_with_the_order_need_one_round(name: str, degree: int) -> None:
    scheme = make_scheme(name, degree)
    rng = np.random.default_rng(1)
    sizes = SETTINGS.defect * 10 ** rng.uniform(-3, 3, 40)
    defects = sizes[:, None, None] * rng.uniform(-1, 1, (40, 2, 5))
    defects[:, 1, 2] = -sizes
    times = count_halvings(np.zeros(40), defects, scheme)
    left = sizes * 0.5 ** (scheme.order * times)
    assert (left <= SETTINGS.defect)[times < SETTINGS.at_once].all()
    # Once less would not have done.
    assert (left * 2**scheme.order > SETTINGS.defect)[times > 0].all()
    assert set(times[sizes < SETTINGS.defect].tolist()) == {0}


SCHEME = make_scheme("radau", 3)


@pytest.fixture(scope="module")
def outlined() -> list[Stage]:
    """Of the flip's last formation and the landing."""
    problem = landing()
    start = trace_phases(problem)[-1].end
    return guess_stages(problem, problem.phases[4:], start, SCHEME, 12, 2.0)


def test_guesses_follow_the_outlines_in_one_sweep(outlined: list[Stage]) -> None:
    parts = [stage.guess for stage in outlined]
    for stage, part in zip(outlined, parts, strict=True):
        assert stage.intervals >= LEAST_INTERVALS
        np.testing.assert_allclose(part.fractions, 1 / stage.intervals)
        # Points on straight lines between 25 closed configurations, in radii of gyration.
        gaps = [measure_gaps(stage.formation, z) for z in part.z.reshape(-1, 5)]
        assert np.abs(gaps).max() < 3e-3
        np.testing.assert_allclose(part.nodes[1:, 0], part.z[:, -1], atol=1e-12)
        assert part.forces[..., : stage.formation.n_contacts].min() > 0
        limits = stage.formation.scene.torque_limit
        assert (np.abs(part.tau) < limits).all()
        # Velocities are the slope of what is guessed.
        t = part.duration * part.places(SCHEME.points)
        step = np.diff(part.z[:, :2], axis=1)[:, 0] / np.diff(t[:, :2], axis=1)
        middle = (part.v[:, 0] + part.v[:, 1]) / 2
        assert np.abs(step - middle).max() < 0.15 * np.abs(part.v).max()
    for before, after in pairwise(parts):
        np.testing.assert_allclose(before.nodes[-1, 0], after.nodes[0, 0], atol=1e-12)
    for node in (parts[0].nodes[0, 1], parts[-1].nodes[-1, 1]):
        np.testing.assert_allclose(node, 0.0, atol=1e-12)


@pytest.mark.parametrize("pace", [1.0, 4.0])
def test_the_duration_is_that_of_a_fall_times_the_pace(pace: float) -> None:
    problem = landing()
    start, phases = trace_phases(problem)[-1].end, problem.phases[4:]
    outlined = guess_stages(problem, phases, start, SCHEME, 12, pace)
    z, length = start, 0.0
    for phase in phases:
        for outline in guess_phase(phase, z):
            length += outline.length
            z = outline.z[-1]
    whole = sum(stage.guess.duration for stage in outlined) * problem.scene.scales.time
    # The outline that is split leaves out nothing but the rounding of its length.
    assert whole == pytest.approx(pace * np.sqrt(length / 9.81), rel=1e-3)


def search_for(objective: str) -> TimeSearch:
    return TimeSearch.of(landing(), PlanOptions(objective=objective))


@lru_cache(maxsize=2)
def coarse(objective: str) -> TimeSolution:
    """The heptagon's landing on few intervals, with limits at the points alone."""
    problem = landing()
    start = trace_phases(problem)[-1].end
    options = PlanOptions(objective=objective, time_intervals=8)
    begun = try_phases(problem, problem.phases[4:], start, options, further=True)
    assert begun is not None and isinstance(begun[0].solution, TimeSolution)
    return begun[0].solution


def replace_scene(stages: list[Stage], problem: Problem) -> list[Stage]:
    """The same stages on the formations of another scene."""
    return [replace(stage, formation=problem.phases[stage.phase].formation) for stage in stages]


@pytest.mark.parametrize("contact", ["palm", "finger1", "finger2"])
def test_friction_is_worth_what_a_little_less_of_it_saves(contact: str) -> None:
    """By the envelope theorem: as much as the Lagrangian falls, all else as it is."""
    solution, share = coarse("effort"), 1e-3
    mu = getattr(landing().scene.friction, contact)
    other = landing().with_({f"friction_{contact}": (1 - share) * mu})
    least = PlanOptions(objective="effort")
    values = list[float]()
    for problem in (landing(), other):
        stages = replace_scene(solution.stages, in_own_units(problem))
        nlp = TimeSearch.of(problem, least).build(stages)
        x = pack([stage.guess for stage in stages], nlp.layouts, 0.0)
        g = nlp.solver.function.get_function("nlp_g")(x, [])
        values.append(float(solution.multipliers["lam_g0"] @ g.full()[:, 0]))
    own = [
        solution.price_friction(k)[..., [n.endswith(contact) for n in stage.formation.names]].sum()
        for k, stage in enumerate(solution.stages)
    ]
    # The other way is less by twice of all there is.
    assert values[0] - values[1] == pytest.approx(share / 2 * sum(own), rel=1e-6, abs=1e-12)


def test_multipliers_of_a_solution_are_those_of_its_limits() -> None:
    solution = coarse("time")
    pressing = 0
    for stage, layout in zip(solution.stages, solution.nlp.layouts, strict=True):
        lam, c_n = solution.multipliers["lam_x0"][layout.forces], stage.guess.forces
        # A bound pushes only where it is reached, to the tolerance of the solver.
        least = in_own_units(landing()).epsilon
        assert (np.abs(lam * (c_n - least)) < 1e-6).all() and lam.max() < 1e-7
        pressing += int((lam < -1e-6).sum())
    assert pressing > 10


def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Slopes, and rows of a polygon about zero with their slack, some of them touching it."""
    box = np.tile(np.concatenate([np.eye(2), -np.eye(2)]), (count, 1, 1))
    rows = np.concatenate([rng.normal(size=(count, 3, 2)), box], axis=1)
    slack = rng.uniform(0.0, 2.0, rows.shape[:2]) * (rng.uniform(size=rows.shape[:2]) > 0.2)
    return rng.normal(size=(count, 2)), rows, slack


def test_the_least_over_a_polygon_is_that_of_a_linear_programme() -> None:
    slopes, rows, slack = draw(np.random.default_rng(0), 30)
    least = find_least(slopes, 0.0, rows, slack)
    for k, slope in enumerate(slopes):
        answer = linprog(slope, -rows[k], slack[k], bounds=(None, None))
        assert least[k] == pytest.approx(answer.fun, abs=1e-9)
    assert (least < -0.1).sum() > 10


def test_the_least_square_over_a_polygon_is_that_of_a_solver() -> None:
    slopes, rows, slack = draw(np.random.default_rng(1), 30)
    least = find_least(slopes, 0.4, rows, slack)
    for k, slope in enumerate(slopes):
        limits = {"type": "ineq", "fun": lambda u, k=k: rows[k] @ u + slack[k]}
        answer = minimize(lambda u, g=slope: g @ u + 0.4 * u @ u, np.zeros(2), constraints=limits)
        assert least[k] == pytest.approx(answer.fun, abs=1e-6)
    assert len(set(np.round(least, 6))) > 10


def test_what_is_held_moves_along_its_limit_alone() -> None:
    slopes, rows, slack = draw(np.random.default_rng(2), 5)
    held = np.array([0.6, 0.8])
    both = np.concatenate([rows, np.tile([held, -held], (5, 1, 1))], axis=1)
    least = find_least(slopes, 0.0, both, np.hstack([slack, np.zeros((5, 2))]))
    way = np.array([-0.8, 0.6])
    for k, slope in enumerate(slopes):
        along = rows[k] @ way
        with np.errstate(divide="ignore"):
            ends = -slack[k] / along
        farthest = ends[along < 0].min(), ends[along > 0].max()
        assert least[k] == pytest.approx(min(slope @ way * end for end in farthest), abs=1e-9)


def test_the_estimated_error_is_about_that_of_a_finer_plan() -> None:
    coarse, fine = plan_landing_over_time(time_intervals=6), plan_landing_over_time()
    lost = total(coarse) / total(fine) - 1
    assert fine[0].error < PlanOptions().accuracy < coarse[0].error == coarse[1].error
    assert lost == pytest.approx(coarse[0].error - fine[0].error, rel=0.6)


@lru_cache(maxsize=2)
def landed(intervals: int = 8) -> tuple[TimeSearch, TimeSolution]:
    """The landing alone: where along the palm it ends is left open."""
    problem = landing()
    search = TimeSearch.of(problem, PlanOptions())
    start = trace_phases(problem)[-1].end
    stages = guess_stages(problem, problem.phases[4:], start, search.scheme, intervals, 2.0)
    return search, search.solve(stages)


def test_an_end_is_moved_to_where_what_follows_costs_less() -> None:
    """Or kept, where the solver finds nothing better; it does on one of two grids at least."""
    price, gains = 0.5 * np.eye(5)[0], []
    for intervals in (4, 8):
        search, alone = landed(intervals)
        whole = replace(search, to_go=lambda z: (float(price @ z), price))
        priced, moved = choose_end(whole, alone)
        own = moved.cost - priced.charge(moved.end)
        gains.append(alone.cost + price @ alone.end - own - price @ moved.end)
        assert moved is alone or gains[-1] > GAIN * alone.cost
        if moved is not alone:
            # The stages alone cost least where they ended.
            assert own > alone.cost and moved.end[0] < alone.end[0]
    assert max(gains) > GAIN
