"""Motions with contacts that come and go: hand and object, drops, throws and closed forms."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad

from plane import finger_gap, make_finger, make_scene, rotate
from planned import change, plan
from rows import each
from shipped import HEXAGON, text_of
from wholearm import Formation, Problem, TorqueProfile, Trajectory, simulate, simulate_free, verify
from wholearm.analysis.robustness import change_problem
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError, SimulationError
from wholearm.contacts.contact_limits import measure_gaps
from wholearm.contacts.elemental import ContactPair, parse_contact
from wholearm.problem.definition import Until
from wholearm.problem.read import read_problem
from wholearm.results.dwell_record import assemble
from wholearm.scene.model import Friction, Polygon, Scales, Scene
from wholearm.simulation.complementarity import FreeRun
from wholearm.simulation.events import EventKind, OutcomeKind, Simulation
from wholearm.simulation.system import Structure, System, build_system
from wholearm.verification.free import verify_free


def throw(seed: int) -> Simulation:
    """A random object that is thrown into a hand, which moves by random torques."""
    rng = np.random.default_rng([17, seed])
    count, size = int(rng.integers(3, 8)), 0.05
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    corners = size * np.column_stack([np.cos(angles), rng.uniform(0.4, 1.0) * np.sin(angles)])
    radius = float(rng.choice([0.0, 0.005]))
    fingers = []
    for side in (1.0, -1.0):
        link = make_finger([side * rng.uniform(0.07, 0.12), -0.01], rng.uniform(0.1, 0.2), radius)
        inertia, viscous = rng.uniform(1e-4, 5e-3), rng.choice([0.0, 0.01])
        drag = {"viscous": viscous, "dry": rng.choice([0.0, 0.02])}
        fingers.append(dataclasses.replace(link, inertia=inertia, **drag))
    mu = rng.uniform(0, 1, 3) * rng.choice([0.0, 1.0], p=[0.2, 0.8])
    scene = Scene(Polygon(corners, 0.2), (fingers[0], fingers[1]), Friction(*mu.tolist()))
    z = np.zeros(5)
    while measure_gaps(scene, z[None]).min() < 1e-3:
        turn = rng.uniform(-np.pi, np.pi)
        z[:3] = rng.uniform(-0.05, 0.05), rng.uniform(0.05, 0.25), turn
        z[3:] = rng.uniform(0, np.pi / 2), rng.uniform(np.pi / 2, np.pi)
    v = rng.choice([0.0, 1.0]) * rng.normal(size=5) * [0.5, 0.5, 5.0, 3.0, 3.0]
    coefficients = rng.normal(size=(4, 2, 2)) * rng.choice([0.0, 0.05, 0.5])
    torque = TorqueProfile(np.linspace(0, 0.4, 5), coefficients)
    problem = Problem("random", scene, 0.05, z, (), checked=True)
    restitution = rng.choice([0.0, rng.uniform(0, 0.9)])
    return simulate_free(problem, torque, start=np.append(z, v), restitution=float(restitution))


@each("name", ["v0-palm", "v1-finger1", "v3-finger2", "e0-tip1", "v2-tip2"])
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
        assert rows.A_dot_v == pytest.approx(known.P_dot_v[0], abs=1e-9)


def pinch(torque: float, until: float = 10.0) -> tuple[Problem, TorqueProfile, Array]:
    """A square between two upright links, pressed by the same torque of both."""
    scene = make_scene(base=0.035, friction=0.6)
    right, left = (dataclasses.replace(link, dry=0.0) for link in scene.fingers)
    scene = dataclasses.replace(scene, fingers=(right, left))
    z = np.array([0, 0.08, 0, np.pi / 2, np.pi / 2])
    problem = Problem("pinch", scene, 0.05, z, (), checked=True)
    profile = TorqueProfile(np.array([0, until]), np.array([[[torque], [-torque]]]))
    return problem, profile, z


def test_a_pinched_square_does_not_creep_and_bad_calls_are_told() -> None:
    problem, torque, z = pinch(0.3)
    # A short piece means nothing beyond its end.
    coefficients = np.tile(torque.coefficients * [1.0, 0.0, 0.0], (2, 1, 1))
    coefficients[0] += np.outer([1.0, -1.0], [0.02, 0.0, -0.02])
    run = simulate_free(problem, TorqueProfile(np.array([0.0, 1e-7, 10.0]), coefficients))
    assert (run.z == run.z[0]).all() and run.z[0] == pytest.approx(z, abs=1e-13)
    assert (run.z_dot == 0).all() and [event.kind for event in run.events] == [EventKind.REST]
    with pytest.raises(SimulationError, match=r"finger 1 and object overlap by 0\.01 m at"):
        simulate_free(problem, torque, start=z + np.array([0.01, 0, 0, 0, 0]))
    assert measure_gaps(problem.scene, z[None])[0, :3] == pytest.approx([0.05, 0, 0], abs=1e-13)
    opens_2_ns = TorqueProfile(np.array([0, 4e-9, 10]), torque.coefficients * [[[0, 1]], [[1, 0]]])
    free = simulate(problem, opens_2_ns, contacts="free", times=[0.0123])
    assert 0.0123 in free.t and run.t[-1] == free.t[-1] == 10.0 and not (free.c_n < -1e-9).any()
    assert free.z[-1] == pytest.approx(run.z[-1], abs=1e-9)
    for options in ({"contacts": "none"}, {"until": 1.0}, {"restitution": 0.5}):
        with pytest.raises(InputError, match="contacts: "):
            simulate(problem, torque, **options)
    with pytest.raises(InputError, match="contacts: "):
        verify(problem, torque, contacts="none")  # type: ignore[call-overload]


def test_a_square_slips_when_no_friction_can_hold_it_any_more() -> None:
    # The lower corners, 0.06 m above the joints, need the least torque: tau = N (0.06 - mu radius).
    falling = TorqueProfile(np.array([0.0, 1.0]), np.array([[[0.15, -0.15], [-0.15, 0.15]]]))
    run = simulate_free(pinch(0.3)[0], falling)
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
    scene = make_scene(base=0.4, radius=0.0, friction=0.5)
    right, left = (dataclasses.replace(link, viscous=0.0, dry=0.0) for link in scene.fingers)
    scene = dataclasses.replace(scene, fingers=(right, left))
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
    run = throw(seed)
    assert run.outcome.kind is OutcomeKind.ENDED and run.residual < 1e-9
    # Relative to all that has moved: no energy is gained over what torques did, or unexplained.
    scene, energies = run.problem.scene, run.energies
    kinetic, left = 0.5 * run.z_dot**2 @ scene.mass_diagonal, energies.stored - energies.work
    size = kinetic.max() + np.abs(energies.stored).max() + np.abs(energies.work).max()
    assert (left - np.minimum.accumulate(left)).max() < 1e-8 * size
    assert np.abs(energies.residual).max() < 1e-8 * size
    assert measure_gaps(scene, run.z).min() > -1e-7 * scene.scales.length
    # Other distances, of polygon and segments.
    for finger in range(2):
        q, theta = run.z[::5, :3], run.z[::5, 3 + finger]
        assert finger_gap(scene, q, finger, theta).min() > -1e-7 * scene.scales.length


# Numbers that are off, such that v0 lies below the axis of finger 2: its friction hardly moves it.
OFF = {
    "mass": 0.04954921725667493,
    "inertia": -0.03358845955228069,
    "friction_palm": -0.05438621560806402,
    "friction_finger1": 0.04820953282327903,
    "friction_finger2": -0.049136296652815076,
    "length1": 0.00018225657429398688,
    "length2": 4.532351929343127e-05,
    "base1_x": 0.00012528732080879893,
    "base1_y": -0.00011009683704380386,
    "base2_x": 8.932094753683843e-05,
    "base2_y": -4.287934383110149e-06,
}


@each(
    "changes, z, tau",
    [
        (
            {},
            [-0.055000127022182474, 0.0433, 0.0, 2.386803231534441, 2.0944078045648657],
            [0.14447658672160446, 0.006945556702579097],
        ),
        (
            OFF,
            [-0.054913873987137894, 0.0433, 0.0, 2.386438150818862, 2.09446698926046],
            [0.19326743653792794, 0.005039590912552442],
        ),
    ],
)
def test_what_is_held_at_the_limit_of_friction_rests(
    changes: Mapping[str, float], z: list[float], tau: list[float]
) -> None:
    # Five contacts and two joints give way at once, so that forces are redundant, and none is left.
    problem = change_problem(read_problem(str(HEXAGON)), changes)
    rng = np.random.default_rng(0)
    for _ in range(6):
        near = np.array(tau) * (1 + 1e-15 * rng.normal(size=2))
        profile = TorqueProfile(np.array([0.0, 0.002]), near.reshape(1, 2, 1))
        run = simulate_free(problem, profile, start=np.array(z) + 1e-16 * rng.normal(size=5))
        assert run.outcome.kind is OutcomeKind.ENDED and run.residual < 1e-9
        assert run.z[-1] == pytest.approx(z, abs=1e-12)


@lru_cache
def begin() -> tuple[Problem, Trajectory]:
    """The first two phases of a plan."""
    problem, trajectory = plan(pieces=12)
    torque = trajectory.torque.cut(0.0, 0.8)
    two = dataclasses.replace(problem, phases=problem.phases[:2])
    meta = {"epsilon": problem.epsilon, "problem": two.table}
    return two, assemble(list(trajectory.motions[:2]), torque, meta, 201)


def test_phases_of_a_plan_are_as_told_contact_by_contact() -> None:
    problem, trajectory = begin()
    report = verify_free(problem, trajectory, progress=(told := list[str]()).append)
    assert told == ["simulating the whole", *(f"simulating phase {k} of 2" for k in (1, 2))]
    assert report.ok and report.exit_status == 0 and len(report.alone) == 2
    for phase in report.alone:
        assert phase.reached and phase.losses == () and phase.deviation is not None
        # The interpolated torques are good to about 1e-11.
        assert phase.deviation.position < 1e-9 and phase.deviation.angle < 1e-9
    text, plain = report.to_text(), json.loads(json.dumps(report.to_dict()))
    assert text.startswith("heptagon, four contacts: ok: from its planned start each phase keeps")
    assert plain["ok"] and len(plain["events"]) == len(report.whole.events)
    names = {row["contact"] for row in plain["contacts"]}
    assert names >= set(report.whole.problem.phases[0].formation.names)
    assert report.whole.stretches[0].start == 0.0 and report.whole.stretches[0].least > 0
    slow = problem.with_({"speed_limit": 0.1})
    assert "speed limit of finger 1 = 0.1 rad/s" in verify_free(slow, trajectory).reason


def test_torques_alone_are_followed_by_what_happens() -> None:
    problem, trajectory = begin()
    turned = change(trajectory.torque, lambda t, c: np.where(t[:, None, None] > 0.2, -c, c))
    report = verify_free(problem, turned)
    assert not report.ok and report.exit_status == 1 and report.alone == ()
    assert report.phases[0].losses and report.phases[0].losses[0].time > 0.2
    # The simulation goes on after the first loss.
    assert report.whole.t[-1] == pytest.approx(0.8)
    assert report.whole.outcome.kind is OutcomeKind.ENDED
    x, length = trajectory.z[trajectory.phase == 0][-1, 0], problem.scene.scales.length
    for until, reason in (
        # A phase also ends where it rests a little short of its end.
        (Until(None, "x", x - 5e-4 * length), "every contact holds, and 2 phases end"),
        (Until(None, "x", x - 2e-3 * length), "v2-finger1 is lost at t = 0.4 s, phase 1"),
        (Until(None, "x", -1), "phase 1 does not end: x = -1 m is not reached; nearest, at"),
        (Until(None, "phi", 0.01, (("x", x),)), "phase 1 ends at x = "),
    ):
        phases = dataclasses.replace(problem.phases[0], until=until), problem.phases[1]
        free = verify_free(dataclasses.replace(problem, phases=phases), trajectory.torque)
        assert any(text.startswith(reason) for text in (free.reason, *free.failures)), reason
        assert int(free.trajectory.phase[-1]) == len(free.phases) - 1


@each(
    "options, message",
    [
        ({"restitution": 1.5}, "restitution: 1.5 given; allowed are 0 to 1"),
        ({"until": 0.0}, "until"),
        ({"start": [1.0, 2.0]}, "5 or 10 finite numbers are needed"),
        ({"tolerance": 1.0}, "tolerance: 1.0 given; allowed"),
    ],
)
def test_numbers_out_of_range(options: dict[str, object], message: str) -> None:
    problem, torque, _ = pinch(0.3)
    with pytest.raises(InputError, match=message):
        simulate_free(problem, torque, **options)


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, trajectory = begin()
    given, written, figure = (str(tmp_path / name) for name in ("a.npz", "b.npz", "c.png"))
    trajectory.save(given)
    path = str(tmp_path / "two.toml")
    Path(path).write_text(text_of(phases=2), encoding="utf-8")
    assert main(["verify", path, given, "--free", "-o", written]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0].startswith("heptagon, four contacts: ok: ")
    assert f"wrote {written}" in out and "the whole from the start, by the clock" in out
    assert main(["plot", written, "--simulate", "free", "-o", figure]) == 0
    assert Path(figure).stat().st_size > 10_000
    for options in ("--reduced --free", "--restitution 0", "--uniqueness-margin 0 --free"):
        assert main(["verify", path, given, *options.split()]) == 2


G = 9.81


def make_body(
    corners: Sequence[Sequence[float]],
    lines: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 1.0),),
    *,
    mu: float = 0.0,
    inertia: float = 1.0,
    weight: tuple[float, float] = (0.0, -G),
) -> System:
    """One body (x, y, phi) of 1 kg, whose corners are given about its centroid."""
    # A line is given by its distance from the origin and its normal, which points to the body.
    z = ca.SX.sym("z", 3)
    c, s = ca.cos(z[2]), ca.sin(z[2])
    pairs = []
    for k, (distance, nx, ny) in enumerate(lines):
        for i, (a, b) in enumerate(corners):
            x, y = z[0] + c * a - s * b, z[1] + s * a + c * b
            gap, slip = nx * x + ny * y - distance, ny * x - nx * y
            pairs.append(ContactPair(f"v{i}-line{k}", gap, slip))
    none = np.zeros(3)
    structure = Structure(z, ca.SX.sym("geometry", 0), tuple(pairs), (), (False, False, True))
    return System(
        structure,
        np.zeros(0),
        np.array([1.0, 1.0, inertia]),
        np.array([*weight, 0.0]),
        none,
        none,
        np.full(len(pairs), mu),
        Scales.of(np.sqrt(inertia), 1.0, G),
    )


def simulate_body(
    system: System, z: Sequence[float], v: Sequence[float], until: float, restitution: float = 0.0
) -> FreeRun:
    """Let a system go without torques."""
    torque = TorqueProfile(np.array([0.0, until]), np.zeros((1, 2, 1)))
    run = FreeRun(system, torque, np.array(z, float), np.array(v, float), restitution=restitution)
    run.play(1e-9 * system.scales.length)
    return run


def measure_energy(run: FreeRun) -> float:
    """What the balance of energy leaves at the end, over the sum of all that is in it."""
    first, last, n = run.records[0].y, run.records[-1].y, run.system.n
    impact = run.records[-1].impact - run.records[0].impact
    work, *losses = last[2 * n :] - first[2 * n :]
    kinetic = (last[n : 2 * n] ** 2 - first[n : 2 * n] ** 2) @ run.system.mass / 2
    potential = (first[:n] - last[:n]) @ run.system.applied
    terms = np.array([work, -kinetic, -potential, -impact, *(-loss for loss in losses)])
    return float(terms.sum() / (np.abs(terms).sum() or 1.0))


CLOSE = 1e-8


def make_block(b: float = 0.1, h: float = 0.1, mu: float = 0.3, slope: float = 0.0) -> System:
    """A block of width 2 b and height 2 h on a ramp that goes down to the right."""
    corners = [(-b, -h), (b, -h), (b, h), (-b, h)]
    weight = (G * np.sin(slope), -G * np.cos(slope))
    return make_body(corners, mu=mu, inertia=(b**2 + h**2) / 3, weight=weight)


def list_times(run: FreeRun, kind: EventKind) -> Array:
    return np.array([event.time for event in run.events if event.kind is kind])


def test_a_block_on_a_ramp_stays() -> None:
    run = simulate_body(make_block(mu=0.5, slope=0.3), [0, 0.1, 0], [0, 0, 0], 10.0)
    assert run.resting and (run.z == [0, 0.1, 0]).all() and (run.v == 0).all()


def test_a_block_on_a_ramp_slides() -> None:
    mu, slope = 0.2, 0.3
    run = simulate_body(make_block(mu=mu, slope=slope), [0, 0.1, 0], [0, 0, 0], 1.0)
    a = G * (np.sin(slope) - mu * np.cos(slope))
    assert run.z == pytest.approx([a / 2, 0.1, 0], abs=CLOSE)
    # The forces balance the moment of friction about the centroid.
    total, moment = G * np.cos(slope), mu * G * np.cos(slope) * 0.1
    parts = [(total - moment / 0.1) / 2, (total + moment / 0.1) / 2]
    assert run.records[0].c_n == pytest.approx(parts, abs=CLOSE)
    assert measure_energy(run) == pytest.approx(0, abs=1e-9)


def test_a_block_on_a_ramp_tips() -> None:
    b, h, slope = 0.05, 0.2, 0.4
    run = simulate_body(make_block(b, h, 0.9, slope), [0, h, 0], [0, 0, 0], 0.1)
    inertia = (b**2 + h**2) * 4 / 3
    turn = -G * (h * np.sin(slope) - b * np.cos(slope)) / inertia
    first = run.records[0]
    assert first.acceleration[2] == pytest.approx(turn, rel=CLOSE)
    assert run.system.names[first.kept[0]] == "v1-line0" and len(first.kept) == 1
    assert measure_energy(run) == pytest.approx(0, abs=1e-9)


def test_a_sliding_block_comes_to_rest() -> None:
    run = simulate_body(make_block(mu=0.5), [0, 0.1, 0], [1, 0, 0], 1.0)
    assert list_times(run, EventKind.REST) == pytest.approx([1 / (0.5 * G)], abs=CLOSE)
    assert run.z[0] == pytest.approx(1 / G, abs=CLOSE) and run.resting


def test_a_ladder_leaves_the_wall() -> None:
    a, start = 0.5, np.pi - 1.1
    lines = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)]
    rod = make_body([(-a, 0), (a, 0)], lines, inertia=a**2 / 3)
    z = [-a * np.cos(start), a * np.sin(start), start]
    run = simulate_body(rod, z, [0, 0, 0], 0.7)
    lost = next(event for event in run.events if event.kind is EventKind.CONTACT_LOST)
    last = np.arcsin(2 / 3 * np.sin(start))
    # With elevation e: e'^2 = 3 g / (2 a) (sin e_0 - sin e); s^2 = e_0 - e takes the root away.
    e_0 = np.pi - start

    def slowness(s: float) -> float:
        fall = np.sin(e_0) - np.sin(e_0 - s * s)
        return float(2 * s / np.sqrt(1.5 * G / a * fall)) if s else 0.0

    time = quad(slowness, 0, np.sqrt(e_0 - last), epsabs=1e-12)[0]
    assert lost.contact == "v1-line1" and lost.time == pytest.approx(time, abs=CLOSE)
    there = next(record for record in run.records if record.t == lost.time)
    assert np.sin(there.y[2]) == pytest.approx(2 / 3 * np.sin(start), abs=CLOSE)
    assert measure_energy(run) == pytest.approx(0, abs=1e-8)


def test_a_corner_bounces() -> None:
    e, height = 0.6, 0.1
    body = make_body([(0.0, -0.1)], inertia=0.01)
    run = simulate_body(body, [0, 0.1 + height, 0], [0, 0, 0], 1.5, e)
    fall, speed = np.sqrt(2 * height / G), np.sqrt(2 * height * G)
    hits = [event for event in run.events if event.kind is EventKind.IMPACT]
    count = 12
    times = fall + np.append(0, 2 * np.cumsum(e ** np.arange(1, count)) * speed / G)
    assert [hit.time for hit in hits[:count]] == pytest.approx(times, abs=CLOSE)
    speeds = [hit.value for hit in hits[:count]]
    assert speeds == pytest.approx(speed * e ** np.arange(count), abs=CLOSE)
    # The impacts never end, but come to an end: Zeno.
    end = fall + 2 * speed / G * e / (1 - e)
    assert run.events[-1].time == pytest.approx(end, abs=1e-6)
    assert run.v == pytest.approx(np.zeros(3), abs=1e-12) and run.t == 1.5
    assert measure_energy(run) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("restitution", [0.0, 0.7])
def test_a_corner_that_strikes_off_its_centroid(restitution: float) -> None:
    body = make_body([(-0.1, -0.1)], inertia=0.01)
    run = simulate_body(body, [0, 0.1, 0], [0.2, -1.0, 0.0], 1e-3, restitution)
    p = (1 + restitution) / (1 + 0.1**2 / 0.01)
    assert run.records[0].y[3:6] == pytest.approx([0.2, -1 + p, -0.1 * p / 0.01], abs=CLOSE)
    # Torques are held from where they step: the polynomial ends with a piece of 1 ns.
    pieces = np.repeat([[[1.0, 0.1, 0.1]], [[5.0, 0.0, 0.0]]], 2, axis=1)
    run = FreeRun(body, TorqueProfile(np.array([0.0, 1e-9, 1.0]), pieces), run.z, run.v)
    assert run.tau(1e-6) == pytest.approx([1.2, 1.2])


@pytest.mark.parametrize(("enters", "lands"), [(0.006, True), (0.018, False)])
def test_a_corner_that_rises_past_the_end_of_a_table(enters: float, lands: bool) -> None:
    # Its level is passed upwards at 0.003 and downwards at 0.015 of the unit of time, and the end
    # of the table at `enters`: onto the table, or beneath it.
    system = make_body([(0.0, 0.0)])
    (pair,), z = system.structure.pairs, system.structure.z
    pairs = (pair._replace(ranges=(z[0],)),)
    structure = dataclasses.replace(system.structure, pairs=pairs)
    system = dataclasses.replace(system, structure=structure)
    unit = system.scales.time
    up, down, speed = 0.003 * unit, 0.015 * unit, 1 / unit
    start = [-speed * enters * unit, -G * up * down / 2, 0.0]
    run = simulate_body(system, start, [speed, G * (up + down) / 2, 0.0], 0.04 * unit)
    impacts = list_times(run, EventKind.IMPACT)
    assert impacts == pytest.approx([down] if lands else [], rel=1e-6)
    fallen = start[1] + G * (up + down) / 2 * run.t - G * run.t**2 / 2
    assert run.z[1] == pytest.approx(0.0 if lands else fallen, abs=1e-10)


def test_a_block_falls_flat() -> None:
    mu, drop = 0.3, 0.1
    run = simulate_body(make_block(mu=mu), [0, 0.1 + drop, 0], [1, 0, 0], 0.15)
    hits = [event for event in run.events if event.kind is EventKind.IMPACT]
    assert [hit.contact for hit in hits] == ["v0-line0", "v1-line0"]
    time, speed = np.sqrt(2 * drop / G), np.sqrt(2 * drop * G)
    assert [hit.time for hit in hits] == pytest.approx([time, time], abs=CLOSE)
    # Friction takes mu times as much from the sliding as the floor takes from the fall.
    left, rest = 1 - mu * speed, 0.15 - time
    assert run.v == pytest.approx([left - mu * G * rest, 0, 0], abs=CLOSE)
    assert run.z[1:] == pytest.approx([0.1, 0], abs=CLOSE)
    assert measure_energy(run) == pytest.approx(0, abs=1e-9)


def test_a_rocking_block_loses_what_housner_says() -> None:
    b, h, tilt = 0.1, 0.3, -0.1
    corner = rotate(tilt, np.array([[b, -h]]))[0]
    run = simulate_body(make_block(b, h, 2.0), [b - corner[0], -corner[1], tilt], [0, 0, 0], 3.0)
    hits = [event for event in run.events if event.kind is EventKind.IMPACT]
    speeds = np.array([hit.value for hit in hits])
    # A corner comes down with the width times the turning, which its energy gives.
    drop = -corner[1] - h
    inertia = (b**2 + h**2) * 4 / 3
    assert speeds[0] == pytest.approx(2 * b * np.sqrt(2 * G * drop / inertia), abs=CLOSE)
    ratio = 1 - 1.5 * b**2 / (b**2 + h**2)
    assert speeds[1:10] == pytest.approx(ratio * speeds[:9], abs=CLOSE)
    assert run.resting and run.events[-1].kind is EventKind.REST
    assert measure_energy(run) == pytest.approx(0, abs=1e-9)


class Rod:
    """A rod of length 2 a, whose lower end slides to the left; Painleve's."""

    def __init__(self, share: float, turn: float = 0.0) -> None:
        a, phi, slide = 0.5, 1.1, -3.0
        limit = (1 + 3 * np.cos(phi) ** 2) / (3 * np.sin(phi) * np.cos(phi))
        self.reduced = (1 + 3 * np.cos(phi) ** 2) * (1 - share)
        self.system = make_body([(-a, 0), (a, 0)], mu=share * limit, inertia=a**2 / 3)
        r = -a * np.array([np.cos(phi), np.sin(phi)])
        self.rows = np.array([[0, 1, r[0]], [1, 0, -r[1]]])
        self.v = [slide + turn * r[1], -turn * r[0], turn]
        self.falls = -G + a * np.sin(phi) * turn**2
        self.run = simulate_body(self.system, [*-r, phi], self.v, 0.01)


