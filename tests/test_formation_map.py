"""Maps of formations, straight paths through cells, borders that are passed, and traced curves."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog

import plane
import shipped
from once import once
from retelling import Retelling
from scenes import hexagon, measure_fingers
from shipped import HEPTAGON, IMPACTS, LANDING, problem_of, solved, text_of
from wholearm import End, Formation, Goal, InputError, Problem, Scene, Until, list_formations
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.contacts.closing import close_finger, close_fingers, contact_table, first_contact
from wholearm.contacts.contact_limits import FINGERS_TOUCH, build_finger_gap, evaluate_finger_gap
from wholearm.contacts.elemental import build_features, parse_contact
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_curve, trace_phases
from wholearm.mapping.borders import NOWHERE, Window, label_cells
from wholearm.mapping.formation_map import (
    CROSSED,
    Border,
    FormationMap,
    build_map,
    choose_window,
    time_borders,
)
from wholearm.mechanics.speed_sweep import NoMotionError
from wholearm.planning.lower_bound import sweep_time
from wholearm.problem.read import read_problem
from wholearm.scene.model import Finger
from wholearm.search.edges import Edge
from wholearm.search.places import is_at, make_place
from wholearm.search.roadmap import Roadmap

TABLE = tomllib.loads(HEPTAGON.read_text(encoding="utf-8"))
WINDOW = Window((-0.16, 0.16), (np.radians(-75.0), np.radians(30.0)))


@once
def map_pointed() -> FormationMap:
    """Short pointed fingers: tips reach edges, and much of the plane is out of reach."""
    problem = problem_of(HEPTAGON).with_(radius=0.0, length=0.12)
    return build_map(problem, resolution=30, window=WINDOW)


@pytest.fixture(scope="module", params=[shipped.chart, map_pointed])
def every(request: pytest.FixtureRequest) -> FormationMap:
    chart: FormationMap = request.param()
    return chart


def gaps(scene: Scene, border_contacts: Any, z: Array) -> Array:
    return Formation(scene, tuple(border_contacts)).evaluate(z, np.zeros_like(z)).C


def distance_to(borders: list[Border], points: Array) -> Array:
    """Distance of points (x, phi) from the nearest of some borders, phi weighed by 0.05 m."""
    scale = np.array([1.0, 0.05])
    starts = np.concatenate([b.points[:-1] for b in borders]) * scale
    ends = np.concatenate([b.points[1:] for b in borders]) * scale
    return np.array([plane.point_to_segment(p * scale, starts, ends).min() for p in points])


@pytest.mark.parametrize("radius", [0.005, 0.0])
def test_closing_many_agrees_with_closing_one(radius: float) -> None:
    points = np.asarray(TABLE["object"]["vertices"])
    # Joints above the palm, so that they get into the object too.
    scene = plane.make_scene(points, base=0.06, depth=0.01, length=0.1, radius=radius)
    rng = np.random.default_rng(1)
    x, phi = rng.uniform(-0.2, 0.2, 50), rng.uniform(-4.0, 4.0, 50)
    closed = close_fingers(scene, x, phi)
    seen = set()
    for row in range(len(x)):
        for finger in (0, 1):
            angle, obstacle = closed.z[row, 3 + finger], int(closed.obstacle[row, finger])
            seen.add(obstacle)
            if obstacle:
                words = {1: "too short", 2: "inside the object"}[obstacle]
                with pytest.raises(InputError, match=words):
                    close_finger(scene, closed.z[row, :3], finger)
                assert np.isnan(angle) and closed.contacts[row, finger] == -1
                continue
            assert close_finger(scene, closed.z[row, :3], finger) == pytest.approx(angle, abs=1e-12)
            # asin and acos lose half the digits where a vertex is at the joint or the reach ends.
            assert plane.is_first_touch(scene, closed.z[row, :3], finger, angle, 1e-9, 300)
            contact = contact_table(scene)[closed.contacts[row, finger]]
            assert contact.finger == finger
            assert abs(gaps(scene, [contact], closed.z[[row]])[0, 0]) < 1e-9
    assert seen == {0, 1, 2}
    assert contact_table(scene)[first_contact(scene, 1)].name == "v0-finger2"


@pytest.mark.parametrize("radius", [0.02, 0.005, 0.0])
def test_closing_on_many_vertices_finds_the_first_of_them(radius: float) -> None:
    """Only neighbours of one vertex are looked at; some links end at an edge or a vertex."""
    rng, angles = np.random.default_rng(2), np.linspace(0, math.tau, 40, endpoint=False)
    seen = set()
    for flatness, length in ((1.0, 0.18), (0.3, 0.06), (0.15, 0.1)):
        points = 0.05 * np.column_stack([np.cos(angles), flatness * np.sin(angles)])
        scene = plane.make_scene(points, base=0.06, depth=-0.012, length=length, radius=radius)
        x, phi = rng.uniform(-0.12, 0.12, 20), rng.uniform(-4.0, 4.0, 20)
        closed = close_fingers(scene, x, phi)
        for row, finger in np.argwhere(closed.obstacle == 0):
            z = closed.z[row]
            assert plane.is_first_touch(scene, z[:3], finger, z[3 + finger], 1e-9, 300)
            contact = contact_table(scene)[closed.contacts[row, finger]]
            assert abs(gaps(scene, [contact], z[None])[0, 0]) < 1e-9
            seen.add((contact.feature, contact.surface))
    assert seen >= {("v", "finger"), ("e", "tip")}


def test_configurations_of_cells_touch_without_overlap(every: FormationMap) -> None:
    scene = every.problem.scene
    rng = np.random.default_rng(2)
    rows, columns = np.nonzero(every.cell >= 0)
    chosen = rng.choice(len(rows), 200, replace=False)
    rows, columns = rows[chosen], columns[chosen]
    z = close_fingers(scene, every.x[columns], every.phi[rows]).z
    lowest = plane.place_corners(scene, z)[..., 1].min(axis=1)
    np.testing.assert_allclose(lowest, 0.0, rtol=0, atol=1e-13)
    for finger in (0, 1):
        # Distances of polygon and segment in plain geometry; rounding only.
        assert np.abs(plane.finger_gap(scene, z[:, :3], finger, z[:, 3 + finger])).max() < 1e-10
    cells = every.cell[rows, columns]
    for cell in np.unique(cells):
        contacts = every.formations[cell]
        assert len(contacts) == 3
        assert np.abs(gaps(scene, contacts, z[cells == cell])).max() < 1e-10


def test_cells_that_cannot_be_reached_say_why(every: FormationMap) -> None:
    scene = every.problem.scene
    codes = set(np.unique(every.cell[every.cell < 0]).tolist())
    assert codes == {-1, -2}
    for code in codes:
        row, column = np.argwhere(every.cell == code)[0]
        z = close_fingers(scene, every.x[[column]], every.phi[[row]]).z[0]
        angles = np.linspace(-np.pi, np.pi, 500)
        # Wherever the finger turns, it stays off the object.
        assert plane.finger_gap(scene, z[:3], -code - 1, angles).min() > 0


def test_borders_have_four_contacts_and_edges_flush_on_palm_or_link(every: FormationMap) -> None:
    scene = every.problem.scene
    for border in every.borders:
        assert len(border.contacts) == 4
        assert np.abs(gaps(scene, border.contacts, border.z)).max() < 1e-9
        np.testing.assert_array_equal(border.z[:, [0, 2]], border.points)
        coordinate = border.points[:, 0 if border.along == "x" else 1]
        assert (np.diff(coordinate) > 0).all()
        if border.flush is None:
            assert not border.forth.any() and not border.back.any()
            continue
        finger, edge = border.flush
        for z in border.z[[0, len(border.z) // 2]]:
            corners = plane.place_corners(scene, z)
            run = np.roll(corners, -1, axis=0)[edge] - corners[edge]
            heading = 0.0 if finger is None else z[3 + finger]
            across = run @ np.array([-np.sin(heading), np.cos(heading)])
            assert abs(across) < 1e-9
    # Crossings have five.
    assert sum(len(crossing.flush) >= 2 for crossing in every.crossings) > 5
    for crossing in every.crossings:
        assert len(crossing.contacts) >= 5
        assert np.abs(gaps(scene, crossing.contacts, crossing.z[None])).max() < 1e-9


def test_every_change_of_cell_is_a_border(every: FormationMap) -> None:
    """Between neighbours of a fine grid that differ, bisection ends on a border."""
    scene = every.problem.scene
    rng = np.random.default_rng(3)
    size = np.array([every.x[-1] - every.x[0], every.phi[-1] - every.phi[0]])
    starts = np.array([every.x[0], every.phi[0]]) + rng.uniform(0.02, 0.98, (1500, 2)) * size
    stops = starts + rng.uniform(-0.02, 0.02, (1500, 2)) * size
    first, last = (label_cells(scene, points) for points in (starts, stops))
    both = (first[:, 0] != NOWHERE) & (last[:, 0] != NOWHERE) & (first != last).any(axis=1)
    assert both.sum() > 60
    low, high, first = starts[both], stops[both], first[both]
    for _ in range(50):
        middle = (low + high) / 2
        labels = label_cells(scene, middle)
        same = (labels == first).all(axis=1)[:, None]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    found = label_cells(scene, high)[:, 0] != NOWHERE
    # Borders are drawn with chords of at most 2 mm or 0.01 rad on curves of radius 50 mm or more.
    assert distance_to(list(every.borders), low[found]).max() < 2e-5


def test_plan_runs_along_borders(chart: FormationMap, curves: tuple[Curve, ...]) -> None:
    for curve in curves:
        contacts = set(curve.formation.contacts)
        own = [border for border in chart.borders if set(border.contacts) == contacts]
        points = curve.evaluate(np.linspace(0.0, curve.length, 40)).z[:, [0, 2]]
        assert distance_to(own, points).max() < 2e-5


def most_slack(problem: Problem, border: Border, k: int, way: float) -> float | None:
    """How far all limits can be kept at a border's point, by a linear programme; None: unclear."""
    scene = problem.scene
    formation = Formation(scene, border.contacts)
    part = formation.evaluate(border.z[[k]], np.zeros((1, 5)))
    # The tangent from neighbouring points, not from A.
    before, after = border.z[k - 1], border.z[k + 1]
    slip, turn = part.A_t[0] @ (after - before) * way, (after - before)[3:] * way
    size = np.abs(after - before).max()
    if (np.abs(slip) < 2e-3 * size).any() or (np.abs(turn) < 2e-2 * size).any():
        return None
    G = part.A[0] - (formation.friction * np.sign(slip))[:, None] * part.A_t[0]
    # Unknowns c_n (4), tau (2), slack: G^T c_n + S tau = D sigma - g.
    equal = np.zeros((5, 7))
    equal[:, :4], equal[[3, 4], [4, 5]] = G.T, 1.0
    right = -scene.applied_force + np.array([0.0, 0.0, 0.0, *(scene.dry[3:] * np.sign(turn))])
    above = np.zeros((8, 7))
    above[:4, :4], above[4:6, 4:6], above[6:, 4:6] = -np.eye(4), np.eye(2), -np.eye(2)
    above[:, 6] = 1.0
    bound = np.concatenate([np.full(4, -problem.epsilon), np.tile(scene.torque_limit, 2)])
    ranges = [(None, None)] * 6 + [(None, 10.0)]
    answer = linprog([0.0] * 6 + [-1.0], above, bound, equal, right, ranges)
    assert answer.success
    return float(answer.x[-1])


