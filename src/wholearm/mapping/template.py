"""Templates of problem files: a polygon, a hand scaled to it, and a slide on one edge."""

from __future__ import annotations

import math
import tomllib
from itertools import product

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, require_number
from ..problem.read import build_problem
from ..scene.polygon import Polygon
from .formation_list import format_route, list_formations

_MOST = 50  # Corners of a polygon that a file still shows well
_SIZE, _MASS = 0.05, 0.2  # radius [m] and mass [kg] of the reference object
# x of the left joint and of the start over the size, of polygons with five and more corners and of
# others; and the length of the slide. The right joint is at 1.6.
_LEFT, _START, _SLIDE = (-1.6, -0.2), (0.3, 1.2), 0.4
# Other hands and starts for given vertices.
_OTHERS = tuple(product((True, False), (1.2, 0.8, 0.3, 0.0)))
_COMMENTS = 31  # Column of the comments


def write_template(
    name: str,
    corners: int = 7,
    size: float = _SIZE,
    mass: float | None = None,
    vertices: Array | None = None,
) -> str:
    """Write a problem file about a polygon that slides to the left on one edge.

    Parameters
    ----------
    size : [m]             from the centroid to the corners
    mass : [kg]            by default that of a plate as thick and heavy as those in `problems/`
    vertices : (n, 2) [m]  anticlockwise, in place of those of a regular polygon of that size

    Raises
    ------
    InputError  if a number is out of its range
    """
    given = vertices is not None
    if vertices is not None:
        body = Polygon(vertices, 1.0)
        corners, size = body.n_vertices, float(np.hypot(*body.vertices.T).max())
    if not 3 <= corners <= _MOST:
        raise InputError("", "--polygon", f"{corners} given; allowed are 3 to {_MOST}")
    scale = require_number(size, "--size", positive=True) / _SIZE
    weight = _MASS * scale**2 if mass is None else require_number(mass, "--mass", positive=True)
    if vertices is None:
        angles = -math.pi / 2 + math.pi * (2 * np.arange(corners) - 1) / corners
        # Rounded, so that a corner above the centroid is at zero.
        vertices = size * np.column_stack([np.cos(angles), np.sin(angles)]).round(12)
    few = corners < 5
    tried = [(few, _START[few]), *(_OTHERS if given else ())]
    for last, (wide, start) in zip([*tried[1:], None], tried, strict=True):
        try:
            return _write(name, vertices, size, weight, wide, start)
        except InputError:
            if last is None:
                raise
    raise AssertionError


def _write(name: str, vertices: Array, size: float, weight: float, few: bool, start: float) -> str:
    """The file for one hand and a start, over the size."""
    corners, scale, heavy = len(vertices), size / _SIZE, weight / _MASS
    finger = {
        "length": ((0.22 if few else 0.14) * scale, "m, joint to tip centre"),
        "radius": (0.005 * scale, "m, half thickness of the link"),
        "inertia": (0.005 * heavy * scale**2, "kg m^2, about the joint"),
        "viscous": (0.01 * heavy * scale**1.5, "N m s, friction of the joint"),
        "dry": (0.01 * heavy * scale, "N m, dry friction of the joint"),
        "torque_limit": (2.0 * heavy * scale, "N m"),
    }
    lines = [
        f"# A polygon with {corners} corners slides to the left on edge 0. Units: m, kg, s, rad.",
        _row("name", f'"{name}"', ""),
        _row("epsilon", _show(0.05 * heavy), "N, least normal force of every contact"),
        _row("gravity", "9.81", "m/s^2"),
        "\n[object]",
        f"# corners, anticlockwise [m]; the inertia is that of uniform density\n"
        f"vertices = [{', '.join(f'[{_show(x)}, {_show(y)}]' for x, y in vertices)}]",
        _row("mass", _show(weight), "kg"),
    ]
    for number, side, word in ((1, 1.6, "right"), (2, _LEFT[few], "left")):
        base = f"[{_show(side * size)}, {_show(-0.2 * size)}]"
        lines += [f"\n{f'[fingers.{number}]':<{_COMMENTS}}# {word}", _row("base", base, "m, joint")]
        lines += [_row(key, _show(value), text) for key, (value, text) in finger.items()]
    lines.append(f"\n{'[friction]':<{_COMMENTS}}# coefficient with the object")
    lines += [_row(part, "0.05", "") for part in ("palm", "finger1", "finger2")]
    lines += ["\n[start]", _row("flush", "0", "this edge lies on the palm")]
    lines += [_row("x", _show(start * size), "m, centroid; both fingers close on the object")]
    text = "\n".join(lines) + "\n"
    problem = build_problem(tomllib.loads(text))
    x, _, phi = (float(value) for value in problem.start[:3])
    route = list_formations(problem, (x, phi), ((start - _SLIDE) * size, phi))
    return text + "\n" + format_route(route)


def _row(key: str, value: str, comment: str) -> str:
    text = f"{key} = {value}"
    return f"{text:<{_COMMENTS}}# {comment}" if comment else text


def _show(value: float) -> str:
    """A number of four digits, as TOML has it."""
    return f"{float(f'{value:.4g}') + 0.0!r}"