def test_a_rod_just_below_the_painleve_limit() -> None:
    rod = Rod(0.99)
    assert rod.run.records[0].c_n == pytest.approx([-rod.falls / rod.reduced], rel=CLOSE)
    assert measure_energy(rod.run) == pytest.approx(0, abs=1e-8)


def test_a_rod_beyond_the_painleve_limit_is_hit_without_a_collision() -> None:
    rod = Rod(1.2)
    assert [event.kind for event in rod.run.events[:1]] == [EventKind.INCONSISTENT]
    lift = rod.rows.T / rod.system.mass[:, None]
    stuck = rod.v - lift @ np.linalg.solve(rod.rows @ lift, rod.rows @ rod.v)
    assert rod.run.records[0].y[3:6] == pytest.approx(stuck, abs=CLOSE)


def test_a_rod_with_two_motions_says_so() -> None:
    rod = Rod(1.2, turn=6.0)
    assert rod.falls > 0 > rod.reduced
    assert [event.kind for event in rod.run.events] == [EventKind.AMBIGUOUS]
    assert "v0-line0 parts; or v0-line0 presses" in rod.run.events[0].text
    # Nothing pressed before, so that it goes on apart.
    assert rod.run.v[1] == pytest.approx(rod.v[1] - G * 0.01, abs=CLOSE)