def test_directions_agree_with_a_linear_programme(every: FormationMap) -> None:
    rng = np.random.default_rng(4)
    flush = [b for b in every.borders if b.flush is not None and len(b.z) > 4]
    seen = []
    for _ in range(60):
        border = flush[rng.integers(len(flush))]
        k = int(rng.integers(1, len(border.z) - 1))
        for way, answer in ((1.0, border.forth[k]), (-1.0, border.back[k])):
            slack = most_slack(every.problem, border, k, way)
            # Neighbours give the tangent to a percent or so; clear cases only.
            if slack is not None and abs(slack) > 1e-6:
                assert answer == (slack > 0), (border.contacts, border.points[k], way)
                seen.append(bool(answer))
    assert sum(seen) > 20 and len(seen) - sum(seen) > 10


def test_directions_inside_cells_balance(chart: FormationMap) -> None:
    """Against c_n by least squares and slip by finite differences of closed poses."""
    scene, problem = chart.problem.scene, chart.problem
    rng = np.random.default_rng(5)
    steps = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 20.0], [0.0, -20.0]]) * 1e-7
    checked = 0
    for k in rng.choice(len(chart.places), 80, replace=False):
        place = chart.places[k]
        z = close_fingers(scene, *place[:, None]).z
        label = label_cells(scene, place)
        contacts = tuple(contact_table(scene)[i] for i in label if i != NOWHERE)
        formation = Formation(scene, contacts)
        part = formation.evaluate(z, z)
        for way, step in enumerate(steps):
            v = (close_fingers(scene, *(place + step)[:, None]).z - z)[0]
            slip = part.A_t[0] @ v
            if np.abs(slip).min() < 1e-10 or np.abs(v[3:]).min() < 1e-9:
                continue
            G = part.A[0] - (formation.friction * np.sign(slip))[:, None] * part.A_t[0]
            c_n, *_ = np.linalg.lstsq(G[:, :3].T, -scene.applied_force[:3], rcond=None)
            tau = scene.dry[3:] * np.sign(v[3:]) - G[:, 3:].T @ c_n
            slack = min((c_n - problem.epsilon).min(), (scene.torque_limit - abs(tau)).min())
            if abs(slack) > 1e-6:
                assert chart.possible[k, way] == (slack > 0)
                checked += 1
    assert checked > 200


