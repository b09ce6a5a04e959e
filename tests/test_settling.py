"""Ends of phases held by constant torques, so that contacts close that are still open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

from held import balances
from once import once
from shipped import HEPTAGON, problem_of, solved
from wholearm.common.errors import InputError
from wholearm.contacts.formation import Formation
from wholearm.planning import dwell as shares
from wholearm.planning.dwell import DwellEnd, list_touching, settle_plans
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.result import Plan, describe_plan, load_plan, write_meta
from wholearm.planning.stops import Plans
from wholearm.problem.definition import Problem
from wholearm.results.dwell_record import assemble
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.holding_torques import DRIVE, maximise_margin
from wholearm.simulation.rest import close_contacts, find_rest
from wholearm.simulation.simulate import simulate_free
from wholearm.verification.verify import verify

HELD = (0.019, 0.01, 0.01, 0.01, 0.0)
"""For how long ends are held here [s]."""


@once
def settled() -> Plan:
    """The plan of the four contacts with its ends held, without planning it again."""
    plain = solved(HEPTAGON)
    changes = {"settle": HELD[1], "phases[1].settle": HELD[0], "phases[5].settle": HELD[-1]}
    problem, trajectory = plain.problem.with_(changes), plain.trajectory
    starts = trajectory.phase_starts
    cuts = [trajectory.torque.cut(*ends) for ends in pairwise(starts.tolist())]
    parts = [TorqueProfile(own.breaks - own.breaks[0], own.coefficients) for own in cuts]
    pairs = zip(trajectory.motions, parts, strict=True)
    found = settle_plans(problem, [PhasePlan(motion, torque, 0.0) for motion, torque in pairs])
    torque = TorqueProfile.chain([plan.torque for plan in found.plans])
    motion = assemble([plan.motion for plan in found.plans], torque, trajectory.meta, 201)
    both = zip(plain.phases, found.settlings, strict=True)
    phases = tuple(phase._replace(settling=own) for phase, own in both)
    plan = replace(plain, problem=problem, trajectory=motion, phases=phases)
    return replace(plan, trajectory=replace(motion, meta=write_meta(plan)))


def test_held_ends_balance_with_all_that_touches() -> None:
    plan = settled()
    problem, motion = plan.problem, plan.trajectory
    assert [own.settling.duration if own.settling else 0 for own in plan.phases] == [*HELD]
    for phase, own in zip(problem.phases, plan.phases, strict=True):
        if own.settling is None:
            continue
        z = motion.z[np.flatnonzero(motion.phase == phase.index)[-1]]
        touching, tau = list_touching(problem, phase), np.array(own.settling.tau)
        assert balances(touching, z, tau, problem.epsilon)
        assert (np.abs(tau) <= problem.scene.torque_limit * (1 + 1e-9)).all()


def test_they_drive_on_towards_what_is_still_open() -> None:
    """By the simulator's rows at rest, which are set up on their own, from the largest gap on."""
    plan = settled()
    problem, motion = plan.problem, plan.trajectory
    for phase, own in zip(problem.phases, plan.phases, strict=True):
        settling = own.settling
        if phase.until.contact is None or settling is None:
            continue
        z = motion.z[np.flatnonzero(motion.phase == phase.index)[-1]]
        gained = Formation(problem.scene, (phase.until.contact,))
        normal = gained.evaluate(z[None], np.zeros((1, 5))).A[0][0]
        first = find_rest(phase.formation, z).sliding[0]
        assert first.heading is not None
        back = settling.gap / (normal @ first.heading) * first.heading
        z = close_contacts(phase.formation, z + back)
        gap = float(gained.evaluate(z[None], np.zeros((1, 5))).C[0, 0])
        assert gap == pytest.approx(settling.gap, rel=0.02)
        tau, (one, two) = np.array(settling.tau), find_rest(phase.formation, z).sliding
        assert one.heading is not None and two.heading is not None
        way = one if normal @ one.heading < 0 else two
        closing = -float(normal @ way.heading) * way.drive(tau)
        assert closing >= 0.99 * DRIVE * problem.scene.scales.acceleration
        assert settling.speed == pytest.approx(np.sqrt(2 * gap * closing), rel=0.02)
        assert not balances(phase.formation, z, tau)


def test_the_whole_ends_where_it_was_planned_to() -> None:
    plan = settled()
    problem, motion = plan.problem, plan.trajectory
    report = verify(problem, plan)
    assert report.ok and not report.warnings
    run = simulate_free(problem, plan)
    away = np.abs(run.z[-1] - motion.z[-1])
    assert away[:2].max() < 1e-7 and away[2:].max() < 1e-6
    assert motion.duration == pytest.approx(solved(HEPTAGON).duration + sum(HELD), rel=1e-12)
    assert f"held for {sum(HELD):.6g} s in all" in describe_plan(plan, "plan.npz").to_text()


def test_a_start_that_is_short_makes_little_difference() -> None:
    """No more than the 0.1 mm that it is off to the right, and 0.1 degrees."""
    plan = settled()
    assert plan.duration < 1.1 * solved(HEPTAGON).duration
    start = shares.move_start(plan.problem, 1e-4)
    away = simulate_free(plan.problem, plan.trajectory, start=start).z[-1] - plan.trajectory.z[-1]
    assert np.hypot(*away[:2]) < 1e-4 and abs(away[2]) < np.radians(0.1)


