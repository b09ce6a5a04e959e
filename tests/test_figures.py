"""Figures, pages and movies, and results as data, text, HTML and Markdown."""

from __future__ import annotations

import itertools
import json
import math
import re
import shutil
import subprocess
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.text import Text
from PIL import Image, ImageColor

import scenes
import wholearm
from plane import place_corners
from scenes import hexagon
from shipped import HEPTAGON, IMPACTS, LANDING, chart, plan_of, problem_of, verified
from wholearm import InputError, PlanOptions, Problem, TorqueProfile, Trajectory, plots, verify
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.common.document import Document, Result, Table
from wholearm.contacts.closing import contact_table, evaluate_each
from wholearm.figures.map_figure import draw_map
from wholearm.figures.style import WIDTH, choose_styles
from wholearm.mapping.borders import Window
from wholearm.mapping.formation_list import write_template
from wholearm.mapping.formation_map import FormationMap, build_map
from wholearm.planning.nlp import Solver
from wholearm.planning.plan import solve
from wholearm.planning.result import Plan, Status, describe_plan, load_plan, write_meta
from wholearm.results.dwell_record import assemble
from wholearm.verification.newton_euler import balance, locate
from wholearm.viewer.movie import FRAMES, write_movie
from wholearm.viewer.page import build_page, describe_motion, write_map, write_player
from wholearm.viewer.report_page import build_report, describe_map, list_junctions, list_phases


@pytest.fixture(scope="module")
def figure(trajectory: Trajectory) -> Figure:
    return plots.force_margins(trajectory)


@pytest.fixture
def axes() -> Axes:
    figure = Figure()
    FigureCanvasAgg(figure)
    return figure.add_subplot()


def line_of(axes: Axes, label: str) -> Line2D:
    (line,) = (line for line in axes.lines if line.get_label() == label)
    return line


def data_of(line: Line2D) -> tuple[Array, Array]:
    x, y = line.get_data()
    return np.asarray(x, dtype=float), np.asarray(y, dtype=float)


def levels(axes: Axes) -> list[float]:
    """Heights of the lines that cross the whole axes."""
    every = [data_of(line) for line in axes.lines]
    return [float(y[0]) for x, y in every if x.tolist() == [0, 1] and y[0] == y[1]]


def repeat(trajectory: Trajectory, phases: list[int]) -> Trajectory:
    """The trajectory's phases in another order and number."""
    motions, torques = [trajectory.motions[k] for k in phases], []
    for start, stop in trajectory.phase_starts[np.array(phases)[:, None] + [0, 1]]:
        part = trajectory.torque.cut(start, stop)
        torques.append(TorqueProfile(part.breaks - start, part.coefficients))
    return assemble(motions, TorqueProfile.chain(torques), trajectory.meta, 101)


def visible(figure: Figure) -> list[tuple[str, Any]]:
    """Every text that is drawn and its box in pixels; tick labels beyond the limits are not."""
    canvas: Any = figure.canvas
    canvas.draw()
    renderer = canvas.get_renderer()
    drawn = {id(text) for text in figure.findobj(Text)}
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in axis.get_major_ticks():
                inside = low <= tick.get_loc() <= high
                if not inside or not tick.label1.get_visible() or not axes.axison:
                    drawn.discard(id(tick.label1))
                drawn.discard(id(tick.label2))
    chosen: list[Any] = [text for text in figure.findobj(Text) if id(text) in drawn]
    shown = [text for text in chosen if text.get_visible() and text.get_text().strip()]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in shown]


def check_layout(figure: Figure, least: float = 8.0) -> None:
    """No text outside the figure, none upon another, none smaller than so many points."""
    found = visible(figure)
    assert len(found) > 20
    for name, box in found:
        assert box.x0 >= 0 and box.y0 >= 0, name
        assert box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height, name
    for (one, a), (other, b) in itertools.combinations(found, 2):
        apart = a.x1 <= b.x0 or b.x1 <= a.x0 or a.y1 <= b.y0 or b.y1 <= a.y0
        assert apart, (one, other)
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        assert float(text.get_fontsize()) >= least


def test_figure_has_a_strip_of_one_scale_and_two_panels_with_units(figure: Figure) -> None:
    *strip, margins, torques = figure.axes
    assert len(strip) == 6
    assert "[N]" in margins.get_ylabel() and "[N m]" in torques.get_ylabel()
    assert "[s]" in torques.get_xlabel() and margins.get_xlim() == torques.get_xlim()
    figure.canvas.draw()
    scales = []
    for axes in strip:
        box, (left, right), (low, high) = axes.bbox, axes.get_xlim(), axes.get_ylim()
        scales += [box.width / (right - left), box.height / (high - low)]
    np.testing.assert_allclose(scales, scales[0], rtol=1e-6)
    assert "50 mm" in [text.get_text() for text in figure.texts]
    (bar,) = (own for own in figure.artists if isinstance(own, Line2D))
    assert np.ptp(data_of(bar)[0]) * figure.dpi / scales[0] == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("size", "prefix"),
    [(5e-4, "m"), (2e-6, "\u00b5"), (3e-9, "n"), (400.0, ""), (16e3, "k"), (2e9, "M")],
)
def test_units_suit_the_size(axes: Axes, size: float, prefix: str) -> None:
    torque = TorqueProfile(np.array([0.0, 1.0]), np.full((1, 2, 1), 0.5 * size))
    plots.draw_torques(axes, torque, np.array([size, size]))
    axes.figure.canvas.draw()
    assert f"[{prefix}N m]" in axes.get_ylabel()
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert max(map(len, labels)) <= 5


