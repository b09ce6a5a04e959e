from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Text

import tipping
from wholearm import plots
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.figures.curves import draw_torques
from wholearm.figures.plot_data import choose_snapshots, find_steps
from wholearm.figures.snapshots import choose_numbers, draw_snapshot
from wholearm.figures.style import WIDTH, choose_styles
from wholearm.problem.definition import Problem
from wholearm.results.dwell_record import assemble
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Trajectory


@dataclasses.dataclass
class Replayed:
    t: Array
    phase: Any
    tau: Array
    c_n: Array


@pytest.fixture(scope="module")
def problem(heptagon: Problem) -> Problem:
    return heptagon


@pytest.fixture(scope="module")
def planned(trajectory: Trajectory) -> Trajectory:
    return trajectory


@pytest.fixture(scope="module")
def figure(planned: Trajectory) -> Figure:
    return plots.force_margins(planned)


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
    """The trajectory's phases in another order and number, with torques joined from samples."""
    motions = [trajectory.motions[k] for k in phases]
    parts = [trajectory.phase == k for k in phases]
    starts = np.cumsum([0.0, *(motion.duration for motion in motions)])
    t = [
        trajectory.t[p] - trajectory.t[p][0] + start
        for p, start in zip(parts, starts[:-1], strict=True)
    ]
    tau = np.concatenate([trajectory.tau[part] for part in parts])
    joined = np.maximum.accumulate(np.concatenate(t))
    return assemble(motions, TorqueProfile.join_rows(joined, tau), trajectory.meta, 101)


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
    chosen = [text for text in figure.findobj(Text) if id(text) in drawn]
    shown = [t for t in chosen if isinstance(t, Text) and t.get_visible() and t.get_text().strip()]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in shown]


def check_layout(figure: Figure) -> None:
    """No text outside the figure, none upon another, none smaller than 8 points."""
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
        assert float(text.get_fontsize()) >= 8


def test_figure_has_a_strip_and_two_panels_with_units(figure: Figure) -> None:
    *strip, margins, torques = figure.axes
    assert len(strip) == 6
    assert "[N]" in margins.get_ylabel()
    assert "[N m]" in torques.get_ylabel()
    assert "[s]" in torques.get_xlabel()
    assert margins.get_xlim() == torques.get_xlim()


def test_strip_has_one_scale_and_its_bar(figure: Figure) -> None:
    figure.canvas.draw()
    scales = []
    for axes in figure.axes[:6]:
        box, (left, right), (low, high) = axes.bbox, axes.get_xlim(), axes.get_ylim()
        scales += [box.width / (right - left), box.height / (high - low)]
    np.testing.assert_allclose(scales, scales[0], rtol=1e-6)
    assert "50 mm" in [text.get_text() for text in figure.texts]
    (bar,) = (own for own in figure.artists if isinstance(own, Line2D))
    assert np.ptp(data_of(bar)[0]) * figure.dpi / scales[0] == pytest.approx(0.05)


@pytest.mark.parametrize("count", [3, 4, 7, 12, 30, 50])
@pytest.mark.parametrize("thin", [1.0, 0.12])
def test_numbers_at_vertices_stand_apart(count: int, thin: float) -> None:
    angles = 2 * np.pi * (np.arange(count) + 0.5) / count
    vertices = 40 * np.column_stack([np.cos(angles), thin * np.sin(angles)])
    found = choose_numbers(vertices, [1])
    places = {str(k): vertices[k] + own for k, own in found.items()}
    for (one, a), (other, b) in itertools.combinations(places.items(), 2):
        wide = 0.32 * 8 * (len(one) + len(other))
        assert abs(a[0] - b[0]) > wide or abs(a[1] - b[1]) > 8
    assert 1 in found
    assert len(found) >= 3 or (thin < 1.0 and count > 4)
    if count <= 7 and thin == 1.0:
        assert len(found) == count