def test_shares_are_those_of_the_way_that_ends_best(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = solved(HEPTAGON)
    problem = plain.problem.with_({"settle": "10 %", "phases[3].settle": 0.002})
    motions = plain.trajectory.motions
    plans = [PhasePlan(motion, plain.trajectory.torque, 0.0) for motion in motions]
    tried, chosen = list[list[float]](), list[Sequence[DwellEnd | None]]()

    def measure(_: Problem, __: Plans, ends: Sequence[DwellEnd | None]) -> float:
        tried.append([0.0 if end is None else end.time for end in ends])
        chosen.append(ends)
        return problem.gap * (4.0, 3.9, 1.2, 1.1, 2.0, last)[len(tried) - 1]

    monkeypatch.setattr(shares, "measure_off", measure)
    last = 1.2
    assert shares.share_time(problem, plans) == chosen[2]
    assert len(tried) == len(shares.WAYS)
    for way, ends in zip(shares.WAYS, chosen, strict=True):
        for end in (end for end in ends if end is not None):
            assert end.firm == way.firm and end.hold is not None
            assert not (way.firm and end.hold.speed)
    for own in tried:
        assert own[2] == 0.002
        assert sum(own) == pytest.approx(0.002 + 0.1 * plain.duration, rel=1e-12)
    first, second, _, fourth, fifth = tried[0]
    assert first == pytest.approx(2 * second) and second == pytest.approx(fourth)
    assert fifth == pytest.approx(shares.STOP * fourth)
    assert tried[1][0] == 0


def test_held_ends_are_written_and_read(tmp_path: Path) -> None:
    plan = settled()
    plan.save(tmp_path / "plan.npz")
    read = load_plan(tmp_path / "plan.npz")
    assert [own.settling for own in read.phases] == [own.settling for own in plan.phases]
    assert read.problem.settle == HELD[1] and read.problem.gap == plan.problem.gap
    ends, held = plan.trajectory.phase_starts[1:5], HELD[1]
    for t in (*(ends - held / 3), *(ends - 2.5 * held)):
        one, two = read.trajectory.at(t), plan.trajectory.at(t)
        np.testing.assert_allclose(one.z, two.z, atol=1e-7)
        np.testing.assert_allclose(one.tau, two.tau, atol=1e-3)
        np.testing.assert_array_equal(np.isnan(one.c_n), np.isnan(two.c_n))
    rest = read.trajectory.at(ends - held / 3)
    # Interpolated from samples that are the same but for rounding.
    np.testing.assert_allclose(rest.z_dot, 0.0, atol=1e-9)
    assert np.isnan(rest.c_n).all()


def test_margins_are_those_of_the_linear_programme() -> None:
    scene, rng = problem_of(HEPTAGON).scene, np.random.default_rng(3)
    unit = scene.scales.torque
    for _ in range(40):
        rows = rng.normal(size=(12, 3)) / [1.0, unit, unit]
        bounds = rng.normal(size=(2, 3)) / [1.0, unit, unit]
        sides = np.vstack([rows, bounds])
        count = np.repeat([1.0, 0.0], [12, 2])
        answer = linprog(
            [0.0, 0.0, -1.0],
            A_ub=np.column_stack([-sides[:, 1:] * unit, count]),
            b_ub=sides[:, 0],
            bounds=[*((-most / unit, most / unit) for most in scene.torque_limit), (None, 1e3)],
        )
        found = maximise_margin(scene.torque_limit, rows, bounds)
        assert (found is None) == (answer.status != 0)
        if found is not None:
            assert found[1] == pytest.approx(answer.x[2], abs=1e-6)
            assert (rows @ [1.0, *found[0]]).min() == pytest.approx(found[1], abs=1e-6)


def test_keys_are_checked_and_kept() -> None:
    plain = problem_of(HEPTAGON)
    assert plain.settle == 0 and plain.settles(plain.phases[0]) == 0
    assert 9e-5 < plain.gap < 1.1e-4
    problem = plain.with_({"settle": 0.01, "settle_gap": 5e-5, "phases[2].settle": 0})
    assert [problem.settles(phase) for phase in problem.phases] == [0.01, 0, 0.01, 0.01, 0.01]
    assert problem.gap == 5e-5 and problem.table["phases"][1]["settle"] == 0
    shared = plain.with_({"settle": "10 %", "phases[2].settle": 0.01})
    assert shared.settle_share == pytest.approx(0.1) and shared.table["settle"] == "10 %"
    assert [shared.settles(phase) for phase in shared.phases] == [None, 0.01, None, None, None]
    again = replace(problem, settle=0.02)
    assert again.table["settle"] == 0.02 and again.table["phases"][1]["settle"] == 0


@pytest.mark.parametrize(
    ("changes", "key", "allowed"),
    [
        ({"settle": -1}, "settle", ">= 0"),
        ({"settle": 1e9}, "settle", "allowed are"),
        ({"settle": "ten"}, "settle", "100 %"),
        ({"settle": "0 %"}, "settle", "100 %"),
        ({"settle_gap": 1.0}, "settle_gap", "allowed are"),
        ({"settle": 0.01, "actuator_lag": 1e-3}, "settle", "actuator_lag"),
        ({"phases[1].settle": "x"}, "phases[1].settle", ">= 0"),
        ({"phases[1].settle": 0.01, "phases[1].end": "smooth"}, "phases[1].settle", "smooth"),
    ],
)
def test_wrong_keys_are_named(changes: dict[str, object], key: str, allowed: str) -> None:
    with pytest.raises(InputError, match=allowed) as raised:
        problem_of(HEPTAGON).with_(changes)
    assert raised.value.key == key