@pytest.mark.parametrize("height", [0.4, 1.0])
def test_ticks_of_margins_are_apart_in_low_panels(height: float) -> None:
    axes = Figure((4.0, 4.0)).add_axes((0.2, 0.0, 0.8, height))
    plots.scale_margins(axes, np.array([-5.0, 300.0]), 5.0)
    places = axes.transData.transform([[0.0, tick] for tick in axes.get_yticks()])[:, 1]
    assert np.diff(places).min() >= 8.0 / 72 * axes.figure.dpi
    assert {0.0, 1.0, 100.0} <= set(axes.get_yticks())


def test_margins_are_the_trajectory_with_breaks_at_phases_and_limits(
    figure: Figure, trajectory: Trajectory, heptagon: Problem
) -> None:
    (margins, torques), steps = figure.axes[-2:], trajectory.find_steps()
    assert set(np.flatnonzero(np.diff(trajectory.phase)) + 1) <= set(steps)
    added = np.insert(np.zeros(len(trajectory.t), dtype=bool), np.repeat(steps, 2), True)
    for index, name in enumerate(trajectory.contacts):
        t, values = data_of(line_of(margins, name))
        np.testing.assert_array_equal(t[~added], trajectory.t)
        np.testing.assert_array_equal(values[~added], trajectory.c_n[:, index] - 0.05)
        # At a step the line breaks upright: it lasts until then, and goes on from there.
        np.testing.assert_array_equal(t[added], np.repeat(trajectory.t[steps], 2))
        before = trajectory.c_n[steps - 1, index] - 0.05
        np.testing.assert_array_equal(values[added][::2], before)
        assert np.isnan(values[added][1::2]).all()
    assert 0.0 in levels(margins)
    low, high = margins.get_ylim()
    assert low < -heptagon.epsilon and high > np.nanmax(trajectory.c_n) - heptagon.epsilon
    limits = heptagon.scene.torque_limit
    assert sorted(y for y in levels(torques) if y) == sorted([*limits, *-limits])
    for line in torques.lines:
        if line.get_label() == "limits":
            assert line.is_dashed()


def test_torque_lines_have_both_ends_of_every_step(axes: Axes) -> None:
    profile = TorqueProfile(
        np.array([0.0, 0.5, 2.0]),
        np.array([[[0.25, 0.25, 0.0], [1.0, 0.0, 0.0]], [[-1.0, 0.0, 0.5], [1.0, 0.0, 0.0]]]),
    )
    plots.draw_torques(axes, profile, np.array([2.0, 2.0]))
    line, other = axes.lines[:2]
    t, tau = data_of(line)
    np.testing.assert_allclose(tau[t == 0.5], [0.5, -0.5])
    inside = t != 0.5
    np.testing.assert_allclose(tau[inside], profile.at(t[inside])[:, 0], atol=1e-12)
    np.testing.assert_allclose(data_of(other)[1], 1.0)


@pytest.mark.parametrize("row", [0, 320, -1])
def test_snapshot_is_to_scale(
    axes: Axes, trajectory: Trajectory, heptagon: Problem, row: int
) -> None:
    z, names = trajectory.z[row], trajectory.motions[trajectory.phase[row]].contacts
    scene, styles = heptagon.scene, choose_styles(trajectory.contacts)
    box = plots.measure_box(scene, z[None])
    _, *links, body = plots.draw_snapshot(axes, scene, z, names, styles, box)[:4]
    corners = place_corners(scene, z)
    assert isinstance(body, Polygon)
    np.testing.assert_allclose(body.get_xy()[:-1], corners, atol=1e-13)
    for link, finger, angle in zip(links, scene.fingers, z[3:], strict=True):
        assert isinstance(link, Polygon)
        offset = link.get_xy() - np.asarray(finger.base)
        axis = np.array([np.cos(angle), np.sin(angle)])
        along = np.clip(offset @ axis, 0.0, finger.length)
        distance = np.hypot(*(offset - along[:, None] * axis).T)
        np.testing.assert_allclose(distance, finger.radius, atol=1e-13)
        assert np.max(offset @ axis) == pytest.approx(finger.length + finger.radius)
    marks = {str(line.get_label()): line for line in axes.lines}
    for name in names:
        vertex = corners[int(name[1])]
        np.testing.assert_allclose(np.ravel(data_of(marks[name])), vertex, atol=1e-12)
    assert [text.get_text() for text in axes.texts] == list("0123456")


def test_snapshots_are_at_least_six_and_one_of_every_phase(trajectory: Trajectory) -> None:
    for phases in ([0], [0, 1], [0, 1, 2], [0, 1, 2, 3], list(range(5)), [0, 1] * 5):
        other = repeat(trajectory, phases)
        rows = plots.choose_snapshots(other)
        assert len(rows) == max(6, len(phases) + 1)
        assert rows[0] == 0 and rows[-1] == len(other.t) - 1
        assert (np.diff(rows) > 0).all()
        assert {*np.flatnonzero(np.diff(other.phase)) + 1} <= {*rows}


@pytest.mark.parametrize("width", [3.5, 7.0])
def test_text_is_inside_and_apart_in_other_widths(width: float, trajectory: Trajectory) -> None:
    figure = plots.force_margins(trajectory, width=width, motion=True)
    assert figure.get_figwidth() == width
    check_layout(figure)
    place, angles, speeds = figure.axes[-3:]
    assert data_of(line_of(place, "x"))[1][-1] == pytest.approx(1e3 * trajectory.q[-1, 0])
    for label, angle in (("phi", trajectory.q[-1, 2]), ("finger 2", trajectory.theta[-1, 1])):
        assert data_of(line_of(angles, label))[1][-1] == pytest.approx(np.degrees(angle))
    assert np.nanmax(data_of(line_of(speeds, "finger 1"))[1]) == trajectory.theta_dot[:, 0].max()
    # Two digits side by side inside of a small object would read as one number.
    assert plots.choose_numbers(np.array([[0, 0], [18.5, 0], [18.5, 22], [0, 22]]))[1][0] > 0