def test_mirrored_problem_has_the_mirrored_map() -> None:
    window = Window((-0.09, 0.09), (np.radians(-20.0), np.radians(10.0)))
    other = Window((-0.09, 0.09), (np.radians(-10.0), np.radians(20.0)))
    told, problem = Retelling("mirrored", mirrored=True), problem_of(HEPTAGON)
    one = build_map(problem, 21, window)
    two = build_map(told.apply(problem), 21, other)
    assert len(one.borders) == len(two.borders) and len(one.crossings) == len(two.crossings)
    twins = {frozenset(border.contacts): border for border in two.borders}
    lengths = []
    for border in one.borders:
        twin = twins[frozenset(told.rename(c, problem.scene) for c in border.contacts)]
        ends = sorted((-border.points[[0, -1]]).tolist())
        # Ends are found to rounding, which the reach of a stretched finger turns into 1e-7.
        np.testing.assert_allclose(ends, sorted(twin.points[[0, -1]].tolist()), atol=1e-6)
        for mine, its in ((border.forth, twin.back), (border.back, twin.forth)):
            # Points may be counted from the other end: compare the shares.
            lengths.append(abs(float(mine.mean()) - float(its.mean())))
    assert max(lengths) < 0.1
    np.testing.assert_array_equal(one.cell < 0, two.cell[::-1, ::-1] < 0)


