from __future__ import annotations

import dataclasses
import json
import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

from shipped import BOX, HEPTAGON, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.contacts.cones import force_limit_rows
from wholearm.mechanics.dynamics import force_rows
from wholearm.problem.definition import Problem
from wholearm.quasistatic.slow_speeds import (
    OWN,
    Least,
    PathSamples,
    Prediction,
    Survival,
    UnitProfile,
    find_break,
    find_torques,
    make_torques,
    predict,
    sample_path,
)
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.events import EventKind, Simulation
from wholearm.simulation.simulate import simulate


@cache
def first_phase() -> Problem:
    problem = problem_of(HEPTAGON)
    return dataclasses.replace(problem, phases=problem.phases[:1])


TOLD: list[str] = []


@cache
def predicted() -> Prediction:
    return predict(first_phase(), progress=TOLD.append)


@cache
def road_of(path: Path, index: int = 0) -> PathSamples:
    problem = problem_of(path)
    z, roads = problem.start, list[PathSamples]()
    for phase in problem.phases[: index + 1]:
        road = sample_path(phase, z, problem.phases[phase.index + 1 :])
        assert road is not None
        roads.append(road)
        z = road.z[-1]
    return roads[-1]


def find_least_by_lp(road: PathSamples, row: int, a: float, b: float) -> float:
    """The largest epsilon at one place, by a linear programme in forces and torques."""
    formation, scene = road.phase.formation, road.phase.formation.scene
    G = force_rows(formation, road.kinematics, road.directions)[row]
    v, n = math.sqrt(b) * road.z_s[row], len(G)
    inertia = scene.mass_diagonal * (road.z_s[row] * a + road.z_ss[row] * b)
    load = inertia + scene.viscous * v - scene.applied_force
    load[3:] += scene.dry[3:] * road.directions.sigma[row]
    H = force_limit_rows(formation)
    weight = H[:, : formation.n_contacts].sum(axis=1)
    answer = linprog(
        [0.0] * (n + 2) + [-1.0],
        A_ub=np.hstack([-H, np.zeros((len(H), 2)), weight[:, None]]),
        b_ub=np.zeros(len(H)),
        A_eq=np.hstack([G.T, np.eye(5)[:, 3:], np.zeros((5, 1))]),
        b_eq=load,
        bounds=[(None, None)] * n + [(-most, most) for most in scene.torque_limit] + [(None, None)],
    )
    return -answer.fun if answer.status == 0 else -math.inf


@pytest.mark.parametrize(("path", "index"), [(HEPTAGON, 0), (BOX, 1)])
def test_the_best_squeeze_is_that_of_a_linear_programme(path: Path, index: int) -> None:
    road, random = road_of(path, index), np.random.default_rng(7)
    a, b = random.normal(0.0, 3.0, len(road.s)), random.uniform(0.0, 0.3, len(road.s))
    a[::3] = b[::3] = 0.0
    grasp = road.force_limits.find_best(a, b)
    rows = np.linspace(1, len(road.s) - 2, 12).astype(int)
    expected = [find_least_by_lp(road, k, a[k], b[k]) for k in rows.tolist()]
    assert grasp.least[rows] == pytest.approx(expected, rel=1e-6, abs=1e-7)
    known = np.isfinite(grasp.least)
    low, high = road.force_limits.find_span(a, b, grasp.least - 1e-3)
    assert (low[known] <= grasp.internal_force[known]).all() and (grasp.internal_force <= high)[
        known
    ].all()
    low, high = road.force_limits.find_span(a, b, grasp.least + 1e-3)
    assert (low > high)[known].all()


def test_forces_under_torques_are_those_of_inverse_dynamics() -> None:
    for road in (road_of(HEPTAGON), road_of(BOX, 1)):
        a, squeeze = np.sin(road.s), np.cos(road.s)
        b = np.full(len(road.s), 0.04)
        c = road.press_under(road.forces.tau(a, b, squeeze), 0.2)
        assert c == pytest.approx(road.forces.c(a, b, squeeze), abs=1e-9)


def test_quasistatic_torques_balance_and_are_the_least() -> None:
    road, still = road_of(HEPTAGON), np.zeros(len(road_of(HEPTAGON).s))
    most = road.force_limits.find_best(still, still).least.min()
    for share in (0.0, 0.5, 1.0):
        torques = find_torques(road, 0.05, share)
        assert torques is not None
        wanted = 0.05 + share * (most - 0.05)
        assert (torques.c_n.min(axis=1) >= wanted - 1e-9).all()
        assert torques.c_n == pytest.approx(road.press_under(torques.tau, 0.0), abs=1e-9)
        low, high = road.force_limits.find_span(still, still, wanted)
        for part in (0.1, 0.9):
            other = road.forces.tau(still, still, low + part * (high - low))
            assert ((other**2).sum(axis=1) >= (torques.tau**2).sum(axis=1) - 1e-9).all()


def replay(speed: float) -> Simulation:
    """The first phase from rest to rest with the best squeeze."""
    road = road_of(HEPTAGON)
    pace = UnitProfile.between(road, (True, True))
    a, b = speed**2 * pace.a, speed**2 * pace.b
    tau = road.forces.tau(a, b, road.force_limits.find_best(a, b).internal_force)
    t = pace.way / speed * np.arccos(1 - 2 * road.s / road.length) / np.pi
    return simulate(first_phase(), TorqueProfile.join_rows(t, tau))


def paced() -> Survival:
    return predicted().phases[0].survivals[1]


