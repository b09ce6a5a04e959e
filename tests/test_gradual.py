from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from shipped import FOLDER
from wholearm.common.arrays import Array
from wholearm.geometry.curve import find_tied, tangent_basis
from wholearm.geometry.explore import close_contacts
from wholearm.geometry.path_guess import list_ends
from wholearm.mechanics.metric import metric_weights
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.time_domain.attempts import Attempts
from wholearm.planning.time_domain.equations import least_rates, least_senses
from wholearm.planning.time_domain.gradual import find_modes, split_by_senses
from wholearm.planning.time_domain.kernels import goal_kernel
from wholearm.planning.time_domain.modes import merge, mode_of
from wholearm.planning.time_domain.motion import make_motions
from wholearm.planning.time_domain.nlp import bound_unknowns
from wholearm.planning.time_domain.search import Search, Solution
from wholearm.problem.definition import Phase, Problem
from wholearm.problem.read import build_problem, read_problem


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


@cache
def begun() -> tuple[Search, Solution]:
    problem, phase, z = corner()
    search = Search.of(problem, PlanOptions())
    first = Attempts(problem, [phase], z, search, None, True).first
    return search, find_modes(search, first.stages)


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


def test_modes_are_found_where_the_given_ones_lead_nowhere() -> None:
    search, found = begun()
    assert found.success and all(stage.onset == 0 for stage in found.stages)
    solution = search.solve(found.stages)
    assert solution.success
    # A contact slides back first.
    signs = np.array([mode_of(stage).signs for stage in solution.stages])
    assert len(signs) > 1 and (signs[0] != signs[1]).sum() == 1
    motions = make_motions(solution.stages, search.scheme)
    for stage, motion in zip(solution.stages, motions, strict=True):
        samples = motion.evaluate(np.linspace(0.01, 0.99, 30) * motion.duration)
        assert stage.measure_senses(samples.z, samples.z_dot).min() > -1e-4


def test_pieces_move_one_way_and_make_up_the_stage() -> None:
    search, found = begun()
    (whole,) = merge([found.stages[0]])
    for stage in found.stages:
        pieces = split_by_senses(stage, search.scheme)
        assert sum(p.guess.duration for p in pieces) == pytest.approx(stage.guess.duration)
        for one, other in pairwise(pieces):
            assert one.guess.nodes[-1] == pytest.approx(other.guess.nodes[0], abs=1e-9)
            assert mode_of(one) != mode_of(other)
    assert found.stages[-1].until is not None and whole.until is None


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


def test_where_the_last_stage_stops_may_be_given() -> None:
    """The largest margin ends elsewhere, but for that."""
    search, found = begun()
    quick = search.solve(found.stages)
    times = 2 * sum(stage.guess.duration for stage in quick.stages)
    slow = replace(search, goal=Objective.MARGIN, duration=times)
    free = slow.solve(quick.stages)
    last = replace(quick.stages[-1], stop=quick.end)
    pinned = slow.solve([*quick.stages[:-1], last])
    assert quick.success and free.success and pinned.success
    assert np.abs(pinned.end - quick.end).max() < 1e-7 < 0.01 < np.abs(free.end - quick.end).max()
    assert 0.0 < pinned.margin < free.margin + 1e-6
    spent = [sum(own.guess.duration for own in found.stages) for found in (free, pinned)]
    assert max(spent) < times * (1 + 1e-6)


def test_the_second_contact_of_a_vertex_need_not_move() -> None:
    """Its rate has a zero where the link stands across, however fast the vertex moves."""
    _, found = begun()
    places = np.linspace(0.1, 0.9, 9)
    least = least_senses(found.stages[0], places)
    assert least.shape == (9, 5) and (least[:, 1] == 0.0).all()
    assert (least[:, [0, 2, 3, 4]] == least_rates(found.stages[0], places)[:, None]).all()
    assert least[:, 0].min() > 0.0


def test_what_ends_a_phase_is_not_reached_before() -> None:
    """A motion that first passes its end would be over there."""
    problem, phase = with_phase("triangle", "v1-palm v1-finger1 v0-finger2", {"phi_deg": -12.0})
    search = Search.of(problem, PlanOptions())
    (stage,) = Attempts(problem, [phase], corner()[2], search, None, True).first.stages
    row, value, side = 2, np.radians(-12.0), -1.0
    assert stage.ahead is not None
    assert np.array(stage.ahead) == pytest.approx([row, value, side])
    nlp = search.build([stage])
    (low, high), layout = bound_unknowns(nlp, [stage], search.scheme), nlp.layouts[0]
    least = low[layout.z[..., row]].ravel()
    assert (np.diff(least[:-1]) <= 0).all() and (least[:-1] > value).all()
    assert np.isinf(least[-1]) and np.isinf(high[layout.z[..., row]]).all()
    # Other phases end by contacts alone.
    assert all(own.ahead is None for own in begun()[1].stages)
