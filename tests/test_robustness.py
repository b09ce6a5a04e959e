from __future__ import annotations

import math
import os
import re
import signal
import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import NormalDist
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import wholearm
import wholearm.analysis.robustness as robustness
from planned import forward
from retelling import Retelling, Units
from rows import each
from shipped import BOX, FOLDER, HEPTAGON, part_of, problem_of, text_of
from toys import plan_path
from wholearm import Formation, InputError, Plan, PlanOptions, Problem, Scene, TorqueProfile
from wholearm.analysis.robustness import (
    Robustness,
    Share,
    Trial,
    Uncertainty,
    assess_robustness,
    change_problem,
    change_torques,
    make_trial,
    measure_sensitivities,
)
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.common.parallel import connect, run_all
from wholearm.geometry.curve import Curve, directions_of
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics import dynamics
from wholearm.mechanics.sensitivity import Sensitivity, find_slopes_at
from wholearm.mechanics.statics import Statics
from wholearm.planning.path_domain import path_plan
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.refinement import refine
from wholearm.planning.robust.robust_rows import list_holds, measure_holds
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.definition import NAMES, PARAMETERS
from wholearm.problem.read import build_problem
from wholearm.results.trajectory import Motion, Samples
from wholearm.simulation.events import EventKind, FreeStretch, Simulation

Z = NormalDist().inv_cdf(0.975)
NONE = dict.fromkeys(("inertia", "friction", "geometry", "start_x", "gain", "delay"), 0.0)
FEW = Uncertainty({**NONE, "friction_finger1": 0.1}, sample_rate=None)
"""Of mass and of one friction."""
THREADS: Callable[[], Executor] = partial(ThreadPoolExecutor, 2)


@pytest.fixture(scope="module")
def problem() -> Problem:
    """The first slide of the heptagon alone."""
    return part_of(problem_of(HEPTAGON), 0, 1).with_(epsilon=0.3)


@pytest.fixture(scope="module")
def plan(problem: Problem) -> Plan:
    return wholearm.solve(problem, replay=False)


@pytest.fixture(scope="module")
def trial(problem: Problem, plan: Plan) -> Trial:
    return make_trial(problem, plan.trajectory, FEW)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("study") / "study.jsonl"


@pytest.fixture(scope="module")
def study(problem: Problem, plan: Plan, written: Path) -> Robustness:
    return assess_robustness(problem, plan, samples=5, uncertainty=FEW, path=written, start=THREADS)


def test_nothing_off_is_the_plan(trial: Trial) -> None:
    """What is left is the simulator's tolerance, 1e-9 of the scene's length, many times over."""
    record = trial.change({})
    assert record["reached"] and record["kept"] and not record["lost"]
    assert record["distance"] < 1e-8 and record["angle"] < 1e-8
    assert record["least"] == pytest.approx(0.3, abs=1e-5)
    way = np.hypot(*np.diff(np.array(record["path"])[:, :2], axis=0).T)
    assert len(way) == 100 and way.max() < 2 * way.mean()


def test_a_start_that_is_off_closes_the_fingers_there(trial: Trial) -> None:
    begun = trial.simulate({"start_x": 2e-4}, trial.torque.cut(0.0, 1e-6)).z[0]
    assert begun[0] == pytest.approx(trial.state[0] + 2e-4, abs=1e-12)
    gaps = trial.problem.phases[0].formation.evaluate(begun[None], np.zeros((1, 5))).C
    assert np.abs(gaps).max() < 1e-12


def test_what_is_far_off_loses_contacts_and_misses(trial: Trial) -> None:
    record = trial.change({"gain1": -0.3, "gain2": 0.3})
    assert not record["reached"] and not record["kept"]
    assert record["lost"] in trial.phases[0].formation.names and record["phase"] == 1


def test_a_hand_that_cannot_close_is_counted(trial: Trial) -> None:
    record = trial.change({"base1_x": 1.0})
    assert record["lost"] == "start" and "finger 1" in record["ended"] and not record["reached"]