@pytest.mark.parametrize(
    ("size", "prefix"), [(5e-4, "m"), (2e-6, "\u00b5"), (2.0, ""), (400.0, ""), (1e5, "k")]
)
def test_units_suit_the_size(axes: Axes, size: float, prefix: str) -> None:
    torque = TorqueProfile(np.array([0.0, 1.0]), np.full((1, 2, 1), 0.5 * size))
    draw_torques(axes, torque, np.array([size, size]))
    axes.figure.canvas.draw()
    assert f"[{prefix}N m]" in axes.get_ylabel()
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert max(map(len, labels)) <= 5


def test_margins_are_the_trajectory_with_breaks_at_phases(
    figure: Figure, planned: Trajectory
) -> None:
    margins, steps = figure.axes[-2], find_steps(planned)
    assert set(np.flatnonzero(np.diff(planned.phase)) + 1) <= set(steps)
    added = np.insert(np.zeros(len(planned.t), dtype=bool), np.repeat(steps, 2), True)
    for index, name in enumerate(planned.contacts):
        t, values = data_of(line_of(margins, name))
        np.testing.assert_array_equal(t[~added], planned.t)
        np.testing.assert_array_equal(values[~added], planned.c_n[:, index] - 0.05)
        # At a step the line breaks upright: it lasts until then, and goes on from there.
        np.testing.assert_array_equal(t[added], np.repeat(planned.t[steps], 2))
        before = planned.c_n[steps - 1, index] - 0.05
        np.testing.assert_array_equal(values[added][::2], before)
        assert np.isnan(values[added][1::2]).all()


def test_zero_line_and_limits_are_there(
    figure: Figure, planned: Trajectory, problem: Problem
) -> None:
    margins, torques = figure.axes[-2:]
    assert 0.0 in levels(margins)
    low, high = margins.get_ylim()
    assert low < -problem.epsilon and high > np.nanmax(planned.c_n) - problem.epsilon
    limits = problem.scene.torque_limit
    assert sorted(y for y in levels(torques) if y) == sorted([*limits, *-limits])
    for line in torques.lines:
        if line.get_label() == "limits":
            assert line.is_dashed()


def test_torque_lines_have_both_ends_of_every_step(axes: Axes) -> None:
    profile = TorqueProfile(
        np.array([0.0, 0.5, 2.0]),
        np.array([[[0.25, 0.25, 0.0], [1.0, 0.0, 0.0]], [[-1.0, 0.0, 0.5], [1.0, 0.0, 0.0]]]),
    )
    line, other = draw_torques(axes, profile, np.array([2.0, 2.0]))
    t, tau = data_of(line)
    np.testing.assert_allclose(tau[t == 0.5], [0.5, -0.5])
    inside = t != 0.5
    np.testing.assert_allclose(tau[inside], profile.at(t[inside])[:, 0], atol=1e-12)
    np.testing.assert_allclose(data_of(other)[1], 1.0)


def test_planned_torques_are_drawn_exactly(figure: Figure, planned: Trajectory) -> None:
    for index in range(2):
        t, tau = data_of(line_of(figure.axes[-1], f"finger {index + 1}"))
        inside = np.abs(t[:, None] - planned.torque.breaks).min(axis=1) > 1e-9
        expected = planned.torque.at(t[inside])[:, index]
        np.testing.assert_allclose(tau[inside], expected, atol=1e-10)


@pytest.mark.parametrize("row", [0, 320, -1])
def test_snapshot_is_to_scale(axes: Axes, planned: Trajectory, problem: Problem, row: int) -> None:
    z, names = planned.z[row], planned.motions[planned.phase[row]].contacts
    scene, styles = problem.scene, choose_styles(planned.contacts)
    _, *links, body = draw_snapshot(axes, scene, z, names, styles)[:4]
    c, s = np.cos(z[2]), np.sin(z[2])
    corners = [(z[0] + c * x - s * y, z[1] + s * x + c * y) for x, y in scene.polygon.vertices]
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
        found = np.ravel(data_of(marks[name]))
        vertex = corners[int(name[1])]
        np.testing.assert_allclose(found, vertex, atol=1e-12)
    numbers = [text.get_text() for text in axes.texts]
    assert numbers == [str(i) for i in range(7)]


