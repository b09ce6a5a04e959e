"""Regions of grids, beside SciPy's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Patch, PathPatch
from matplotlib.text import Text
from scipy import ndimage

from crossing import hexagon
from shipped import HEPTAGON
from wholearm.cli.command import main
from wholearm.figures.map_figure import draw_map, find_room, split
from wholearm.mapping.borders import Window
from wholearm.mapping.formation_map import FormationMap, build_map
from wholearm.results.trajectory import Trajectory


@pytest.fixture(scope="module")
def figure(chart: FormationMap) -> Figure:
    return draw_map(chart)


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text)]


def test_axes_have_names_and_units_and_cover_the_window(
    figure: Figure, chart: FormationMap
) -> None:
    (axes,) = figure.axes
    assert axes.get_xlabel() == "x of the centroid [mm]"
    assert axes.get_ylabel() == "orientation \u03c6 [deg]"
    assert axes.get_xlim() == pytest.approx(tuple(1e3 * chart.x[[0, -1]]))
    assert axes.get_ylim() == pytest.approx(tuple(np.degrees(chart.phi[[0, -1]])))


def test_cells_edges_and_phases_are_named(figure: Figure, chart: FormationMap) -> None:
    shown = texts(figure)
    assert {"v1 | v3 | v6", "v1 | v4 | v6", "v0 | v3 | v5", "v0 | e2 | v0"} <= set(shown)
    assert [text for text in shown if text.isdigit()] == ["1", "2", "3", "4", "5"]
    assert {f"edge {edge} on\nthe palm" for edge in (6, 0, 1)} <= set(shown)


def test_labels_are_inside_their_cells(figure: Figure, chart: FormationMap) -> None:
    names = [
        " | ".join(f"{c.corner}{'*' if (c.surface, c.feature) == ('tip', 'v') else ''}" for c in f)
        for f in chart.formations
    ]
    labels = [text for text in figure.axes[0].texts if text.get_text() in names]
    assert len(labels) > 20
    for label in labels:
        x, phi = label.get_position()
        column = np.abs(1e3 * chart.x - x).argmin()
        row = np.abs(np.degrees(chart.phi) - phi).argmin()
        assert names[chart.cell[row, column]] == label.get_text()


def test_directed_lines_are_where_motion_is_possible(figure: Figure, chart: FormationMap) -> None:
    (axes,) = figure.axes
    strips = [c for c in axes.collections if isinstance(c, LineCollection)]
    by_colour = {to_hex(np.asarray(c.get_color())[0]).upper(): c for c in strips}
    # A line is moved aside by a few points: a few per cent of the axes' half.
    slack = 0.02 * np.array([np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())])
    for colour, name in (("#0072B2", "forth"), ("#D55E00", "back")):
        places = np.concatenate(
            [b.points[getattr(b, name)] for b in chart.borders if getattr(b, name).any()]
        )
        places = np.column_stack([1e3 * places[:, 0], np.degrees(places[:, 1])])
        for segment in by_colour[colour].get_segments():
            for point in np.asarray(segment)[:: len(segment) // 3 + 1]:
                assert (np.abs(places - point) < slack).all(axis=1).any()


def test_nothing_is_clipped_and_labels_do_not_overlap(figure: Figure) -> None:
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    width, height = figure.bbox.width, figure.bbox.height
    (axes,), (legend,) = figure.axes, figure.legends
    labels = [axes.xaxis.label, axes.yaxis.label, *axes.texts, *figure.texts, *legend.texts]
    for text in labels:
        box = text.get_window_extent()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height
    inside = [text.get_window_extent() for text in axes.texts]
    for k, box in enumerate(inside):
        assert not any(box.overlaps(other) for other in inside[:k])


def test_plan_is_drawn_over_the_map(chart: FormationMap, trajectory: Trajectory) -> None:
    lines = draw_map(chart, trajectory).axes[0].lines
    paths = [np.column_stack(line.get_data()) for line in lines]
    ends = [path[[0, -1]] for path in paths if len(path) > 50]
    assert len(ends) >= 5
    q = trajectory.q[[0, -1]]
    start, stop = (np.array([1e3 * row[0], np.degrees(row[2])]) for row in q)
    assert any(np.allclose(end[0], start) for end in ends)
    assert any(np.allclose(end[-1], stop) for end in ends)


def test_command_writes_the_figure(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    chart: FormationMap,
    trajectory: Trajectory,
) -> None:
    monkeypatch.chdir(tmp_path)
    trajectory.save("plan.npz")
    with monkeypatch.context() as patch:
        patch.setattr("wholearm.mapping.formation_map.build_map", lambda *_, **__: chart)
        assert main(["map", str(HEPTAGON), "--plan", "plan.npz"]) == 0
        assert capsys.readouterr().out == "wrote map_heptagon_four_contacts.png\n"
        data = (tmp_path / "map_heptagon_four_contacts.png").read_bytes()
        assert data[:4] == b"\x89PNG"
        listing = ["--list", "0.045,-1.98", "0.03,-1.98"]
        assert main(["map", str(HEPTAGON), "-o", "m.svg", *listing]) == 0
    captured = capsys.readouterr()
    assert "contacts = [" in captured.out and captured.err == "wrote m.svg\n"
    assert (tmp_path / "m.svg").read_bytes()[:5] == b"<?xml"


def test_overlap_of_the_fingers_has_its_own_hatching(figure: Figure) -> None:
    window = Window((-0.06, 0.05), (np.radians(-15.0), np.radians(15.0)))
    drawn = draw_map(build_map(hexagon((0.19, 0.19), -0.085), 60, window))
    label = "the fingers would overlap"
    assert label in texts(drawn) and label not in texts(figure)
    legend = drawn.legends[0]
    looks = {
        text.get_text(): patch
        for text, patch in zip(legend.get_texts(), legend.legend_handles, strict=True)
    }
    patches = [own for own in drawn.axes[0].patches if isinstance(own, PathPatch)]
    (crossed,) = [own for own in patches if own.get_hatch() is not None]
    own, other = looks[label], looks["cannot be reached"]
    assert isinstance(own, Patch) and isinstance(other, Patch)
    assert crossed.get_hatch() == own.get_hatch() != other.get_hatch()
    assert crossed.get_facecolor() == own.get_facecolor()


@pytest.mark.parametrize("seed", range(6))
def test_parts_and_their_rooms_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    field = ndimage.gaussian_filter(rng.normal(size=(40, 50)), rng.uniform(0.5, 4.0))
    cell = np.digitize(field, np.quantile(field, [0.2, 0.5, 0.8])) - 1
    step, parts = rng.uniform(0.2, 3.0, 2), list(split(cell))
    expected = []
    for k in range(3):
        number, count = ndimage.label(cell == k)
        expected += [(k, number == n + 1) for n in range(count)]
    assert [k for k, _ in parts] == [k for k, _ in expected]
    for (_, region), (_, other) in zip(parts, expected, strict=True):
        np.testing.assert_array_equal(region, other)
        room = ndimage.distance_transform_edt(np.pad(other, 1), sampling=step)[1:-1, 1:-1]
        row, column, found = find_room(region, step)
        assert found == pytest.approx(room.max()) == pytest.approx(room[row, column])