def test_a_study_grows_and_is_reported_in_part(
    problem: Problem, plan: Plan, study: Robustness, written: Path, tmp_path: Path
) -> None:
    path, calls = tmp_path / "study.jsonl", list[str]()
    path.write_text(written.read_text())
    run = partial(assess_robustness, problem, plan, uncertainty=FEW, path=path, start=THREADS)
    part = run(samples=2, progress=calls.append)
    assert part.records == study.records[:2] and "2 of 5 samples" in part.to_text()
    assert not calls and path.read_text() == written.read_text()
    more = run(samples=7, progress=calls.append)
    assert len(calls) == 2 and more.records[:5] == study.records
    assert path.read_text().startswith(written.read_text())
    # What is added is a Latin hypercube, too, and the same one when it is drawn again.
    mass = np.sort(more.samples[5:, 0])
    assert mass[0] < 0 < mass[1] and not np.isin(more.samples[5:], more.samples[:5]).any()
    assert np.array_equal(run(samples=7).samples, more.samples)


def test_sensitivities_are_those_of_the_simulator_that_is_told_contacts(
    problem: Problem, trial: Trial
) -> None:
    """By differences of its forces at the same instant, with another step."""
    found = measure_sensitivities(trial)
    slopes = {own.name: own.slope for own in found.of}
    torque = trial.torque.cut(0.0, found.time)
    for name, step in (("mass", 1e-4), ("friction_finger1", 2e-4)):
        forces = []
        for change in (-step, step):
            replay = wholearm.simulate(change_problem(problem, {name: change}), torque)
            forces.append(replay.c_n[-1, replay.contacts.index(found.contact)])
        assert slopes[name] == pytest.approx((forces[1] - forces[0]) / (2 * step), rel=1e-4)


