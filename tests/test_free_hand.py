"""Hand and object without being told which contacts hold, and random drops and throws."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from plane import finger_gap, make_scene
from planned import change, plan
from shipped import HEPTAGON, HEXAGON
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError, SimulationError
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.problem.definition import Problem
from wholearm.problem.read import read_problem
from wholearm.results.dwell_record import assemble
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Trajectory
from wholearm.scene.model import Finger, Friction, Polygon, Scene
from wholearm.simulation.events import EventKind, FreeSimulation, OutcomeKind
from wholearm.simulation.hand import build_system, measure_gaps
from wholearm.simulation.simulate import simulate, simulate_free
from wholearm.verification.free import FreeReport, verify_free
from wholearm.verification.verify import verify

DURATION = 0.4
"""Of a random run [s]."""


class Draw(NamedTuple):
    """A random scene with a state and torques to start from."""

    problem: Problem
    state: Array
    torque: TorqueProfile
    restitution: float


class Figures(NamedTuple):
    """What must not be, of one run.

    Attributes
    ----------
    gained : float
        Largest gain of energy over what the torques did, relative to all that has moved.
    unexplained : float
        Largest residual of the balance of energy, likewise.
    overlap : float
        Largest overlap of two bodies, relative to the scene's length.
    """

    gained: float
    unexplained: float
    overlap: float


def draw_run(seed: int) -> Draw:
    """A random object that is thrown into a hand, which moves by random torques."""
    rng = np.random.default_rng([17, seed])
    count, size = int(rng.integers(3, 8)), 0.05
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    corners = size * np.column_stack([np.cos(angles), rng.uniform(0.4, 1.0) * np.sin(angles)])
    radius = float(rng.choice([0.0, 0.005]))
    fingers = tuple(
        Finger(
            base=[side * rng.uniform(0.07, 0.12), -0.01],
            length=rng.uniform(0.1, 0.2),
            radius=radius,
            inertia=rng.uniform(1e-4, 5e-3),
            viscous=rng.choice([0.0, 0.01]),
            dry=rng.choice([0.0, 0.02]),
            torque_limit=2.0,
        )
        for side in (1.0, -1.0)
    )
    mu = rng.uniform(0, 1, 3) * rng.choice([0.0, 1.0], p=[0.2, 0.8])
    scene = Scene(Polygon(corners, 0.2), (fingers[0], fingers[1]), Friction(*mu.tolist()))
    z = np.zeros(5)
    while measure_gaps(scene, z[None]).min() < 1e-3:
        turn = rng.uniform(-np.pi, np.pi)
        z[:3] = rng.uniform(-0.05, 0.05), rng.uniform(0.05, 0.25), turn
        z[3:] = rng.uniform(0, np.pi / 2), rng.uniform(np.pi / 2, np.pi)
    v = rng.choice([0.0, 1.0]) * rng.normal(size=5) * [0.5, 0.5, 5.0, 3.0, 3.0]
    breaks = np.linspace(0, DURATION, 5)
    coefficients = rng.normal(size=(4, 2, 2)) * rng.choice([0.0, 0.05, 0.5])
    problem = Problem("random", scene, 0.05, z, (), checked=True)
    restitution = float(rng.choice([0.0, rng.uniform(0, 0.9)]))
    return Draw(problem, np.concatenate([z, v]), TorqueProfile(breaks, coefficients), restitution)


def run_draw(draw: Draw) -> FreeSimulation:
    """Simulate one."""
    return simulate_free(draw.problem, draw.torque, start=draw.state, restitution=draw.restitution)


def judge_run(run: FreeSimulation) -> Figures:
    """Measure what must not be."""
    energies = run.energies
    kinetic = 0.5 * (run.z_dot**2) @ run.problem.scene.mass_diagonal
    left = energies.stored - energies.work
    size = kinetic.max() + np.abs(energies.stored).max() + np.abs(energies.work).max()
    depth = -measure_gaps(run.problem.scene, run.z).min()
    return Figures(
        float((left - np.minimum.accumulate(left)).max() / size),
        float(np.abs(energies.residual).max() / size),
        float(max(depth, 0.0) / run.problem.scene.scales.length),
    )


NAMES = ("v0-palm", "v1-finger1", "v3-finger2", "e0-tip1", "v2-tip2")


@pytest.mark.parametrize("name", NAMES)
def test_pairs_are_the_contacts_that_problems_name(name: str) -> None:
    scene = make_scene()
    system, formation = build_system(scene), Formation(scene, (parse_contact(name, scene),))
    pair = system.names.index(name)
    rng = np.random.default_rng(2)
    v = rng.normal(size=5)
    for _ in range(3):
        z = np.append(rng.uniform(-0.05, 0.05, 2), rng.uniform(-1, 1, 3))
        # Where they touch, rows of sliding are those of slip coordinates.
        for _ in range(20):
            row = system.evaluate(z, v, [pair]).A[0]
            z -= system.measure(z[None])[0][0, pair] * row / (row @ row)
        rows, known = system.evaluate(z, v, [pair]), formation.evaluate(z[None], v[None])
        assert system.measure(z[None])[0][0, pair] == pytest.approx(known.C[0, 0], abs=1e-13)
        assert rows.A == pytest.approx(known.A[0], abs=1e-12)
        assert rows.A_t == pytest.approx(known.A_t[0], abs=1e-12)
        assert rows.bend == pytest.approx(known.A_dot_v[0], abs=1e-9)


def pinch(torque: float, until: float = 10.0) -> tuple[Problem, TorqueProfile, Array]:
    """A square between two upright links, pressed by the same torque of both."""
    link = dict(length=0.18, radius=0.005, inertia=0.005, viscous=0.01, dry=0.0, torque_limit=2.0)
    square = [[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]]
    fingers = Finger(base=(0.035, -0.01), **link), Finger(base=(-0.035, -0.01), **link)  # type: ignore[arg-type]
    scene = Scene(Polygon(square, 0.2), fingers, Friction(0.6, 0.6, 0.6))
    z = np.array([0, 0.08, 0, np.pi / 2, np.pi / 2])
    problem = Problem("pinch", scene, 0.05, z, (), checked=True)
    profile = TorqueProfile(np.array([0, until]), np.array([[[torque], [-torque]]]))
    return problem, profile, z


def test_a_pinched_square_does_not_creep() -> None:
    problem, torque, z = pinch(0.3)
    run = simulate_free(problem, torque)
    assert (run.z == run.z[0]).all() and (run.z_dot == 0).all() and run.t[-1] == 10.0
    assert run.z[0] == pytest.approx(z, abs=1e-13)
    assert [event.kind for event in run.events] == [EventKind.REST]


def test_a_square_slips_when_no_friction_can_hold_it_any_more() -> None:
    # The lower corners, 0.06 m above the joints, need the least torque: tau = N (0.06 - mu radius).
    problem, _, _ = pinch(0.3)
    falling = TorqueProfile(np.array([0.0, 1.0]), np.array([[[0.15, -0.15], [-0.15, 0.15]]]))
    run = simulate_free(problem, falling)
    starts = run.find(EventKind.START)
    least = 0.2 * 9.81 * (0.06 - 0.6 * 0.005) / (2 * 0.6)
    assert [event.time for event in starts] == pytest.approx([1 - least / 0.3], abs=1e-8)
    assert (run.z[run.t < starts[0].time] == run.z[0]).all()
    # Other corners would have let it go before.
    assert run.find(EventKind.AMBIGUOUS)


def test_a_square_that_is_pinched_too_weakly_falls_to_the_palm() -> None:
    # Friction needs mu 2 N = m g, and N is at most the torque over the lower corners' height.
    problem, torque, _ = pinch(0.9 * 0.2 * 9.81 * 0.06 / (2 * 0.6), until=1.0)
    run = simulate_free(problem, torque)
    assert run.z[-1, 1] == pytest.approx(0.03, abs=1e-9) and (run.z_dot[-1] == 0).all()
    assert {event.contact for event in run.find(EventKind.IMPACT)} == {"v0-palm", "v1-palm"}
    assert run.outcome.kind is OutcomeKind.ENDED
    assert np.abs(run.energies.residual).max() < 1e-9


@dataclasses.dataclass
class Spring:
    """Torques towards upright links, as a controller holds them."""

    period: float
    delay: float

    def held(self, t: float, theta: Array, theta_dot: Array, forces: Mapping[str, float]) -> Array:
        assert t == pytest.approx(self.period * round(t / self.period), abs=1e-12)
        assert {name[-1] for name in forces} <= {"m"}
        return 0.5 * (np.pi / 2 - theta) - 0.02 * theta_dot


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0, 1.7])
def test_a_law_is_sampled_held_and_late(share: float) -> None:
    link = dict(length=0.18, radius=0.0, inertia=0.005, viscous=0.0, dry=0.0, torque_limit=2.0)
    bases = ((0.4, -0.01), (-0.4, -0.01))
    first, second = (Finger(base=base, **link) for base in bases)  # type: ignore[arg-type]
    square = [[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]]
    scene = Scene(Polygon(square, 0.2), (first, second), Friction(0.5, 0.5, 0.5))
    z = np.array([0, 0.03, 0, 1.3, 1.9])
    problem, law = Problem("spring", scene, 0.05, z, (), checked=True), Spring(0.007, share * 0.007)
    run = simulate_free(problem, law, start=z, until=0.05)
    # Constant torques between the instants at which one is taken or takes effect.
    t, theta, omega = 0.0, z[3:].copy(), np.zeros(2)
    samples = [law.held(0.0, theta, omega, {})]
    instants = {0.007 * (k + share): 0 for k in range(1, 8)}
    instants |= {0.007 * k: k for k in range(1, 8)} | {0.05: 0}
    for after, k in sorted(own for own in instants.items() if own[0] <= 0.05):
        tau = samples[max(0, int((t - law.delay) / 0.007 + 1e-9))]
        h = after - t
        t, theta, omega = after, theta + h * omega + h**2 * tau / 0.01, omega + h * tau / 0.005
        if k:
            samples.append(law.held(after, theta, omega, {}))
    assert run.t[-1] == 0.05 and run.z[-1, 3:] == pytest.approx(theta, abs=1e-11)
    assert run.z_dot[-1, 3:] == pytest.approx(omega, abs=1e-9)


@pytest.mark.parametrize("seed", [3, 103, 512])
def test_random_runs_gain_no_energy_and_overlap_nowhere(seed: int) -> None:
    draw = draw_run(seed)
    run = run_draw(draw)
    figures = judge_run(run)
    assert run.outcome.kind is OutcomeKind.ENDED and run.residual < 1e-9
    assert figures.gained < 1e-8 and figures.unexplained < 1e-8
    assert figures.overlap < 1e-7
    # Other distances, of polygon and segments.
    scene = draw.problem.scene
    for finger in range(2):
        q, theta = run.z[::5, :3], run.z[::5, 3 + finger]
        assert finger_gap(scene, q, finger, theta).min() > -1e-7 * scene.scales.length


def test_what_is_held_at_the_limit_of_friction_rests() -> None:
    # Five contacts and two joints give way at once, so that forces are redundant, and none is left.
    problem = read_problem(str(HEXAGON))
    z = np.array([-0.055000127022182474, 0.0433, 0.0, 2.386803231534441, 2.0944078045648657])
    tau = np.array([0.14447658672160446, 0.006945556702579097])
    rng = np.random.default_rng(0)
    for _ in range(6):
        near = tau * (1 + 1e-15 * rng.normal(size=2))
        profile = TorqueProfile(np.array([0.0, 0.002]), near.reshape(1, 2, 1))
        run = simulate_free(problem, profile, start=z + 1e-16 * rng.normal(size=5))
        assert run.outcome.kind is OutcomeKind.ENDED and run.residual < 1e-9
        assert run.z[-1] == pytest.approx(z, abs=1e-12)


@lru_cache
def begin() -> tuple[Problem, Trajectory]:
    """The first two phases of a plan."""
    problem, trajectory = plan(pieces=12)
    count = int(np.searchsorted(trajectory.torque.breaks, 0.8))
    torque = TorqueProfile(
        trajectory.torque.breaks[: count + 1], trajectory.torque.coefficients[:count]
    )
    two = dataclasses.replace(problem, phases=problem.phases[:2])
    meta = {"epsilon": problem.epsilon, "problem": two.table}
    return two, assemble(list(trajectory.motions[:2]), torque, meta, 201)


TOLD: list[str] = []


@lru_cache
def checked() -> FreeReport:
    return verify_free(*begin(), progress=TOLD.append)


def test_phases_of_a_plan_are_as_told() -> None:
    report = checked()
    assert TOLD == ["simulating the whole", *(f"simulating phase {k} of 2" for k in (1, 2))]
    assert report.ok and report.exit_status == 0 and len(report.alone) == 2
    for phase in report.alone:
        assert phase.reached and phase.losses == () and phase.deviation is not None
        # The interpolated torques are good to about 1e-11.
        assert phase.deviation.position < 1e-9 and phase.deviation.angle < 1e-9


def test_a_report_says_what_happens_contact_by_contact() -> None:
    report = checked()
    text, plain = report.to_text(), json.loads(json.dumps(report.to_dict()))
    assert text.startswith("heptagon, four contacts: ok: from its planned start each phase keeps")
    assert plain["ok"] and len(plain["events"]) == len(report.whole.events)
    assert {row["contact"] for row in plain["contacts"]} >= set(
        report.whole.problem.phases[0].formation.names
    )
    first = report.whole.stretches[0]
    assert first.start == 0.0 and first.least > 0


def test_torques_alone_are_followed_by_what_happens() -> None:
    problem, trajectory = begin()

    def let_go(starts: Array, c: Array) -> Array:
        c[starts > 0.2] *= -1
        return c

    report = verify_free(problem, change(trajectory.torque, let_go))
    assert not report.ok and report.exit_status == 1 and report.alone == ()
    assert report.phases[0].losses and report.phases[0].losses[0].time > 0.2
    # The simulation goes on after the first loss.
    assert report.whole.t[-1] == pytest.approx(0.8)
    assert report.whole.outcome.kind is OutcomeKind.ENDED


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"restitution": 1.5}, "restitution: 1.5 is not between 0 and 1"),
        ({"until": 0.0}, "until"),
        ({"start": [1.0, 2.0]}, "5 or 10 finite numbers are needed"),
        ({"tolerance": 1.0}, "tolerance: 1.0 is not between"),
    ],
)
def test_numbers_out_of_range(options: dict[str, object], message: str) -> None:
    problem, torque, _ = pinch(0.3)
    with pytest.raises(InputError, match=message):
        simulate_free(problem, torque, **options)


def test_an_overlap_at_the_start_is_told() -> None:
    problem, torque, z = pinch(0.3)
    with pytest.raises(SimulationError, match=r"finger 1 and object overlap by 0\.01 m at"):
        simulate_free(problem, torque, start=z + np.array([0.01, 0, 0, 0, 0]))
    assert measure_gaps(problem.scene, z[None])[0, :3] == pytest.approx([0.05, 0, 0], abs=1e-13)


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, trajectory = begin()
    given, written, figure = (str(tmp_path / name) for name in ("a.npz", "b.npz", "c.png"))
    trajectory.save(given)
    path = str(tmp_path / "two.toml")
    parts = HEPTAGON.read_text(encoding="utf-8").split("[[phases]]")
    Path(path).write_text("[[phases]]".join(parts[:3]), encoding="utf-8")
    assert main(["verify", path, given, "--free", "-o", written]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0].startswith("heptagon, four contacts: ok: ")
    assert f"wrote {written}" in out and "the whole from the start, by the clock" in out
    assert main(["plot", written, "--simulate", "free", "-o", figure]) == 0
    assert Path(figure).stat().st_size > 10_000
    for options in (["--reduced", "--free"], ["--restitution", "0.5"]):
        assert main(["verify", path, given, *options]) == 2


def test_one_function_simulates_under_both_rules() -> None:
    problem, torque, _ = pinch(0.3)
    free = simulate(problem, torque, contacts="free", times=[0.0123])
    assert 0.0123 in free.t
    assert free.z[-1] == pytest.approx(simulate_free(problem, torque).z[-1], abs=1e-9)
    for options in ({"contacts": "none"}, {"until": 1.0}, {"restitution": 0.5}):
        with pytest.raises(InputError, match="contacts: "):
            simulate(problem, torque, **options)
    with pytest.raises(InputError, match="contacts: "):
        verify(problem, torque, contacts="none")  # type: ignore[call-overload]
