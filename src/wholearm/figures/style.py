"""Style of figures: sizes, colours, lines and text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.fields import Range

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 10.0  # default width of a figure [in]
WIDTHS = Range(3.0, 40.0)  # least and largest width [in]
# Okabe and Ito's colours without yellow and black, which here are Tol's wine and a grey.
PALETTE = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#882255", "#56B4E9", "#D55E00", "#777777",
)  # fmt: skip
LINES: Any = (("-", "o"), ((0, (5, 1.5)), "s"), ((0, (1.5, 1)), "D"))  # and markers
BODY = "#fbf3df"  # face of the object
FINGERS = (("#444444", "#c4c4c4"), ("#999999", "#ececec"))  # line and face
BAND, LOW, LOST, INK, GRID = "#eef1f5", "#fff4d9", "#f6d5cc", "#222222", "#c4c9d0"
STYLE: Any = {
    "font.family": "sans-serif", "font.sans-serif": ["DejaVu Sans"], "font.size": 9.0,
    "axes.linewidth": 0.8, "axes.spines.top": False, "axes.spines.right": False,
    "lines.solid_capstyle": "butt", "lines.dash_capstyle": "butt", "path.simplify": False,
    "legend.frameon": False, "legend.fontsize": 9.0, "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0, "legend.handlelength": 1.6, "legend.borderpad": 0.0,
    "pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "wholearm",
}  # fmt: skip
PALM = 0.12  # thickness of the palm, over the object's radius of gyration


class ContactStyle(NamedTuple):
    """Style of one contact, in the snapshots and over time."""

    colour: str
    line: Any
    marker: str


Styles = Mapping[str, ContactStyle]


@contextmanager
def open_figure(width: float, height: float, **options: Any) -> Iterator[Figure]:
    """A figure with a size in inches, and the common style while it is open."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), **options)
        FigureCanvasAgg(figure)
        yield figure


def inset(
    figure: Figure, left: float, bottom: float, width: float, height: float, **options: Any
) -> Axes:
    """Axes at a place of a figure [in]."""
    place = np.array([left, bottom, width, height]) / np.tile(figure.get_size_inches(), 2)
    return figure.add_axes(tuple(place.tolist()), **options)


def add_line(axes: Axes, points: Array, **look: Any) -> Artist:
    """Draw a line through points, shape (n, 2), without a change of the limits of the axes."""
    from matplotlib.lines import Line2D

    return axes.add_artist(Line2D(*points.T, **look))


def choose_prefix(size: float) -> tuple[str, float]:
    """SI prefix with which values up to `size` have few digits, and the factor to it."""
    steps = (
        (1e13, "T", 1e-12), (1e10, "G", 1e-9), (1e7, "M", 1e-6), (1e4, "k", 1e-3), (0.3, "", 1.0),
        (3e-4, "m", 1e3), (3e-7, "\u00b5", 1e6), (0.0, "n", 1e9),
    )  # fmt: skip
    return next((prefix, factor) for least, prefix, factor in steps if size >= least)


def unit_of(axes: Axes) -> str:
    """The unit in the label of axes, in brackets."""
    label = axes.get_ylabel()
    return label[label.index("[") : label.index("]") + 1]


def list_contacts(axes: Axes, room: float, largest: float = 9.0) -> None:
    """Write the legend of axes to their right, with letters that fit a height `room` [points]."""
    keys = axes.get_legend_handles_labels()
    count = max(len(keys[1]), 1)
    size = min(largest, room / (1.1 * count))
    look: Any = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.02), "fontsize": size}
    axes.legend(*keys, **look, labelspacing=min(0.5, max(room / (size * count) - 1.0, 0.05)))


def write_title(figure: Figure, text: str, size: float = 10.5, left: float = 0.2) -> None:
    """Write the title of a figure at its upper left corner, `left` inches from the edge."""
    width, height = figure.get_size_inches()
    look: Any = {"fontsize": size, "fontweight": "bold", "parse_math": False}
    figure.text(left / width, 1 - 0.12 / height, text, va="top", **look)


def choose_styles(contacts: Sequence[str]) -> dict[str, ContactStyle]:
    """Give every contact its own combination of colour, line and marker."""
    looks = [ContactStyle(colour, *rest) for rest in LINES for colour in PALETTE]
    return dict(zip(contacts, cycle(looks), strict=False))


def write(axes: Axes, text: str, place: Any, shift: Any, **look: Any) -> Artist:
    """Write `text` at a place, shifted by points."""
    options: Any = {"ha": "center", "fontsize": 9, "zorder": 5, "textcoords": "offset points"}
    return axes.annotate(text, tuple(place), tuple(shift), **(options | look))