def test_places_where_the_fingers_overlap_are_marked() -> None:
    """Long fingers that meet over the hexagon."""
    problem = hexagon((0.19, 0.19), -0.085)
    crossed = build_map(problem, 90, Window((-0.1, 0.1), (np.radians(-30.0), np.radians(30.0))))
    scene = crossed.problem.scene
    x, phi = (part.ravel() for part in np.meshgrid(crossed.x, crossed.phi))
    overlap = measure_fingers(scene, close_fingers(scene, x, phi).z) < 0
    np.testing.assert_array_equal(crossed.cell.ravel() == CROSSED, overlap)
    assert 20 < overlap.sum() < overlap.size / 4
    # Borders end where the fingers touch.
    gaps = [measure_fingers(scene, border.z) for border in crossed.borders]
    assert min(gap.min() for gap in gaps) > -1e-9
    ends = [gap[k] for gap in gaps for k in (0, -1)]
    assert np.sum(np.abs(ends) < 1e-9) >= 4


def test_a_route_into_touching_fingers_says_so() -> None:
    problem = hexagon((0.19, 0.19), -0.085)
    with pytest.raises(InputError, match=r"cannot be followed .*: finger 1 touches finger 2"):
        list_formations(problem, (0.065, 0.0), (-0.05, 0.0))
    with pytest.raises(InputError, match="finger 1 touches finger 2"):
        list_formations(problem, (0.02, -0.02), (-0.03, 0.03))
    free = hexagon((0.19, 0.19), -0.085, solid=False)
    assert len(list_formations(free, (0.065, 0.0), (-0.05, 0.0))) == 4


