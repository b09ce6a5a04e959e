"""The object: a rigid convex polygon, checked when it is made."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array
from ..common.errors import InputError, frozen
from ..common.fields import POINT, POSITIVE, FieldKind, declare, key, read_keys
from .ranges import INERTIA, MASS

SIZES = (1e-4, 1e3)
"""Least and largest distance between the two corners of a polygon that are farthest apart [m]."""
FAR = 1e3  # largest distance of given corners from the origin, over that distance
SLENDER = 1e-3  # least width of a polygon, over that distance
SHORTEST_EDGE = 1e-4  # least length of an edge, over that distance
MOST_VERTICES = 500  # most corners of a polygon


def _read_corners(given: object, key: str) -> Array:
    if not isinstance(given, list | tuple | np.ndarray) or len(given) < 3:
        raise InputError("", key, f"{given!r} is not a list of 3 or more points")
    if len(given) > MOST_VERTICES:
        allowed = f"allowed are 3 to {MOST_VERTICES}"
        raise InputError("", key, f"{len(given)} corners given; {allowed}")
    return frozen([POINT.read(point, f"{key}[{k}]") for k, point in enumerate(given)])


CORNERS = FieldKind(
    _read_corners,
    {"type": "array", "minItems": 3, "maxItems": MOST_VERTICES, "items": POINT.schema},
)


@declare(
    key(
        "vertices",
        "Corners of a convex polygon, anticlockwise, from any origin [m].",
        *(CORNERS, "length"),
        attribute="points",
    ),
    key("mass", "[kg]", POSITIVE, "mass", MASS),
    key(
        "inertia",
        "About the centroid [kg m^2]; by default that of uniform density.",
        *(POSITIVE, "inertia", INERTIA),
    ),
)
@dataclass(frozen=True, eq=False)
class Polygon:
    """The object: a rigid convex polygon.

    Raises
    ------
    InputError  if the corners are not those of a convex anticlockwise polygon, or a number is not
                positive; if the polygon is too small, too large or too slender, or has too short an
                edge
    """

    points: ArrayLike
    mass: float
    inertia: float | None = None
    # (n_v, 2) [m]: corners relative to the centroid, in the orientation phi = 0
    vertices: Array = field(init=False, repr=False)
    # (2,) [m]: the centroid in the frame of `points`
    centroid: Array = field(init=False, repr=False)
    # [kg m^2]: what the inertia about the centroid would be for uniform density
    uniform_inertia: float = field(init=False, repr=False)
    size: float = field(init=False, repr=False)  # [m]: largest distance between two corners

    def __post_init__(self) -> None:
        read_keys(self, "object.")
        corners = np.asarray(self.points)
        size = _check_size(corners)
        edges = np.roll(corners, -1, axis=0) - corners
        # About a corner: far from the origin, areas would lose their digits.
        local = corners - corners[0]
        cross = cross_product(local, np.roll(local, -1, axis=0))
        area = cross.sum() / 2
        if area <= 0:
            text = f"the polygon is clockwise or flat (signed area {area:.3g} m^2); "
            raise InputError("", "object.vertices", f"{text}list its corners anticlockwise")
        turns = cross_product(np.roll(edges, 1, axis=0), edges)
        headings = np.arctan2(turns, np.sum(np.roll(edges, 1, axis=0) * edges, axis=1))
        reflex = np.flatnonzero(turns <= 1e-9 * area)
        if reflex.size:
            text = f"the polygon is not strictly convex at {corners[reflex[0]].tolist()}; "
            key = f"object.vertices[{reflex[0]}]"
            raise InputError("", key, f"{text}every corner must turn left")
        _check_shape(corners, edges, size)
        if headings.sum() > 2 * np.pi + 1e-6:
            raise InputError("", "object.vertices", "the polygon crosses itself; it must be convex")
        neighbours = local + np.roll(local, -1, axis=0)
        middle = (neighbours * cross[:, None]).sum(axis=0) / (6 * area)
        vertices = local - middle
        after = np.roll(vertices, -1, axis=0)
        squares = (vertices**2 + vertices * after + after**2).sum(axis=1)
        uniform = self.mass * float(cross_product(vertices, after) @ squares) / (12 * float(area))
        object.__setattr__(self, "vertices", frozen(vertices))
        object.__setattr__(self, "centroid", frozen(corners[0] + middle))
        object.__setattr__(self, "inertia", uniform if self.inertia is None else self.inertia)
        object.__setattr__(self, "uniform_inertia", uniform)
        object.__setattr__(self, "size", size)

    @property
    def n_vertices(self) -> int:
        """Number of corners, which is also the number of edges."""
        return len(self.vertices)

    @property
    def gyration_radius(self) -> float:
        """Radius of gyration about the centroid [m], which weighs angles against lengths."""
        assert self.inertia is not None
        return math.sqrt(self.inertia / self.mass)

    def flush_angle(self, edge: int) -> float:
        """Angle phi in (-pi, pi] at which `edge` lies on the palm below the object [rad]."""
        run = self.vertices[(edge + 1) % self.n_vertices] - self.vertices[edge]
        return -math.atan2(run[1], run[0])


def _check_size(corners: Array) -> float:
    """Largest distance between two corners [m], if that is neither too small nor too large."""
    key, (least, largest) = "object.vertices", SIZES
    if np.abs(corners).max() > FAR * largest:
        far = corners[int(np.abs(corners).max(axis=1).argmax())].tolist()
        raise InputError("", key, f"{far} given; allowed are coordinates up to {FAR * largest:g} m")
    size = float(np.hypot(*(corners[:, None] - corners).transpose(2, 0, 1)).max())
    if not least <= size <= largest:
        raise InputError(
            "", key, f"{size:.3g} m from corner to corner; allowed are {least:g} to {largest:g} m"
        )
    if np.abs(corners).max() > FAR * size:
        raise InputError(
            "",
            key,
            f"{np.abs(corners).max():.3g} m from the origin; allowed are {FAR * size:.3g} m, "
            f"{FAR:g} times the polygon's size",
        )
    return size


def _check_shape(corners: Array, edges: Array, size: float) -> None:
    """Check that a convex polygon is not too slender, and that it has no too short edge."""
    lengths = np.hypot(*edges.T)
    shortest = int(lengths.argmin())
    if lengths[shortest] < SHORTEST_EDGE * size:
        raise InputError(
            "",
            f"object.vertices[{shortest}]",
            f"the edge from there has {lengths[shortest]:.3g} m; allowed are "
            f"{SHORTEST_EDGE * size:.3g} m and more, {SHORTEST_EDGE:g} of the polygon's size",
        )
    away = cross_product(edges[:, None], corners - corners[:, None]) / lengths[:, None]
    width = float(away.max(axis=1).min())
    if width < SLENDER * size:
        raise InputError(
            "",
            "object.vertices",
            f"the polygon is {width:.3g} m wide; allowed are {SLENDER * size:.3g} m and more, "
            f"{SLENDER:g} of its size",
        )


def cross_product(a: Array, b: Array) -> Array:
    """Plane cross product a_x b_y - a_y b_x along the last axis."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
