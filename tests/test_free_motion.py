"""Motions with contacts that come and go, against closed forms."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad

from wholearm.common.arrays import Array
from wholearm.results.torque import TorqueProfile
from wholearm.scene.model import Scales
from wholearm.simulation.complementarity import FreeRun
from wholearm.simulation.events import EventKind
from wholearm.simulation.system import ContactPair, Structure, System

G = 9.81


def make_body(
    corners: Sequence[Sequence[float]],
    lines: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 1.0),),
    *,
    mu: float = 0.0,
    inertia: float = 1.0,
    mass: float = 1.0,
    weight: tuple[float, float] = (0.0, -G),
) -> System:
    """One body (x, y, phi), whose corners are given about its centroid.

    A line is given by its distance from the origin and its normal, which points to the body.
    """
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
        np.array([mass, mass, inertia]),
        mass * np.array([*weight, 0.0]),
        none,
        none,
        np.full(len(pairs), mu),
        Scales(np.sqrt(inertia / mass), mass, mass * G),
    )


def simulate(
    system: System, z: Sequence[float], v: Sequence[float], until: float, restitution: float = 0.0
) -> FreeRun:
    """Let a system go without torques."""
    torque = TorqueProfile(np.array([0.0, until]), np.zeros((1, 2, 1)))
    run = FreeRun(system, torque, np.array(z, float), np.array(v, float), restitution)
    run.play(1e-9 * system.scales.length)
    return run


def rotate(angle: float, points: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]), dtype=float)


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
    run = simulate(make_block(mu=0.5, slope=0.3), [0, 0.1, 0], [0, 0, 0], 10.0)
    assert run.resting and (run.z == [0, 0.1, 0]).all() and (run.v == 0).all()


def test_a_block_on_a_ramp_slides() -> None:
    mu, slope = 0.2, 0.3
    run = simulate(make_block(mu=mu, slope=slope), [0, 0.1, 0], [0, 0, 0], 1.0)
    a = G * (np.sin(slope) - mu * np.cos(slope))
    assert run.z == pytest.approx([a / 2, 0.1, 0], abs=CLOSE)
    # The forces balance the moment of friction about the centroid.
    total, moment = G * np.cos(slope), mu * G * np.cos(slope) * 0.1
    parts = [(total - moment / 0.1) / 2, (total + moment / 0.1) / 2]
    assert run.records[0].c_n == pytest.approx(parts, abs=CLOSE)
    assert measure_energy(run) == pytest.approx(0, abs=1e-9)


def test_a_block_on_a_ramp_tips() -> None:
    b, h, slope = 0.05, 0.2, 0.4
    run = simulate(make_block(b, h, 0.9, slope), [0, h, 0], [0, 0, 0], 0.1)
    inertia = (b**2 + h**2) * 4 / 3
    turn = -G * (h * np.sin(slope) - b * np.cos(slope)) / inertia
    first = run.records[0]
    assert first.acceleration[2] == pytest.approx(turn, rel=CLOSE)
    assert run.system.names[first.kept[0]] == "v1-line0" and len(first.kept) == 1
    assert measure_energy(run) == pytest.approx(0, abs=1e-9)


def test_a_sliding_block_comes_to_rest() -> None:
    run = simulate(make_block(mu=0.5), [0, 0.1, 0], [1, 0, 0], 1.0)
    assert list_times(run, EventKind.REST) == pytest.approx([1 / (0.5 * G)], abs=CLOSE)
    assert run.z[0] == pytest.approx(1 / G, abs=CLOSE) and run.resting


def test_a_ladder_leaves_the_wall() -> None:
    a, start = 0.5, np.pi - 1.1
    lines = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)]
    rod = make_body([(-a, 0), (a, 0)], lines, inertia=a**2 / 3)
    z = [-a * np.cos(start), a * np.sin(start), start]
    run = simulate(rod, z, [0, 0, 0], 0.7)
    lost = next(event for event in run.events if event.kind is EventKind.CONTACT_LOST)
    last = np.arcsin(2 / 3 * np.sin(start))
    # With elevation e: e'^2 = 3 g / (2 a) (sin e_0 - sin e); s^2 = e_0 - e takes the root away.
    e_0 = np.pi - start
    root = np.sqrt(1.5 * G / a)

    def slowness(s: float) -> float:
        e = e_0 - s * s
        return float(2 * s / (root * np.sqrt(np.sin(e_0) - np.sin(e)))) if s else 0.0

    time = quad(slowness, 0, np.sqrt(e_0 - last), epsabs=1e-12)[0]
    assert lost.contact == "v1-line1" and lost.time == pytest.approx(time, abs=CLOSE)
    there = next(record for record in run.records if record.t == lost.time)
    assert np.sin(there.y[2]) == pytest.approx(2 / 3 * np.sin(start), abs=CLOSE)
    assert measure_energy(run) == pytest.approx(0, abs=1e-8)


def test_a_corner_bounces() -> None:
    e, height = 0.6, 0.1
    body = make_body([(0.0, -0.1)], inertia=0.01)
    run = simulate(body, [0, 0.1 + height, 0], [0, 0, 0], 1.5, e)
    fall, speed = np.sqrt(2 * height / G), np.sqrt(2 * height * G)
    hits = [event for event in run.events if event.kind is EventKind.IMPACT]
    count = 12
    powers = e ** np.arange(1, count)
    times = fall + np.append(0, 2 * np.cumsum(powers) * speed / G)
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
    run = simulate(body, [0, 0.1, 0], [0.2, -1.0, 0.0], 1e-3, restitution)
    p = (1 + restitution) / (1 + 0.1**2 / 0.01)
    assert run.records[0].y[3:6] == pytest.approx([0.2, -1 + p, -0.1 * p / 0.01], abs=CLOSE)


@pytest.mark.parametrize(("enters", "lands"), [(0.006, True), (0.018, False)])
def test_a_corner_that_rises_past_the_end_of_a_table(enters: float, lands: bool) -> None:
    # Its level is passed upwards at 0.003 and downwards at 0.015 of the unit of time, and the end
    # of the table at `enters`: onto the table, or beneath it.
    system = make_body([(0.0, 0.0)])
    (pair,), z = system.structure.pairs, system.structure.z
    pairs = (dataclasses.replace(pair, ranges=(z[0],)),)
    system = dataclasses.replace(
        system, structure=dataclasses.replace(system.structure, pairs=pairs)
    )
    unit = system.scales.time
    up, down, speed = 0.003 * unit, 0.015 * unit, 1 / unit
    start = [-speed * enters * unit, -G * up * down / 2, 0.0]
    run = simulate(system, start, [speed, G * (up + down) / 2, 0.0], 0.04 * unit)
    impacts = list_times(run, EventKind.IMPACT)
    assert impacts == pytest.approx([down] if lands else [], rel=1e-6)
    fallen = start[1] + G * (up + down) / 2 * run.t - G * run.t**2 / 2
    assert run.z[1] == pytest.approx(0.0 if lands else fallen, abs=1e-10)


def test_a_block_falls_flat() -> None:
    mu, drop = 0.3, 0.1
    run = simulate(make_block(mu=mu), [0, 0.1 + drop, 0], [1, 0, 0], 0.15)
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
    run = simulate(make_block(b, h, 2.0), [b - corner[0], -corner[1], tilt], [0, 0, 0], 3.0)
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
        mu = share * limit
        self.reduced = 1 + 3 * np.cos(phi) ** 2 - 3 * mu * np.sin(phi) * np.cos(phi)
        self.system = make_body([(-a, 0), (a, 0)], mu=mu, inertia=a**2 / 3)
        r = -a * np.array([np.cos(phi), np.sin(phi)])
        self.rows = np.array([[0, 1, r[0]], [1, 0, -r[1]]])
        self.z = [-r[0], -r[1], phi]
        self.v = [slide + turn * r[1], -turn * r[0], turn]
        self.falls = -G + a * np.sin(phi) * turn**2
        self.run = simulate(self.system, self.z, self.v, 0.01)


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