@pytest.mark.parametrize("count", [6, 24, 120])
def test_the_window_ends_before_the_next_edge_but_one(count: int) -> None:
    angles = np.linspace(0, math.tau, count, endpoint=False)
    corners = 0.05 * np.column_stack([np.cos(angles), np.sin(angles)])
    changes = {"phases": None, "fingers_collide": False, "start": {"flush": 0, "x": 0.0}}
    problem = problem_of(HEPTAGON).with_(changes | {"vertices": corners})
    window = choose_window(problem)
    assert len(window.flush_angles(problem.scene)) == 3
    low, high = window.phi
    assert 2 * math.tau / count < high - low < 2 * math.tau / count + np.radians(12.1)


def test_map_needs_a_sound_grid_and_some_reach(heptagon: Problem) -> None:
    with pytest.raises(InputError, match="resolution"):
        build_map(heptagon, resolution=3)
    with pytest.raises(InputError, match="nowhere"):
        build_map(heptagon, 20, Window((1.0, 1.2), (0.0, 1.0)))
    with pytest.raises(InputError, match=r"uniqueness_margin: 1\.0 given"):
        build_map(heptagon, 20, uniqueness_margin=1.0)
    lines: list[str] = []
    build_map(heptagon, 20, Window((-0.02, 0.02), (0.1, 0.2)), lines.append)
    assert lines and all(line.startswith("map: ") for line in lines)