def test_snapshots_are_at_least_six_and_one_of_every_phase(planned: Trajectory) -> None:
    for phases in ([0], [0, 1], [0, 1, 2], [0, 1, 2, 3], list(range(5)), [0, 1] * 5):
        trajectory = repeat(planned, phases)
        rows = choose_snapshots(trajectory)
        assert len(rows) == max(6, len(phases) + 1)
        assert rows[0] == 0 and rows[-1] == len(trajectory.t) - 1
        assert (np.diff(rows) > 0).all()
        boundaries = np.flatnonzero(np.diff(trajectory.phase)) + 1
        assert set(boundaries) <= set(rows)


@pytest.mark.parametrize("width", [3.5, 7.0])
def test_text_is_inside_and_apart_in_other_widths(width: float, planned: Trajectory) -> None:
    figure = plots.force_margins(planned, width=width, motion=True)
    assert figure.get_figwidth() == width
    check_layout(figure)
    pose, angles, speeds = figure.axes[-3:]
    assert data_of(line_of(pose, "x [mm]"))[1][-1] == pytest.approx(1e3 * planned.q[-1, 0])
    assert data_of(line_of(angles, "finger 2"))[1][0] == pytest.approx(
        np.degrees(planned.theta[0, 1])
    )
    assert np.nanmax(data_of(line_of(speeds, "finger 1"))[1]) == planned.theta_dot[:, 0].max()


@pytest.mark.parametrize("width", [2.0, 50.0, float("nan")])
def test_widths_that_are_no_paper_are_refused(width: float, planned: Trajectory) -> None:
    with pytest.raises(InputError, match="width"):
        plots.force_margins(planned, width=width)


def test_simulation_is_drawn_over_the_plan(planned: Trajectory) -> None:
    c_n = planned.c_n.copy()
    c_n[100, 0] = -3.0
    simulation: Any = Replayed(planned.t, planned.phase, planned.tau, c_n)
    figure = plots.force_margins(planned, simulation=simulation)
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
    planned: Trajectory, tmp_path: Path
) -> None:
    short = repeat(planned, [0])
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


def test_trajectory_without_its_problem_is_refused(planned: Trajectory) -> None:
    bare = dataclasses.replace(planned, meta={"epsilon": 0.05})
    with pytest.raises(InputError, match=r"meta\.problem"):
        plots.force_margins(bare)


def test_odd_names_are_drawn_as_they_are(planned: Trajectory) -> None:
    short = repeat(planned, [0])
    for name in ("cost $5 and \\frac{" + 20 * " a long name", ""):
        meta = {**planned.meta, "name": name}
        check_layout(plots.force_margins(dataclasses.replace(short, meta=meta)))


def test_settings_of_matplotlib_are_left_alone_and_pyplot_is_not_imported(
    planned: Trajectory, tmp_path: Path
) -> None:
    planned.save(tmp_path / "plan.npz")
    code = (
        "import sys, matplotlib, wholearm\n"
        "before = matplotlib.rcParams.copy()\n"
        f"plan = wholearm.load_trajectory({str(tmp_path / 'plan.npz')!r})\n"
        "figure = wholearm.plots.force_margins(plan)\n"
        f"wholearm.plots.save(figure, {str(tmp_path / 'a.svg')!r})\n"
        "assert matplotlib.rcParams.copy() == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_friction_cones_have_a_panel_of_their_own(figure: Figure) -> None:
    plan = tipping.tipped()
    drawn = plots.force_margins(plan)
    check_layout(drawn)
    assert len(drawn.axes) == len(figure.axes) + 1
    margins, torques, cones = drawn.axes[-3:]
    assert margins.get_position().y0 > cones.get_position().y1
    assert cones.get_position().y0 > torques.get_position().y1
    t, shares = data_of(line_of(cones, "v1-palm"))
    known = ~np.isnan(t)
    column = plan.contacts.index("v1-palm")
    expected = np.where(
        plan.phase == 1, plan.c_t[:, column] / (tipping.PALM * plan.c_n[:, column]), np.nan
    )
    np.testing.assert_allclose(shares[known], expected, rtol=1e-12)
    assert np.nanmax(np.abs(shares)) < 1 and levels(cones) == [-1.0, 1.0, 0.0]
    margin_line = line_of(margins, "v1-palm")
    assert line_of(cones, "v1-palm").get_color() == margin_line.get_color()