def test_simulation_is_drawn_over_the_plan(trajectory: Trajectory) -> None:
    c_n = trajectory.c_n.copy()
    c_n[100, 0] = -3.0
    simulation: Any = replace(trajectory, c_n=c_n)
    figure = plots.force_margins(trajectory, simulation=simulation)
    margins, torques = figure.axes[-2:]
    line = line_of(margins, "simulated")
    t, values = data_of(line)
    rows = ~np.isnan(t)
    assert (~rows).sum() == 4
    np.testing.assert_array_equal(values[rows], c_n[:, 0] - 0.05)
    assert margins.get_ylim()[0] < -3.05
    both = [line_of(torques, f"simulated {number}") for number in (1, 2)]
    assert line.is_dashed() and both[0].is_dashed()
    # The torque of one finger is told from that of the other.
    assert both[0].get_linewidth() != both[1].get_linewidth()
    check_layout(figure)


def test_save_writes_the_format_of_the_ending_and_the_same_bytes(
    trajectory: Trajectory, tmp_path: Path
) -> None:
    short = repeat(trajectory, [0])
    # Letters take a PDF long.
    figure, wordless = plots.force_margins(short), Figure()
    wordless.add_subplot().set_axis_off()
    wordless.axes[0].plot(short.t, short.tau)
    for ending, magic in ((".png", b"\x89PNG\r\n"), (".PDF", b"%PDF-")):
        drawn = figure if ending == ".png" else wordless
        first, second = (tmp_path / f"{name}{ending}" for name in "ab")
        # Whether a figure is new or has been drawn before.
        plots.save(drawn, first)
        plots.save(drawn, str(second))
        written = first.read_bytes()
        assert written.startswith(magic) and written == second.read_bytes()
        assert b"Date" not in written and b"dc:date" not in written and len(written) < 1_000_000
        if ending == ".png":
            # At least 150 dots per inch.
            assert int.from_bytes(written[16:20], "big") >= 150 * WIDTH


@pytest.mark.parametrize("name", ["a.jpg", "a", "png", "a.png.txt"])
def test_save_refuses_other_endings(figure: Figure, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"allowed: \.png, \.pdf, \.svg") as caught:
        plots.save(figure, tmp_path / name)
    assert name in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_drawn_is_refused(trajectory: Trajectory) -> None:
    bare = replace(trajectory, meta={"epsilon": 0.05})
    with pytest.raises(InputError, match=r"meta\.problem"):
        plots.force_margins(bare)
    for width in (2.0, 50.0, math.nan):
        with pytest.raises(InputError, match="width"):
            plots.force_margins(trajectory, width=width)


def test_odd_names_are_drawn_as_they_are(trajectory: Trajectory) -> None:
    short = repeat(trajectory, [0])
    for name in ("cost $5 and \\frac{" + 20 * " a long name", ""):
        meta = {**trajectory.meta, "name": name}
        check_layout(plots.force_margins(replace(short, meta=meta)))


def test_friction_cones_have_a_panel_of_their_own(figure: Figure, tmp_path: Path) -> None:
    """Settings of Matplotlib are left alone, and pyplot is not imported."""
    plan, before = scenes.tipped(), matplotlib.rcParams.copy()
    drawn = plots.force_margins(plan)
    plots.save(drawn, tmp_path / "a.svg")
    assert matplotlib.rcParams.copy() == before
    source = Path(wholearm.__file__).parent
    assert not [own for own in source.rglob("*.py") if "pyplot" in own.read_text("utf-8")]
    check_layout(drawn)
    assert len(drawn.axes) == len(figure.axes) + 1
    margins, torques, cones = drawn.axes[-3:]
    assert margins.get_position().y0 > cones.get_position().y1
    assert cones.get_position().y0 > torques.get_position().y1
    t, shares = data_of(line_of(cones, "v1-palm"))
    known = ~np.isnan(t)
    column = plan.contacts.index("v1-palm")
    expected = plan.c_t[:, column] / (scenes.PALM * plan.c_n[:, column])
    expected[plan.phase != 1] = np.nan
    np.testing.assert_allclose(shares[known], expected, rtol=1e-12)
    assert np.nanmax(np.abs(shares)) < 1 and levels(cones) == [-1.0, 1.0, 0.0]
    margin_line = line_of(margins, "v1-palm")
    assert line_of(cones, "v1-palm").get_color() == margin_line.get_color()


@pytest.fixture(scope="module")
def picture(chart: FormationMap) -> Figure:
    return draw_map(chart)


def texts(picture: Figure) -> list[str]:
    return [text.get_text() for text in picture.findobj(Text)]


def test_axes_cells_edges_and_phases_are_named(picture: Figure, chart: FormationMap) -> None:
    (axes,) = picture.axes
    assert axes.get_xlabel() == "x of the centroid [mm]"
    assert axes.get_ylabel() == "orientation \u03c6 [deg]"
    assert axes.get_xlim() == pytest.approx(tuple(1e3 * chart.x[[0, -1]]))
    assert axes.get_ylim() == pytest.approx(tuple(np.degrees(chart.phi[[0, -1]])))
    shown = texts(picture)
    assert {"v1 | v3 | v6", "v1 | v4 | v6", "v0 | v3 | v5", "v0 | e2 | v0"} <= set(shown)
    assert [text for text in shown if text.isdigit()] == ["1", "2", "3", "4", "5"]
    assert {f"edge {edge} on\nthe palm" for edge in (6, 0, 1)} <= set(shown)
    # In a narrow window, only the phase in it has its number.
    narrow = draw_map(build_map(chart.problem, 20, Window((-0.1, 0.1), (-0.0871, -0.087))))
    assert [text for text in texts(narrow) if text.isdigit()] == ["4"]
    # Nothing is clipped, and labels do not overlap.
    for each in (picture, narrow):
        check_layout(each, 7.0)