def test_the_replay_holds_below_the_predicted_speed_and_not_above() -> None:
    own, (phase,) = paced(), predicted().phases
    assert own.motion == "rest to rest" and own.speed is not None and own.lost is not None
    assert own.speed < own.lost and own.duration == pytest.approx(
        np.pi / 2 * phase.length / own.speed
    )
    below = replay(0.98 * own.speed)
    assert not below.find(EventKind.CONTACT_LOST)
    assert phase.curves is not None
    expected = np.interp(0.98 * own.speed, phase.curves.speed, phase.curves.force[own.motion])
    assert np.nanmin(below.c_n) == pytest.approx(expected, abs=0.01)
    above = replay(1.02 * own.lost)
    (lost,) = above.find(EventKind.CONTACT_LOST)
    assert lost.contact in own.first.contacts


def test_the_straight_line_keeps_its_contacts_and_newtons_laws() -> None:
    table = {"contacts": ["v1-palm", "v2-finger1", "v5-finger2"], "until": {"phi_deg": -5.0}}
    problem = problem_of(HEPTAGON).with_({"phases": [table]})
    road = sample_path(problem.phases[0], problem.start, ())
    assert road is not None and road.curve is None
    formation, scene = road.phase.formation, problem.scene
    assert np.abs(road.kinematics.C).max() < 1e-12
    x, phi = road.z[:, 0], road.z[:, 2]
    assert np.ptp((x - x[0]) * (phi[-1] - phi[0]) - (phi - phi[0]) * (x[-1] - x[0])) < 1e-12
    for function, slope in ((road.z, road.z_s), (road.z_s, road.z_ss)):
        quotient = (function[2:] - function[:-2]) / (road.s[2:] - road.s[:-2])[:, None]
        assert quotient[20:-20] == pytest.approx(slope[21:-21], rel=2e-2, abs=1e-2)
    a, b = np.full(len(x), 2.0), np.full(len(x), 0.3)
    c, tau = road.forces.c(a, b, 0 * a), road.forces.tau(a, b, 0 * a)
    G = force_rows(formation, road.kinematics, road.directions)
    inertia = scene.mass_diagonal * (road.z_s * a[:, None] + road.z_ss * b[:, None])
    rest = inertia + scene.viscous * road.z_s * math.sqrt(0.3) - scene.applied_force
    rest -= np.einsum("nij,ni->nj", G, c)
    rest[:, 3:] += scene.dry[3:] * road.directions.sigma - tau
    assert np.abs(rest).max() < 1e-10


def test_breaks_are_found_and_so_is_what_only_speed_keeps() -> None:
    def fall(speed: float) -> Least:
        return Least(1.0 - speed**2, 0, ())

    found = find_break(fall, 0.19, 0.5)
    assert found.speed == pytest.approx(0.9, rel=1e-6) and found.least.force < 0.19
    assert find_break(lambda v: Least(1.0 + v, 0, ()), 0.5, 1.0).speed == math.inf
    rising = find_break(lambda v: Least(v - 0.3, 0, ()), 0.0, 1.0)
    assert rising.speed == 0.0 and rising.again == pytest.approx(0.3, rel=1e-6)


def test_what_is_left_out_is_named() -> None:
    table = {"contacts": ["v1-palm", "v2-finger1"], "until": {"x": 0.04}}
    problem = problem_of(HEPTAGON).with_({"phases": [table]})
    text = predict(problem).to_text()
    assert "left out" in text and "has not one or two freedoms" in text


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = HEPTAGON.read_text(encoding="utf-8")
    file, table, figure = (tmp_path / name for name in ("one.toml", "slow.csv", "slow.svg"))
    cut = text.index("[[phases]]", text.index("[[phases]]") + 1)
    file.write_text(text[:cut], encoding="utf-8")
    arguments = ["predict", str(file), "-o", str(figure), "--torques", str(table), "--json"]
    assert main(arguments) == 0
    values = json.loads(capsys.readouterr().out)
    (phase,) = values["phases"]
    assert phase["is_kept"] and phase["survivals"][1]["speed"] == pytest.approx(paced().speed)
    assert "<svg" in figure.read_text(encoding="utf-8")
    profile = make_torques(predicted(), 0.05)
    assert profile.duration == pytest.approx(predicted().phases[0].length / 0.05)
    assert table.read_text(encoding="utf-8").startswith("t,tau1,tau2\n")
    printed = predicted().to_text()
    for survival in predicted().phases[0].survivals:
        assert f"{survival.motion}" in printed and survival.first.name in printed
    assert OWN in printed and "all along" in printed
    assert main(["predict", str(file), "--squeeze", "2"]) == 2
    assert main(["predict", str(file), "--speed", "1"]) == 2
    with pytest.raises(InputError, match="squeeze"):
        predict(first_phase(), squeeze=math.nan)


def test_without_quasistatic_torques_the_table_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Torques too weak to hold the object; the file begins with a byte order mark.
    text = HEPTAGON.read_text(encoding="utf-8")
    file, table = tmp_path / "weak.toml", tmp_path / "a.csv"
    weak = re.sub("torque_limit = .*", "torque_limit = 0.02", text)
    file.write_text(weak, encoding="utf-8-sig")
    assert main(["predict", str(file), "--torques", str(table)]) == 1
    out, err = capsys.readouterr()
    assert "keeps epsilon to" in out and "torque of finger 2 and finger 2" not in out
    assert err.startswith("wholearm: no quasistatic torques to write: phase 1")
    assert not table.exists()