def test_phases_are_listed_for_a_problem_without_any(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bare.toml"
    path.write_text(text_of(phases=0), encoding="utf-8")
    assert main(["map", str(path), "--list", "0.045,-1.98", "-.0637,-1.98"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["phases"] == TABLE["phases"][:3]
    bare = read_problem(str(path))
    low, high = choose_window(bare).phi
    assert low < bare.start[2] < high and high - low < math.pi


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--list", "0.1,2,3", "0,0"], "--list: '0.1,2,3' given; allowed is X,PHI"),
        (["--list", "a,0", "0,0"], "--list: 'a,0' given"),
        (["--list", "nan,0", "0,0"], "--list"),
        (["--list", "0,0"], "route: 1 pose"),
        (["--phi", "3,2"], "--phi: '3,2' given"),
        (["-o", "map.txt"], "allowed: .png, .pdf, .svg"),
        (["--plan", "missing.npz", "--list", ".045,0", "0,0"], "missing.npz: cannot be read"),
    ],
)
def test_command_names_bad_arguments(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["map", str(HEPTAGON), *arguments]) == 2
    captured = capsys.readouterr()
    assert words in captured.err and captured.err.count("\n") == 1 and not captured.out
    assert not list(tmp_path.iterdir())


ROUNDING = 1e-15


def random_scene(rng: np.random.Generator, radius: float, count: int = 5) -> Scene:
    """One link whose length is between a part and twice of the object's size."""
    length = rng.uniform(0.03, 0.2)
    scene = plane.make_scene(
        plane.convex_polygon(rng, count), length=length, radius=radius, base=0.05
    )
    return replace(scene, fingers_collide=False)


def link_gaps(scene: Scene, finger: int, z: Array) -> Array:
    return plane.finger_gap(scene, z[:, :3], finger, z[:, 3 + finger])


def approach(rng: np.random.Generator, scene: Scene, finger: int) -> Array:
    """A place where a corner or an edge is within 2 mm of some point of a link's outline."""
    link, phi = scene.fingers[finger], rng.uniform(-np.pi, np.pi)
    corners = plane.rotate(phi, scene.polygon.vertices)
    one, other = corners[[k := int(rng.integers(len(corners))), k - 1]]
    on_edge = one + np.clip(rng.uniform(-0.5, 1.0), 0, 1) * (other - one)
    away = np.arctan2(*-on_edge[::-1]) + rng.uniform(-0.5, 0.5)
    share = np.clip(rng.uniform(-0.5, 1.5), 0, 1)
    lean = np.pi / 2 if 0 < share < 1 else rng.uniform(np.pi / 2, np.pi)
    angle = away + rng.choice([-1, 1]) * lean + (np.pi if share == 1 else 0.0)
    on_axis = np.asarray(link.base) + share * link.length * np.array([np.cos(angle), np.sin(angle)])
    heading = np.array([np.cos(away), np.sin(away)])
    at = on_axis + (link.radius + rng.uniform(-2e-3, 4e-3)) * heading - on_edge
    return np.array([*at, phi, angle, angle])


def limits_of(formation: Formation, finger: int, values: Array) -> dict[str, float]:
    """Values of the limits that are about one finger and the object."""
    every = zip([limit.text for limit in formation.limits], values.tolist(), strict=True)
    return {text: value for text, value in every if f"finger {finger + 1}" in text}


@pytest.mark.parametrize("finger", [0, 1])
@pytest.mark.parametrize("radius", [0.0, 0.004, 0.02])
def test_a_free_link_and_the_object_overlap_where_a_limit_says_so(
    radius: float, finger: int
) -> None:
    """Limits are positive if, and only if, the bodies are apart, as measured by plain geometry."""
    rng = np.random.default_rng([finger, int(1e3 * radius)])
    broken: set[str] = set()
    seen = {True: 0, False: 0}
    for _ in range(3):
        scene = random_scene(rng, radius, int(rng.integers(3, 9)))
        formation = plane.make_formation(scene, "v0-palm")
        z = np.array([approach(rng, scene, finger) for _ in range(250)])
        values = formation.evaluate_limits(z)
        for gap, row in zip(link_gaps(scene, finger, z), values, strict=True):
            limits = limits_of(formation, finger, row)
            text = min(limits, key=limits.__getitem__)
            least = limits[text]
            assert least > 0 if gap > ROUNDING else least < 0, (text, gap, least)
            seen[gap > ROUNDING] += 1
            broken |= {text.split(maxsplit=1)[1] for text, value in limits.items() if value < 0}
    assert min(seen.values()) > 100
    name = f"finger {finger + 1}"
    expected = {f"touches {part}{name}" for part in ("", "the far side of ", "the tip of ")}
    assert broken == expected | {f"touches the joint of {name}"}


def hold(rng: np.random.Generator, scene: Scene, name: str) -> Array:
    """A place where a contact of a link touches, the object turned by any angle."""
    contact = parse_contact(name, scene)
    assert contact.finger is not None
    link, (angle, phi) = scene.fingers[contact.finger], rng.uniform(-np.pi, np.pi, 2)
    axis = np.array([np.cos(angle), np.sin(angle)])
    corners = plane.rotate(phi, scene.polygon.vertices)
    one, other = corners[[contact.index, (contact.index + 1) % len(corners)]]
    share, normal, on_body = 1.0, plane.rotate(rng.uniform(-np.pi / 2, np.pi / 2), axis), one
    if contact.surface == "finger":
        share = rng.uniform(0.02, 0.98)
        normal = plane.rotate(np.pi / 2 if contact.finger == 0 else -np.pi / 2, axis)
    elif contact.feature == "e":
        normal = plane.rotate(np.pi / 2, other - one) / np.hypot(*(other - one))
        on_body = one + rng.uniform(0.02, 0.98) * (other - one)
    at = np.asarray(link.base) + share * link.length * axis + link.radius * normal - on_body
    return np.array([*at, phi, angle, angle])


@pytest.mark.parametrize("name", ["v1-finger1", "v1-finger2", "e1-tip1", "e1-tip2", "v1-tip2"])
@pytest.mark.parametrize("radius", [0.0, 0.004, 0.02])
def test_a_link_that_touches_overlaps_elsewhere_where_a_limit_says_so(
    radius: float, name: str
) -> None:
    if radius == 0 and name.startswith("v1-tip"):
        return  # A pointed tip has no arc.
    finger = int(name[-1]) - 1
    rng = np.random.default_rng([finger, int(1e3 * radius), len(name)])
    seen = {True: 0, False: 0}
    for _ in range(3):
        scene = random_scene(rng, radius, int(rng.integers(3, 9)))
        formation = plane.make_formation(scene, name)
        z = np.array([hold(rng, scene, name) for _ in range(56)])
        assert np.abs(formation.evaluate(z, z).C).max() < 1e-14
        # A little smaller, the object touches nothing where it only touched.
        body = replace(scene.polygon, points=(1 - 1e-6) * scene.polygon.vertices)
        smaller = replace(scene, polygon=body)
        every = zip(z, formation.evaluate_limits(z), link_gaps(smaller, finger, z), strict=True)
        for place, values, gap in every:
            least = min(limits_of(formation, finger, values).values())
            clear = bool(gap > (-1e-7 if radius else 0.0))
            assert clear or least < 1e-7, (place, least, gap)
            # An object behind a pointed link, which has no thickness, overlaps nothing.
            thick = radius > 0 or name.startswith("e")
            assert not (clear and thick and least < -2e-3), (place, least)
            seen[clear] += 1
    assert min(seen.values()) > 10


def random_link(rng: np.random.Generator, side: float) -> Finger:
    base = side * rng.uniform(0.01, 0.1), rng.uniform(-0.05, 0.02)
    return plane.make_finger(base, rng.uniform(0.05, 0.25), rng.choice([0.0, 0.004, 0.02]))


def random_angles(rng: np.random.Generator, count: int) -> Array:
    return np.hstack([np.zeros((count, 3)), rng.uniform(-np.pi, np.pi, (count, 2))])


def test_the_gap_is_the_distance_or_minus_the_least_push_that_parts() -> None:
    seen, rng = np.zeros(2, dtype=int), np.random.default_rng(0)
    for _ in range(36):
        fingers = random_link(rng, 1.0), random_link(rng, -1.0)
        scene, z = replace(plane.make_scene(), fingers=fingers), random_angles(rng, 400)
        gap = evaluate_finger_gap(scene, z)
        np.testing.assert_allclose(gap, measure_fingers(scene, z), atol=1e-14)
        crossed = gap < -sum(link.radius for link in scene.fingers)
        seen += [crossed.sum(), (~crossed).sum()]
    assert seen.min() > 100


def test_ends_that_coincide_touch() -> None:
    """Two pointed links that meet at their tips."""
    scene = plane.make_scene(plane.SQUARE, base=0.06, depth=0.0, length=0.1, radius=0.0)
    z = np.zeros((1, 5))
    z[0, 3:] = np.arccos(-0.6), np.arccos(0.6)
    assert evaluate_finger_gap(scene, z) == pytest.approx(0.0, abs=1e-14)
    features = build_features(scene)
    hessian, gradient = ca.hessian(build_finger_gap(scene), features.z)
    values = ca.Function("h", [features.z], [hessian, gradient])(z[0])
    assert all(np.isfinite(value.full()).all() for value in values)


def test_the_gap_is_a_limit_of_every_formation() -> None:
    scene = plane.make_scene(plane.SQUARE)
    for names in ("v0-palm v1-palm", "v0-palm v2-finger1 e3-tip2"):
        formation = plane.make_formation(scene, names)
        (index,) = [k for k, e in enumerate(formation.limits) if e.text == FINGERS_TOUCH]
        assert formation.limits[index].gained is None
        z = random_angles(np.random.default_rng(5), 20)
        values = formation.evaluate_limits(z)[:, index]
        np.testing.assert_allclose(values, evaluate_finger_gap(scene, z), atol=ROUNDING)
    passing = plane.make_formation(replace(scene, fingers_collide=False), "v0-palm v1-palm")
    assert FINGERS_TOUCH not in [limit.text for limit in passing.limits]


FAR_GOAL = Goal(flush=0, x=9.0)  # that no border leads to


def make_border(curve: Curve) -> Border:
    z = curve.evaluate(np.linspace(0, curve.length, 12)).z
    still = np.zeros(len(z), dtype=bool)
    return Border(curve.formation.contacts, (None, 0), "x", z[:, [0, 2]], z, still, still, still)


def test_times_of_borders_are_those_of_sweeps_along_traced_curves() -> None:
    problem = problem_of(HEPTAGON)
    curves = trace_phases(problem)
    expected = []
    for forth in curves:
        way = -forth.evaluate(np.array([forth.length])).z_s[0]
        back = trace_curve(forth.formation, forth.end, way, Until())
        back = replace(back, length=forth.length, reached=True)
        for own in (forth, back):
            try:
                expected.append(sweep_time((own,), problem.epsilon, 100))
            except NoMotionError:
                expected.append(math.inf)
    found = time_borders(problem, [make_border(curve) for curve in curves])
    # Twelve points and twenty-four intervals leave an error below one in a hundred.
    assert found.ravel() == pytest.approx(np.array(expected), rel=0.01)
    assert np.isfinite(found[:, 0]).all()


def test_a_chain_of_impacts_is_bounded_as_its_plan_takes() -> None:
    problem = problem_of(IMPACTS)
    chart, phases = Roadmap(problem, 0.1), problem.phases[:3]
    until = [str(phase.until) for phase in phases]
    place = make_place(problem.scene, problem.start)
    edges = chart.collect_edges(place, FAR_GOAL)
    (own,) = (edge for edge in edges if [str(step.until) for step in edge.steps] == until)
    assert [step.end for step in own.steps] == [End.IMPACT, End.IMPACT, End.REST]
    took = sum(motion.duration for motion in solved(IMPACTS).trajectory.motions[:3])
    assert own.bound <= took * (1 + 1e-6)
    assert own.estimate == pytest.approx(took, rel=1e-2)
    # A stop at each crossing takes longer, by what the plan says that the impacts save.
    alone = 0.0
    for phase in phases:
        (edge,) = (
            edge
            for chain in chart.follow(place)
            if isinstance(edge := chain.edge, Edge)
            and set(chain.borders[0].formation.contacts) == set(phase.formation.contacts)
            and edge.steps[0].until == phase.until
        )
        alone, place = alone + edge.estimate, edge.stop
    assert alone > 1.2 * own.estimate


def test_no_chain_leads_through_an_impact_that_is_not_possible() -> None:
    problem = problem_of(HEPTAGON)
    edges = Roadmap(problem, 0.1).collect_edges(make_place(problem.scene, problem.start), FAR_GOAL)
    # With little friction there the impact onto v3-finger1 would tip edge 0 off the palm.
    assert not any(len(own.steps) > 1 and str(own.steps[0].until) == "v3-finger1" for own in edges)


def test_a_landing_is_led_to_where_the_goal_is() -> None:
    problem, goal = problem_of(LANDING), Goal(flush=1, x=0.022)
    chart, curves = Roadmap(problem, 0.1), trace_phases(problem)
    place = make_place(problem.scene, curves[3].end)
    contacts = set(problem.phases[4].formation.contacts)
    borders = [chain.borders[0] for chain in chart.follow(place)]
    (border,) = (own for own in borders if set(own.formation.contacts) == contacts)
    landings = chart.land_at(chart.release(border, borders), goal)
    assert landings
    for edge in landings:
        assert is_at(edge.stop, goal) and str(edge.steps[-1].until) == "v2-palm at x = 0.022 m"
        assert [step.end for step in edge.steps] == [End.SMOOTH, End.REST]
        closed = gaps(problem.scene, edge.stop.contacts, edge.stop.z[None])
        assert np.abs(closed).max() < 1e-8 * problem.scene.scales.length
    assert chart.land_at(chart.release(border, borders), Goal(flush=1)) == []