@pytest.mark.parametrize(
    "options, text",
    [
        (["--vary", "mass"], "--vary: 'mass' given; NAME=WIDTH is needed"),
        (["--vary", "weight=1"], "--vary weight: is unknown"),
        (["--vary", "mass=0.1", "mass=0.2"], "--vary: 'mass=0.2' given; NAME=WIDTH is needed"),
        (["--phase", "9"], "--phase: 9 given; the plan has phases 1 to 1"),
        (["--jobs", "0"], "--jobs: 0 given"),
        (["--scheduler", "foo://bar"], "--scheduler: "),
        (["-o", "out.csv"], "out.csv"),
    ],
)
def test_bad_options_are_named(
    plan: Plan, options: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, file = tmp_path / "one.toml", tmp_path / "plan.npz"
    plan.save(file)
    # The file as far as the second phase.
    path.write_text(text_of(), encoding="utf-8")
    assert main(["robustness", str(path), str(file), *options]) == 2
    assert text in capsys.readouterr().err and not Path("one_robustness.jsonl").exists()


def follow(stretches: list[tuple[str, float, float]], phases: tuple[Any, ...]) -> dict[str, Any]:
    """The verdict on a motion of 1 s in which contacts press as given."""
    names = tuple(dict.fromkeys(name for phase in phases for name in phase.formation.names))
    stops = tuple((np.arange(len(phases)) + 1) / len(phases))
    scene = SimpleNamespace(scales=SimpleNamespace(time=0.1, length=1 / 30))
    problem: Any = SimpleNamespace(scene=scene)
    trial = Trial(problem, None, np.zeros(5), phases, stops, np.zeros(3), FEW)  # type: ignore[arg-type]
    t = np.linspace(0, 1, 11)
    # "c" strikes at 0.45, if it presses from 0.46 on.
    events = [SimpleNamespace(contact="c", kind=EventKind.IMPACT, time=0.45)]
    events *= ("c", 0.46, 1) in stretches
    simulation: Any = SimpleNamespace(
        t=t,
        **dict.fromkeys(("z", "z_dot", "z_ddot"), np.zeros((11, 5))),
        c_n=np.ones((11, len(names))),
        contacts=names,
        stretches=[FreeStretch(*stretch, least=1.0, time=0.0) for stretch in stretches],
        events=events,
        outcome=SimpleNamespace(kind=None, text=""),
    )
    simulation.list_pauses = partial(Simulation.list_pauses, simulation)
    return trial.judge(simulation, 0.0, stops)


def hold(number: int, names: str, gained: str = "", **aliases: str) -> Any:
    """A phase with contacts of one letter, those that it gains, and what its own go on as."""
    of = {name: set(aliases.get(name, "")) for name in names}
    formation = SimpleNamespace(names=names)
    return SimpleNamespace(number=number, formation=formation, gained=set(gained), aliases=of)


ONE = (hold(1, "ab", "cd"),)
TWO = (hold(1, "ab", "cd"), hold(2, "bc", c="d"))


@each(
    "stretches, phases, lost",
    [
        ([("a", 0, 1), ("b", 0, 1)], ONE, None),
        ([("a", 0, 0.4), ("a", 0.40005, 1), ("b", 0, 1)], ONE, None),
        ([("a", 0, 0.4), ("a", 0.41, 1), ("b", 0, 1)], ONE, ("a", 1, 0.4)),
        ([("a", 0, 1), ("b", 0.2, 1)], ONE, ("b", 1, 0.0)),
        # What is open at the start has 0.01 s to close.
        ([("a", 0, 1), ("b", 0.005, 0.006), ("b", 0.008, 1)], ONE, None),
        ([("a", 0, 1), ("b", 0.005, 0.3), ("b", 0.35, 1)], ONE, ("b", 1, 0.3)),
        ([("a", 0, 0.003), ("a", 0.005, 1), ("b", 0, 1)], ONE, ("a", 1, 0.003)),
        ([("a", 0, 0.5), ("b", 0, 1), ("c", 0.5, 1)], TWO, None),
        ([("a", 0, 0.47), ("b", 0, 1), ("c", 0.47, 1)], TWO, None),
        ([("a", 0, 0.5), ("b", 0, 1), ("c", 0.53, 1)], TWO, None),
        ([("a", 0, 0.45), ("b", 0, 1), ("c", 0.46, 1)], TWO, None),
        ([("a", 0, 0.44), ("b", 0, 1), ("c", 0.46, 1)], TWO, ("a", 1, 0.44)),
        # The gained contact presses as that of a neighbouring feature.
        ([("a", 0, 0.46), ("b", 0, 1), ("d", 0.46, 0.7), ("c", 0.7, 1)], TWO, None),
        ([("a", 0, 0.5), ("b", 0, 1), ("c", 0.5, 0.8)], TWO, ("c", 2, 0.8)),
        ([("a", 0, 0.5), ("b", 0, 1)], TWO, ("c", 1, 0.5)),
    ],
)
def test_contacts_have_to_press_while_their_phase_lasts(
    stretches: list[tuple[str, float, float]],
    phases: tuple[Any, ...],
    lost: tuple[str, int, float] | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(robustness, "list_gained", lambda _, phase: phase.gained)
    monkeypatch.setattr(robustness, "list_aliases", lambda _, phase: phase.aliases)
    record = follow(stretches, phases)
    found = (record["lost"], record["phase"], record["time"]) if record["lost"] else None
    assert found == lost and record["kept"] == (lost is None)


@pytest.mark.parametrize("count, total", [(1, 7), (50, 100), (998, 1000)])
def test_ends_of_the_interval_are_as_unlikely_as_it_says(count: int, total: int) -> None:
    """Wilson's definition: the share is Z standard deviations off at both ends."""
    share = Share(count, total)
    for p in share.interval:
        assert abs(share.value - p) == pytest.approx(Z * math.sqrt(p * (1 - p) / total), rel=1e-9)
    assert share.interval[0] < share.value < share.interval[1]


def test_none_and_all_have_one_open_end() -> None:
    none, every = Share(0, 20), Share(20, 20)
    # (1 - p)^n = ... is replaced by the normal law: p = Z^2 / (n + Z^2).
    assert none.interval == pytest.approx((0.0, Z**2 / (20 + Z**2)), rel=1e-12)
    assert every.interval == pytest.approx((1 - Z**2 / (20 + Z**2), 1.0), rel=1e-12)
    assert str(every) == "100.0 % (20 of 20, 95 %: 83.9 to 100.0 %)"


def wait_and_square(number: int) -> tuple[int, int]:
    time.sleep(0.02)
    return number**2, os.getpid()


def test_a_worker_that_is_killed_loses_and_doubles_no_task() -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        answers = run_all(wait_and_square, range(100), connect(cluster.scheduler_address))
        found = [next(answers) for _ in range(10)]
        os.kill(found[-1][1][1], signal.SIGKILL)
        found += answers
    assert sorted(task for task, _ in found) == list(range(100))
    assert all(answer[0] == task**2 for task, answer in found)


def test_no_scheduler_is_bad_input() -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    with pytest.raises(InputError, match="--scheduler: tcp:"):
        connect("tcp://127.0.0.1:1", patience=0.5)


@pytest.fixture
def torque() -> TorqueProfile:
    """A line and a parabola, with a step at 0.3 s."""
    breaks = np.array([0.0, 0.3, 0.5])
    first = [[1.0, 0.5, 0.0], [0.2, 0.0, 0.0]]
    return TorqueProfile(breaks, np.array([first, [[2.0, 0.0, -0.3], [0.0, 0.1, 0.2]]]))


def test_samples_have_one_in_every_slice_of_every_range() -> None:
    own = Uncertainty({"mass": 0.2, "geometry": 0.0, "delay": 2e-3})
    names = [parameter.name for parameter in own.varied]
    assert not {"length1", "base2_y"} & set(names) and len(names) == len(NAMES) - 6
    samples = own.draw(50, seed=3)
    assert samples.shape == (50, len(names) + 1)
    for name, column in zip([*names, "offset"], samples.T, strict=True):
        width = own.widths.get(name, 0.0)
        low, high = {"delay": (0.0, 2e-3), "offset": (0.0, 1.0)}.get(name, (-width, width))
        slices = np.floor((column - low) / (high - low) * 50).astype(int)
        assert sorted(slices) == list(range(50)), name


@each("name", [*NAMES[: NAMES.index("start_x")]])
def test_each_parameter_changes_its_own_number(heptagon: Problem, name: str) -> None:
    def list_numbers(scene: Scene) -> dict[str, float]:
        assert scene.polygon.inertia is not None
        found = {"mass": scene.polygon.mass, "inertia": scene.polygon.inertia}
        for key in ("palm", "finger1", "finger2"):
            found[f"friction_{key}"] = getattr(scene.friction, key)
        for k, finger in enumerate(scene.fingers, 1):
            base = np.asarray(finger.base)
            found |= {f"length{k}": finger.length, f"base{k}_x": base[0], f"base{k}_y": base[1]}
        return found

    before = list_numbers(heptagon.scene)
    after = list_numbers(change_problem(heptagon, {name: 1e-3}).scene)
    relative = not next(own.unit for own in PARAMETERS if own.name == name)
    change = before[name] * 1e-3 if relative else 1e-3
    assert after.pop(name) == pytest.approx(before.pop(name) + change, rel=1e-14)
    assert after == pytest.approx(before, rel=1e-14)


def test_torques_are_scaled_and_late(torque: TorqueProfile) -> None:
    late = change_torques(torque, {"gain1": 0.01, "gain2": -0.02, "delay": 0.02})
    times = np.array([0.01, 0.02, 0.1, 0.31, 0.33, 0.5])
    expected = torque.at(times - 0.02) * [1.01, 0.98]
    np.testing.assert_allclose(late.at(times), expected, rtol=1e-12)
    assert late.duration == pytest.approx(0.52)
    same = change_torques(torque, {})
    assert (same.at(times) == torque.at(times)).all() and same.duration == torque.duration


@pytest.mark.parametrize("offset", [0.0, 0.25])
def test_torques_are_sampled_and_held(torque: TorqueProfile, offset: float) -> None:
    held = change_torques(torque, {}, sample_rate=10.0, offset=offset)
    ticks = np.clip((np.arange(6) - offset) / 10, 0, None)
    ticks = np.unique(ticks[ticks < 0.5])
    for start, stop in zip(ticks, [*ticks[1:], 0.5], strict=True):
        within = np.linspace(start, stop, 5)[:-1] + 1e-9
        expected = np.tile(torque.at(ticks[ticks <= start][-1:]), (4, 1))
        np.testing.assert_allclose(held.at(within), expected, rtol=1e-12)


def test_a_problem_brings_its_own_ranges(heptagon: Problem) -> None:
    own = heptagon.with_(uncertainty={"friction": 0.2, "friction_palm": 0.3, "start_x": 5e-4})
    assert own.table["uncertainty"] == own.uncertainty
    widths = Uncertainty(own.uncertainty or {}).widths
    expected = {"friction_palm": 0.3, "friction_finger2": 0.2, "start_x": 5e-4, "mass": 0.05}
    assert {key: widths[key] for key in expected} == expected
    assert replace(own, uncertainty=None).table == heptagon.table
    assert replace(heptagon, uncertainty={"mass": 0.1}).table["uncertainty"] == {"mass": 0.1}


EPSILON = 0.05
RADII = {"mass": 0.02, "friction_palm": 0.02, "friction_finger1": 0.02, "friction_finger2": 0.02}


def replace_nearby(formation: Formation, z: Array, v: Array) -> tuple[Array, Array]:
    """The nearest configuration of a changed formation, and the nearest velocity there."""
    root = np.sqrt(dynamics.metric_weights(formation.scene))
    found, slip = z.copy(), formation.evaluate_slip(z[None])[0]
    for _ in range(8):
        own = formation.evaluate(found[None], z[None])
        off = np.concatenate([own.C[0], formation.evaluate_slip(found[None])[0] - slip])
        P = own.P[0]
        found = z + np.linalg.pinv(P / root) @ (P @ (found - z) - off) / root
    P = formation.evaluate(found[None], z[None]).P[0]
    return found, v - np.linalg.pinv(P / root) @ (P @ v) / root


State = tuple[Array, Array, Array, dynamics.Directions]
"""Configuration, velocity, torques, and directions of friction."""


def solve_forces(
    heptagon: Problem, formation: Formation, state: State, name: str, change: float
) -> Array:
    """Contact forces in the scene whose number is off, at the same place, velocity and torques."""
    z, v, tau, directions = state
    tau = tau.copy()
    if name.startswith("gain"):
        tau[int(name[-1]) - 1] *= 1 + change
    else:
        formation = replace(formation, scene=change_problem(heptagon, {name: change}).scene)
        z, v = replace_nearby(formation, z, v)
    return forward(formation, z, v, tau, directions)[1]


def require_slopes(
    heptagon: Problem, formation: Formation, state: State, names: list[str], slopes: Array
) -> None:
    """Require slopes, shape (n_c + R, len(names)), to be those of differences."""
    units = {parameter.name: parameter.unit for parameter in PARAMETERS}
    for k, name in enumerate(names):
        step = 1e-6 if units[name] else 1e-5
        given = heptagon, formation, state, name
        ends = [solve_forces(*given, sign * step) for sign in (-1, 1)]
        expected = (ends[1] - ends[0]) / (2 * step)
        np.testing.assert_allclose(slopes[:, k], expected, rtol=1e-5, atol=1e-5, err_msg=name)


OFF = [name for name in NAMES if name not in ("delay", "start_x")]


@pytest.mark.parametrize("which", ["sliding", "rolling"])
def test_slopes_along_curves_are_those_of_the_whole_solve(which: str) -> None:
    own = problem_of(HEPTAGON if which == "sliding" else BOX)
    way = trace_phases(own)[0 if which == "sliding" else 1]
    assert bool(way.formation.rolling) == (which == "rolling")
    # Slip coordinates count from the joint, which is another question.
    names = [name for name in OFF if which == "sliding" or not name.startswith("base")]
    s, (a, b, squeeze) = 0.4 * way.length, np.array([[2.0], [0.1], [3.0]])
    point = way.evaluate(np.array([s]))
    segment = np.searchsorted([part.stop for part in way.segments][:-1], [s])
    directions = directions_of(way, segment)
    forces = dynamics.inverse(way.formation, point, directions)
    along = Sensitivity.of_curve(way.formation, point, directions, forces)
    slopes = along.find_slopes([*names, "start_x"])[0] @ dynamics.stack_motion(a, b, squeeze)[0]
    tau = forces.tau(a, b, squeeze)[0]
    here = dynamics.Directions(directions.Xi[0], directions.sigma[0])
    state = point.z[0], point.z_s[0] * np.sqrt(b), tau, here
    require_slopes(own, way.formation, state, names, slopes)
    size = np.sqrt(point.z_s[0, :3] ** 2 @ dynamics.metric_weights(own.scene)[:3])
    step, ends = 1e-6, []
    for sign in (-1, 1):
        moved = way.evaluate(np.array([s + sign * step / size]))
        other = moved.z[0], moved.z_s[0] * np.sqrt(b), tau, here
        ends.append(solve_forces(own, way.formation, other, "mass", 0.0))
    np.testing.assert_allclose(slopes[:, -1], (ends[1] - ends[0]) / (2 * step), rtol=1e-5)


def test_slopes_with_two_freedoms_are_those_of_the_whole_solve(heptagon: Problem) -> None:
    contacts = [heptagon.phases[0].formation.contacts[k] for k in (1, 2, 3)]
    formation, z = Formation(heptagon.scene, tuple(contacts)), heptagon.start
    kinematics = formation.evaluate(z[None], z[None])
    v = np.linalg.svd(kinematics.P[0])[2][3:].T @ [0.2, -0.5]
    here = dynamics.Directions(np.sign(kinematics.A_t[0] @ v), np.sign(v[3:]))
    tau = np.array([0.7, -0.9])
    z_ddot, c = forward(formation, z, v, tau, here)
    samples = Samples(*(part[None] for part in (z, v, z_ddot, tau, c, -0.1 * here.Xi * c)))
    rows = dynamics.Directions(here.Xi[None], here.sigma[None])
    slopes = find_slopes_at(formation, samples, rows, OFF)[0]
    require_slopes(heptagon, formation, (z, v, tau, here), OFF, slopes)
    along = find_slopes_at(formation, samples, rows, ["start_x"])[0, :, 0]
    assert np.isfinite(along).all() and np.abs(along).max() > 1.0


def find_least_in_corners(heptagon: Problem, formation: Formation, motion: Motion) -> Array:
    """The least c_n of each contact over all corners of `RADII`, at instants of a motion."""
    samples = motion.evaluate(np.linspace(0.0, motion.duration, 22)[1:-1])
    least = np.full(samples.c_n.shape, np.inf)
    Xi, sigma = -np.sign(samples.c_t), np.sign(samples.z_dot[:, 3:])
    for signs in product((-1, 1), repeat=len(RADII)):
        changes = {name: sign * RADII[name] for name, sign in zip(RADII, signs, strict=True)}
        scene = change_problem(heptagon, changes).scene
        at = replace(formation, scene=scene).evaluate(samples.z, samples.z_dot)
        given = samples.z_dot, samples.tau, dynamics.Directions(Xi, sigma)
        least = np.minimum(least, dynamics.forward(replace(formation, scene=scene), at, *given)[1])
    return least


@pytest.mark.parametrize("transcription", ["auto", "time"])
def test_a_robust_plan_keeps_epsilon_in_every_corner(
    transcription: str, heptagon: Problem, curves: tuple[Curve, ...]
) -> None:
    options = PlanOptions(ranges=RADII, accuracy=1e-3)
    own: tuple[PhasePlan[Motion], ...]
    if transcription == "auto":
        each_of = [replace(options, ranges=ranges) for ranges in (RADII, {})]
        own = tuple(plan_path(curves[0], EPSILON, one, 1) for one in each_of)
    else:
        timed = replace(options, transcription="time", mode_search=False, time_intervals=4)
        given = heptagon, heptagon.phases[:1], heptagon.start
        own = tuple(plan_phases(*given, replace(timed, ranges=r))[0] for r in (RADII, {}))
    formation = heptagon.phases[0].formation
    robust, plain = (find_least_in_corners(heptagon, formation, plan.motion).min() for plan in own)
    # What two percent change to second order is a hundredth of what they change to first.
    swing = EPSILON - plain
    assert swing > 0.01
    assert robust > EPSILON - 0.03 * swing
    # A plan that touches its limits somewhere gives away little.
    assert robust < EPSILON + 0.5 * swing
    assert own[1].value < own[0].value < 1.1 * own[1].value


def test_without_an_accurate_robust_plan_there_is_a_rough_one(
    curves: tuple[Curve, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stall(first: path_plan.PathIterate, accuracy: float) -> path_plan.PathIterate:
        return refine(first, accuracy, 40 if accuracy >= 1e-2 or not first.task.references else 0)

    monkeypatch.setattr(path_plan, "refine", stall)
    plan = plan_path(curves[0], EPSILON, PlanOptions(ranges=RADII, accuracy=1e-6), 1)
    assert 1e-6 < plan.error < 1e-2


def add_ranges(ranges: object) -> Problem:
    return problem_of(HEPTAGON).with_(uncertainty=ranges)


def scale_ranges(options: dict[str, Any]) -> PlanOptions:
    return PlanOptions(**options).scale_ranges({})


@each(
    "use, given, text",
    [
        (Uncertainty, {"weight": 0.1}, "of weight: is unknown; allowed are friction, geometry, ga"),
        (Uncertainty, {"mass": -0.1}, "range of mass: "),
        (Uncertainty, {"friction": 1.0}, "of friction: 1 given; a relative range is below 1"),
        (Uncertainty, {"delay": math.nan}, "range of delay: "),
        (add_ranges, {"mas": 0.1}, ".mas: unknown key; did you mean 'mass'? allowed are base1_x"),
        (add_ranges, {"gain": 1}, "uncertainty.gain: 1 given; a relative range is below 1"),
        (add_ranges, {"start_x": -1e-3}, "uncertainty.start_x: -0.001 is not a number >= 0"),
        (add_ranges, 0.1, "uncertainty: 0.1 is not a table"),
        (scale_ranges, {"robust": -1.0}, "robust: -1.0 given; allowed are 0 to 1000"),
        (scale_ranges, {"robust": 10.0}, "robust: 10 makes the range of friction_palm 1; a relati"),
        (scale_ranges, {"robust": 1.0, "certify": True}, "certify: does not go with robust"),
        (scale_ranges, {"largest": True}, "largest: is for robust plans only"),
    ],
)
def test_ranges_that_make_no_sense_are_refused(
    use: Callable[[Any], object], given: object, text: str
) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        use(given)


def test_what_friction_may_hold_grows_with_the_ranges(heptagon: Problem) -> None:
    formation, tau = heptagon.phases[0].formation, np.array([0.05, -0.02])
    ranges = {"friction_palm": 0.3, "friction_finger1": 0.3, "mass": 0.1, "gain2": 0.05}
    exact = Statics(formation, heptagon.start).torque_polygon().measure(tau[None])[0]
    assert measure_holds(list_holds(formation, heptagon.start, {}), tau) == pytest.approx(exact)
    rng, within = np.random.default_rng(3), list_holds(formation, heptagon.start, ranges)
    for tau in rng.uniform(-1.0, 1.0, (20, 2)):
        least = measure_holds(within, tau)
        for _ in range(5):
            own = {name: width * rng.uniform(-1, 1) for name, width in ranges.items()}
            scene = change_problem(heptagon, own).scene
            static = Statics(replace(formation, scene=scene), heptagon.start).torque_polygon()
            assert static.measure((tau * [1.0, 1 + own["gain2"]])[None])[0] >= least - 1e-9


def test_without_gravity_fingers_are_weighed_against_each_other() -> None:
    weightless = problem_of(HEPTAGON).with_(gravity=0.0)
    with pytest.raises(InputError, match="times finger 2's strength"):
        weightless.with_(torque_limit1=1e7)


@each("path", sorted(FOLDER.glob("*.toml")))
def test_ranges_follow_the_units(path: Path) -> None:
    """Millimetres and grams, and sizes and masses far from those of the shipped problems."""
    problem = problem_of(path)
    for units in (Units(1e3, 1e3), Units.of(0.01, 1e-3), Units.of(100.0, 1e4)):
        build_problem(Retelling("", units).apply(problem).table)


def test_the_start_of_a_small_object_has_rounding_of_its_angle() -> None:
    """Angles have no length: rounding of a radian is the same for an object of 0.5 mm."""
    small = Retelling("", Units.of(0.01, 1e-3)).apply(problem_of(BOX))
    turned = small.start + np.array([0.0, 0.0, 4e-15, 0.0, 0.0])
    assert build_problem(replace(small, start=turned).table).epsilon == small.epsilon