def test_labels_are_inside_their_cells(picture: Figure, chart: FormationMap) -> None:
    names = [
        " | ".join(f"{c.corner}{'*' if (c.surface, c.feature) == ('tip', 'v') else ''}" for c in f)
        for f in chart.formations
    ]
    labels = [text for text in picture.axes[0].texts if text.get_text() in names]
    assert len(labels) > 20
    for label in labels:
        x, phi = label.get_position()
        column = np.abs(1e3 * chart.x - x).argmin()
        row = np.abs(np.degrees(chart.phi) - phi).argmin()
        assert names[chart.cell[row, column]] == label.get_text()


def test_directed_lines_are_where_motion_is_possible(picture: Figure, chart: FormationMap) -> None:
    (axes,) = picture.axes
    strips = [c for c in axes.collections if isinstance(c, LineCollection)]
    by_colour = {to_hex(np.asarray(c.get_color())[0]).upper(): c for c in strips}
    # A line is moved aside by a few points: a few per cent of the axes' half.
    slack = 0.02 * np.array([np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())])
    for colour, name in (("#0072B2", "forth"), ("#D55E00", "back")):
        places = np.concatenate([own.points[getattr(own, name)] for own in chart.borders])
        places = np.column_stack([1e3 * places[:, 0], np.degrees(places[:, 1])])
        for segment in by_colour[colour].get_segments():
            for point in np.asarray(segment)[:: len(segment) // 3 + 1]:
                assert (np.abs(places - point) < slack).all(axis=1).any()


def test_plan_is_drawn_over_the_map(chart: FormationMap, trajectory: Trajectory) -> None:
    lines = draw_map(chart, trajectory).axes[0].lines
    paths = [np.column_stack(line.get_data()) for line in lines]
    ends = [path[[0, -1]] for path in paths if len(path) > 50]
    assert len(ends) >= 5
    for k, (x, _, phi) in zip((0, -1), trajectory.q[[0, -1]], strict=True):
        assert any(np.allclose(end[k], [1e3 * x, np.degrees(phi)]) for end in ends)


def test_command_writes_the_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    plan_of(HEPTAGON).save("plan.npz")
    with monkeypatch.context() as patch:
        without_glyphs = replace(chart(), problem=replace(chart().problem, name="\u540d\u524d"))
        patch.setattr("wholearm.build_map", lambda *_, **__: without_glyphs)
        assert main(["map", str(HEPTAGON), "--plan", "plan.npz"]) == 0
        assert capsys.readouterr().out == "wrote map_heptagon_four_contacts.png\n"
        assert Path("map_heptagon_four_contacts.png").read_bytes()[:4] == b"\x89PNG"
        listing = ["--list", "0.045,-1.98", "0.03,-1.98"]
        assert main(["map", str(HEPTAGON), "-o", "m.svg", *listing]) == 0
    captured = capsys.readouterr()
    assert "contacts = [" in captured.out and captured.err == "wrote m.svg\n"
    assert (tmp_path / "m.svg").read_bytes()[:5] == b"<?xml"


def test_overlap_of_the_fingers_has_its_own_hatching(picture: Figure) -> None:
    window = Window((-0.06, 0.05), (np.radians(-15.0), np.radians(15.0)))
    drawn = draw_map(build_map(hexagon((0.19, 0.19), -0.085), 60, window))
    label = "the fingers would overlap"
    assert label in texts(drawn) and label not in texts(picture)
    (legend,) = drawn.legends
    looks = {str(own.get_label()): own for own in legend.legend_handles if own is not None}
    patches = [own for own in drawn.axes[0].patches if isinstance(own, PathPatch)]
    (crossed,) = [own for own in patches if own.get_hatch() is not None]
    own, other = looks[label], looks["cannot be reached"]
    assert isinstance(own, Patch) and isinstance(other, Patch)
    assert crossed.get_hatch() == own.get_hatch() != other.get_hatch()
    assert crossed.get_facecolor() == own.get_facecolor()


def test_pushes_and_weight_are_what_accelerates_the_object() -> None:
    problem, plan = problem_of(LANDING), plan_of(LANDING)
    touches = [locate(problem.scene, name, plan.z) for name in plan.contacts]
    points = np.stack([touch.point for touch in touches], axis=1)
    rows = np.stack([(touch.normal, touch.tangent) for touch in touches], axis=2)[..., :2]
    forces = plan.c_n[..., None] * rows[0] + plan.c_t[..., None] * rows[1]
    mass, inertia = problem.scene.mass_diagonal[1:3]
    arms = points - plan.q[:, None, :2]
    moments = arms[..., 0] * forces[..., 1] - arms[..., 1] * forces[..., 0]
    force, moment = np.nansum(forces, axis=1), np.nansum(moments, axis=1)
    force[:, 1] -= mass * problem.scene.gravity
    # Newton and Euler; plans satisfy them between nodes to 1e-6 of the largest forces.
    scale = np.nanmax(np.abs(forces))
    np.testing.assert_allclose(mass * plan.q_ddot[:, :2], force, atol=1e-5 * scale)
    np.testing.assert_allclose(inertia * plan.q_ddot[:, 2], moment, atol=1e-6 * scale)
    np.testing.assert_allclose(np.hypot(*rows[0].T), 1.0, rtol=1e-12)


def test_a_motion_survives_its_page() -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    motion = describe_motion(plan, problem)
    text = build_page("a <title>", [write_player(motion)])
    assert "a &lt;title&gt;" in text
    # Nothing is fetched: the only address is the name of SVG's namespace.
    assert set(re.findall(r"https?://[^\"]+", text)) == {"http://www.w3.org/2000/svg"}
    assert not re.search(r"\bsrc=\"(?!data:)|\bhref=", text)
    (found,) = re.findall(r'<script type="application/json">(.*?)</script>', text, re.S)
    read = json.loads(found)
    assert len(read["t"]) == len(read["z"]) == len(plan.t)
    np.testing.assert_allclose(read["z"], plan.z, atol=1e-5)
    for index, contact in enumerate(read["contacts"]):
        c = np.full((len(plan.t), 2), np.nan)
        for span in contact["spans"]:
            c[span["first"] : span["first"] + len(span["c"])] = span["c"]
        np.testing.assert_allclose(c[:, 0], plan.c_n[:, index], rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(c[:, 1], plan.c_t[:, index], rtol=1e-5, atol=1e-12)
    # Names cannot end a script.
    name = "</script><script>alert(1)"
    assert "</script><script>alert" not in write_player(motion | {"name": name})


def test_tables_say_what_the_joints_of_phases_are() -> None:
    problem, plan, replay = problem_of(LANDING), plan_of(LANDING), verified(LANDING).trajectory
    phases, joints = list_phases(problem, plan), list_junctions(plan)
    for table, count in ((phases, 6), (joints, 5)):
        assert {len(row) for row in table.rows} == {len(table.columns)}
        assert [row[0] for row in table.cells] == list("123456"[:count])
    duration = sum(float(row[phases.heads.index("duration [s]")]) for row in phases.cells)
    assert duration == pytest.approx(plan.duration, abs=1e-5)
    # The fourth ends at rest, the fifth smoothly: at a speed, the same on both sides.
    speeds = [row[joints.heads.index("speed before [m/s]") :][:2] for row in joints.cells]
    assert speeds[3] == 2 * ["0.0000"] and speeds[4][0] == speeds[4][1] != "0.0000"
    assert "v3-finger1: 0.050 \u2192 -" in joints.cells[4][1]
    # One contact opens at each, in the replay, too.
    assert [row[1].count("\u2192 -") for row in list_junctions(replay).cells] == 5 * [1]


def test_a_movie_shows_the_whole_motion(tmp_path: Path) -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    write_movie(tmp_path / "plan.gif", problem, plan, plan, speed=2.0)
    with Image.open(tmp_path / "plan.gif") as image:
        frames = getattr(image, "n_frames", 1)
        # Not slower than a frame of the whole, and at twice the speed.
        assert frames == pytest.approx(plan.duration / 2.0 * FRAMES + 1, abs=1.0)
        assert image.info["duration"] * FRAMES == 1000
        first = np.array(image.convert("RGB"), dtype=int)
        # Each contact has its own colour.
        for style in choose_styles(plan.contacts).values():
            assert (first == ImageColor.getrgb(style.colour)).all(axis=2).any()
        image.seek(frames - 1)
        assert (np.abs(np.array(image.convert("RGB")) - first).max(axis=2) > 60).mean() > 0.01


NO_FFMPEG = pytest.mark.skipif(shutil.which("ffmpeg") is not None, reason="ffmpeg is there")
MP4 = pytest.param("plan.mp4", "needs ffmpeg", marks=NO_FFMPEG)


@pytest.mark.parametrize("output, words", [("a.avi", "'.avi' given"), ("none/a.gif", "none"), MP4])
def test_animate_refuses_what_it_cannot_write(
    output: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan_of(HEPTAGON).save(str(tmp_path / "plan.npz"))
    assert main(["animate", str(tmp_path / "plan.npz"), "-o", str(tmp_path / output)]) == 2
    assert words in capsys.readouterr().err


def open_in_browser(text: str, folder: Path, fragment: str) -> str:
    """What a page has become in a browser, as HTML."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip("no Chromium here")
    (folder / "page.html").write_text(text, encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    options += ["--no-first-run", "--disable-sync", "--disable-component-update", "--disable-quic"]
    command = [browser, *options, f"--user-data-dir={folder / 'profile'}", "--dump-dom"]
    address = f"file://{folder / 'page.html'}{fragment}"
    return subprocess.run([*command, address], capture_output=True, text=True, timeout=60).stdout


@cache
def tell_map() -> tuple[str, dict[str, Any]]:
    return describe_map(chart(), plan_of(HEPTAGON))


def test_slider_plots_and_map_respond_in_a_browser(tmp_path: Path) -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    drawing, told = tell_map()
    places = told["places"]
    kinds = ("a cell", "a border", "a crossing")
    texts = [place["text"] for place in places]
    firsts = [next(k for k, text in enumerate(texts) if text.startswith(kind)) for kind in kinds]
    motion = describe_motion(plan, problem, plan) | {"speed": 0.25}
    parts = [write_player(motion), write_map(drawing, told)]
    acts = """<script>
      const said = {}, output = document.querySelector("output");
      const read = () => [output.textContent, document.querySelector(".cursor").getAttribute("x1")];
      said.first = read(); said.speed = document.querySelector("select").value;
      const slider = document.querySelector("input[type=range]");
      slider.value = 500; slider.dispatchEvent(new Event("input")); said.slid = read();
      const plot = document.querySelector(".plot"), box = plot.getBoundingClientRect();
      plot.setPointerCapture = () => {};
      plot.dispatchEvent(new PointerEvent("pointerdown",
        { clientX: box.left + box.width * (58 + 932 * 0.25) / 1000, clientY: box.top + 50 }));
      said.clicked = read();
      said.places = FIRSTS.map((k) => {
        document.querySelector(`.map #place-${k}`).dispatchEvent(new MouseEvent("click"));
        return [document.querySelector(".choice p").textContent,
                document.querySelectorAll(".pose polygon").length,
                document.querySelectorAll(".pose circle[visibility=visible]").length];
      });
      document.body.append(JSON.stringify(said));
    </script></body>""".replace("FIRSTS", str(firsts))
    text = build_page("heptagon", parts).replace("</body>", acts)
    found = re.findall(r'\{"first".*\}', open_in_browser(text, tmp_path, "#t=0.1"))
    said = json.loads(found[-1])
    cursor = [58 + 932 * share for share in (0.1 / plan.duration, 0.5, 0.25)]
    for key, x in zip(("first", "slid", "clicked"), cursor, strict=True):
        t = (x - 58) / 932 * plan.duration
        own = int(plan.phase[np.searchsorted(plan.t, t, side="right") - 1])
        assert said[key][0] == f"{float(said[key][0].split()[0]):.4f} s, phase {own + 1}"
        assert float(said[key][0].split()[0]) == pytest.approx(t, abs=1e-3 * plan.duration)
        assert float(said[key][1]) == pytest.approx(x, abs=1.0)
    assert said["speed"] == "0.25"
    # A cell, a border and a crossing, each with its contacts: the object and a dot for each.
    for (text, objects, dots), n_contacts in zip(said["places"], (3, 4, 5), strict=True):
        own = next(own for own in places if own["text"] in text)
        assert text.startswith(" ".join(own["contacts"]) + ": ")
        assert objects == 1 + dots and dots == len(own["contacts"]) >= n_contacts


def test_what_touches_at_a_place_of_the_map_is_told() -> None:
    drawing, told = tell_map()
    places = told["places"]
    # Each has its number in the drawing.
    ids = re.findall(r'id="place-(\d+)"', drawing)
    assert sorted(map(int, ids)) == list(range(len(places)))
    scene, freedoms = problem_of(HEPTAGON).scene, {"a cell": 3, "a border": 4, "a crossing": 5}
    table = {contact.name: k for k, contact in enumerate(contact_table(scene))}
    seen = set()
    for own in places:
        kind = next(kind for kind in freedoms if own["text"].startswith(kind))
        assert len(own["contacts"]) >= freedoms[kind]
        label = [table[name] for name in own["contacts"]]
        # Poses are rounded to 1e-5 m and rad, and links are 0.2 m long.
        z = np.array(own["z"])
        labels = np.broadcast_to(label, (len(z), len(label)))
        assert np.abs(evaluate_each(scene, labels, z).C).max() < 1e-5
        seen.add(kind)
    assert seen == set(freedoms)


def test_a_gallery_shows_every_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Few pictures show as much as many.
    monkeypatch.setattr("wholearm.viewer.movie.FRAMES", 5)
    problem, page, text = tmp_path / "slide.toml", tmp_path / "b/c.md", write_template("s", 4, 0.05)
    (tmp_path / "weak.toml").write_text(re.sub("(?m)^mass = .*", "mass = 90", text), "utf-8")
    problem.write_text(text, encoding="utf-8")
    paths = [str(tmp_path / f"{name}.toml") for name in ("slide", "none", "weak")]
    assert main(["gallery", *paths, "-o", str(page)]) == 2 and not page.exists()
    paths[1] = paths[0]
    assert main(["gallery", *paths, "-o", str(page)]) == 1
    assert f"wholearm: {paths[2]}: phase 1 is infeasible: " in capsys.readouterr().err
    text = page.read_text(encoding="utf-8")
    assert len(re.findall(rf"^\| {problem} \|.*\| ok \|$", text, re.M)) == 2
    assert re.search(r"weak.toml \| - \|.*\| no plan: phase 1 is infeasible: .*\|$", text, re.M)
    assert f"## {problem}: s\n" in text
    for name in re.findall(r"\]\((.*?)\)", text):
        assert (page.parent / name).stat().st_size < 1_000_000
    assert len(list(page.with_suffix("").iterdir())) == 4


def test_a_report_holds_what_was_given(tmp_path: Path) -> None:
    """A plan, and torques that lose a contact at once."""
    paths = [tmp_path / name for name in ("plan.npz", "torques.csv")]
    plan_of(HEPTAGON).save(str(paths[0]))
    paths[1].write_text("t,tau1,tau2\n0,3,2.1\n0.5,3,2.1\n", encoding="utf-8")
    source = HEPTAGON.read_text(encoding="utf-8")
    text = build_report(problem_of(HEPTAGON), list(map(str, paths)), source)
    for words in ("plan.npz", "ok: ", "v3-finger1", "[fingers.1]", "torques.csv"):
        assert words in text
    assert text.count("what verify says") == 2 and len(text) < 5e6
    assert "FAILED: c_n of v5-finger2 falls to " in text


class Grade(Enum):
    GOOD = "good"


class Place(NamedTuple):
    x: float
    name: str = ""


class Visit(NamedTuple):
    number: int
    place: Place | None
    pair: tuple[float, float]
    time: float


@dataclass(frozen=True, eq=False, repr=False)
class Tour(Result):
    """A result of its own: all that it has is a document."""

    name: str
    visits: tuple[Visit, ...]
    samples: Array = field(repr=False)
    grade: Grade = Grade.GOOD

    derived = ("ok",)

    @property
    def ok(self) -> bool:
        return all(own.place is not None for own in self.visits)

    @property
    def document(self) -> Document:
        columns = {"number": "phase:d", "place.name": "place", "place.x": "x [mm]:.1f"}
        columns |= {"pair": "tau [N m]:.2f", "time": "t [s]:.3f"}
        table = Table.of(self.visits, columns, "visits")
        return self.judge(self.name, "a <reason>", ["a line", "", table, "the end"])


VISITS = (
    Visit(1, Place(0.0125, "edge & tip"), (1.0, -2.0), 0.5),
    Visit(20, None, (0.25, 0.125), math.nan),
)
TOUR = Tour("tour", VISITS, np.zeros(3))


def test_text_is_lines_and_aligned_tables() -> None:
    assert TOUR.to_text().splitlines() == [
        "tour: FAILED: a <reason>",
        "a line",
        "",
        "visits",
        "phase  place       x [mm]   tau [N m]  t [s]",
        "    1  edge & tip    12.5  1.00 -2.00  0.500",
        "   20  -                -   0.25 0.12      -",
        "",
        "the end",
    ]
    assert repr(TOUR) == "Tour(tour: FAILED: a <reason>)" and TOUR.exit_status == 1


def test_plain_values_are_json() -> None:
    values = TOUR.to_dict()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values["ok"] is False and values["grade"] == "good" and "samples" not in values
    assert values["visits"][0]["place"] == {"x": 0.0125, "name": "edge & tip"}
    assert values["visits"][1] == {"number": 20, "place": None, "pair": [0.25, 0.125], "time": None}


def test_html_has_the_same_cells_and_names_escaped() -> None:
    text = TOUR._repr_html_()
    cells = [unescape(own) for own in re.findall(r">([^<>]+)<", text) if own.strip()]
    table = TOUR.document.parts[2]
    assert isinstance(table, Table)
    rows = [cell for row in (table.heads, *table.cells) for cell in row]
    assert cells == ["tour: FAILED: a <reason>", "a line", "visits", *rows, "the end"]
    assert text.count("<tr") == 3 and "<reason" not in text


def test_long_tables_are_cut_as_text_and_have_a_rule_as_markdown() -> None:
    table = Table(["n:d", "a:b:.1f", "word"], [(k, k / 2, "w") for k in range(5)], max_rows=2)
    text = table.to_text().splitlines()
    assert text[0].split() == ["n", "a:b", "word"] and len(text) == 4
    assert text[-1] == "... and 3 more, see --json"
    lines = table.to_markdown().splitlines()
    assert lines[:3] == ["| n | a:b | word |", "| ---: | ---: | --- |", "| 0 | 0.0 | w |"]
    assert len(lines) == 2 + 5


NOT_IN_0_1_0 = tuple(
    "rolling modes sequences complete attempts transcription duration time_intervals degree "
    "scheme opening clearance samples mode_search build_times solve_times transitions replay "
    "certify certificate".split()
)


def two_phases(path: Path = HEPTAGON) -> Problem:
    """The first two phases of a problem, the last one ending at rest."""
    first, second = (whole := problem_of(path)).phases[:2]
    return replace(whole, phases=(first, replace(second, end=whole.phases[-1].end)))


@pytest.fixture(scope="module")
def made() -> Plan:
    return solve(two_phases(), "effort", intervals=20, samples=21, time_weight=2.0)


@pytest.fixture(scope="module")
def within() -> Plan:
    """A plan in the time domain."""
    first = replace(two_phases(), phases=two_phases().phases[:1])
    return solve(first, transcription="time", time_intervals=4, certify=True)


@pytest.fixture(scope="module")
def certified() -> Plan:
    return solve(two_phases(), intervals=20, samples=5, replay=False, certify=True)


def change_meta(plan: Plan, path: Path, changed: dict[str, Any], gone: tuple[str, ...] = ()) -> str:
    meta = {key: value for key, value in plan.meta.items() if key not in gone} | changed
    replace(plan.trajectory, meta=meta).save(path)
    return str(path)


@pytest.mark.parametrize("which", ["made", "within", "certified"])
def test_a_plan_comes_back_from_its_file(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    plan: Plan = request.getfixturevalue(which)
    plan.save(tmp_path / "a.npz")
    loaded = load_plan(tmp_path / "a.npz")
    for name in "options status value phases transitions timings versions certificate".split():
        assert getattr(loaded, name) == getattr(plan, name), name
    assert loaded.replay == plan.replay and loaded.meta == plan.meta == write_meta(loaded)
    assert loaded.problem.table == plan.problem.table
    np.testing.assert_array_equal(loaded.trajectory.tau, plan.trajectory.tau)
    for phase, motion in zip(plan.problem.phases, loaded.trajectory.motions, strict=True):
        rows, formation = motion.evaluate(np.linspace(0.0, motion.duration, 98)), phase.formation
        contacts = sorted(formation.contacts, key=lambda own: motion.contacts.index(own.name))
        left = balance(formation.scene, contacts, formation.rolling, rows)
        assert np.abs(left.forces[1:-1]).max() < 1e-9


def test_a_plan_says_what_it_is(made: Plan) -> None:
    assert repr(made).startswith("Plan('heptagon") and "\n" not in repr(made)
    assert made.options == PlanOptions("effort", intervals=20, samples=21, time_weight=2.0)
    assert made.unit == "(N m)^2 s" and made.status is Status.SOLVED
    assert made.value == pytest.approx(sum(phase.value for phase in made.phases))
    assert made.duration == pytest.approx(sum(phase.duration for phase in made.phases))
    assert made.at(0.0).z[0] == pytest.approx(made.problem.start, abs=1e-9)
    report = verify(made.problem, made)
    assert report.ok and made.replay is not None
    arrivals = [phase.arrival for phase in made.replay.phases]
    assert arrivals == pytest.approx([phase.arrival for phase in report.phases])
    forces, torque = [phase.least_force for phase in report.phases], made.trajectory.torque
    assert made.trajectory.least_forces == [force[:2] for force in forces if force]
    dense = np.abs(torque.at(np.linspace(0.0, made.duration, 9999))).max()
    assert max(made.trajectory.largest_torques) == pytest.approx(dense, rel=1e-3)


def test_a_file_of_0_1_0_loads(made: Plan, tmp_path: Path) -> None:
    loaded = load_plan(change_meta(made, tmp_path / "a.npz", {}, NOT_IN_0_1_0))
    assert loaded.value == made.value and loaded.phases[0].duration == made.phases[0].duration
    assert loaded.options == PlanOptions("effort", intervals=20, time_weight=2.0, replay=False)
    assert loaded.replay is None and loaded.transitions == ()
    assert loaded.statistics.solves == made.statistics.solves


def test_a_certificate_has_every_phase_and_all_together(certified: Plan) -> None:
    certificate = certified.certificate
    assert certificate is not None and certificate.total is not None
    assert [part.phases for part in certificate.parts] == [(1,), (2,)]
    for part, phase in zip(certificate.parts, certified.phases, strict=True):
        assert part.bound is not None and part.error is not None and part.gap is not None
        assert part.duration == phase.duration and part.error < 1e-7 * part.bound
        # Twenty intervals are coarse. The bound is good to its error.
        assert -1e-7 < part.gap < 1e-2
    total = certificate.total
    assert total.phases == (1, 2) and total.duration == pytest.approx(certified.duration)
    assert total.bound == pytest.approx(sum(part.bound or 0 for part in certificate.parts))
    assert certified.meta["certificate"]["total"]["gap"] == total.gap
    text = describe_plan(certified, "a.npz").to_text()
    (table,) = (part for part in text.split("\n\n") if "lower bounds" in part)
    rows = [line.split() for line in table.splitlines()[1:]]
    assert [row[0] for row in rows] == ["1", "2", "all"]
    assert float(rows[2][2]) == pytest.approx(total.bound, abs=1e-8)


@pytest.mark.parametrize("error, said", [(1.4e-4, False), (1.6e-4, True), (2e-6, False)])
def test_an_accuracy_that_is_not_reached_is_said(certified: Plan, error: float, said: bool) -> None:
    """Where the error as it is printed, to one digit, is larger."""
    phases = tuple(own._replace(error=error) for own in certified.phases)
    plan = replace(certified, phases=phases, options=replace(certified.options, accuracy=1e-4))
    last = describe_plan(plan, "a.npz").to_text().splitlines()[-1]
    assert f"(to {error:.0e}" in last
    assert ("; accuracy 0.0001 not reached)" in last) == said


def test_what_is_planned_over_time_is_not_certified(within: Plan) -> None:
    certificate = within.certificate
    assert certificate is not None and certificate.total is None
    (part,) = certificate.parts
    assert part.bound is None and part.gap is None and part.phases == (1,)
    assert "  not certified: planned over time" in describe_plan(within, "a.npz").to_text()


@pytest.mark.parametrize(
    ("changed", "gone", "text"),
    [
        ({"status": "replayed"}, (), "'replayed' is not a valid Status"),
        ({"objective": "fast"}, (), "meta.objective: 'fast' given"),
        ({"phase_values": [1.0]}, (), "meta.phase_values: 1 values given, 2 needed"),
        ({"iterations": ["a", "b"]}, (), "does not describe a plan"),
        ({"transitions": [3]}, (), "does not describe a plan"),
        ({"replay": {}}, (), "does not describe a plan"),
        ({"certificate": {"parts": [3]}}, (), "does not describe a plan"),
        ({"timings": {"plan": "long"}}, (), "does not describe a plan"),
        ({}, ("value",), "does not describe a plan: 'value' is missing"),
        ({}, ("problem",), "does not hold its problem's tables"),
    ],
)
def test_what_is_no_plan_is_an_error(
    made: Plan, tmp_path: Path, changed: dict[str, Any], gone: tuple[str, ...], text: str
) -> None:
    path = change_meta(made, tmp_path / "a.npz", changed, gone)
    with pytest.raises(InputError, match=text) as caught:
        load_plan(path)
    assert str(caught.value).startswith(path)


@pytest.mark.parametrize(("path", "objective"), [(HEPTAGON, "margin"), (IMPACTS, "time")])
def test_every_solve_is_counted_once(
    monkeypatch: pytest.MonkeyPatch, path: Path, objective: str
) -> None:
    """Those of plans with stops, of least time, refined ones and what impacts save as well."""
    calls = []
    run = Solver.__call__

    def count(self: Solver, **arguments: Any) -> Any:
        result = run(self, **arguments)
        calls.append(self.function.stats()["iter_count"])
        return result

    monkeypatch.setattr(Solver, "__call__", count)
    problem = two_phases(path)
    plan = solve(problem, objective, intervals=20, samples=5)
    assert plan.statistics.solves == len(calls) > len(problem.phases)
    assert plan.statistics.iterations == sum(calls)
    assert plan.timings.solve == pytest.approx(plan.statistics.solve_time)
    solves = [phase.statistics.solves for phase in plan.phases]
    assert json.loads(json.dumps(plan.meta["solves"])) == solves
