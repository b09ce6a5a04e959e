"""The data model: a polygon, a hand of a palm and two fingers, friction and gravity.

The notation that every docstring of the package refers to:

========  =======================================================  ============
symbol    meaning                                                  shape, unit
========  =======================================================  ============
q         pose (x, y, phi) of the object's centroid                (3,) m, rad
theta     joint angles, anticlockwise from +x                      (2,) rad
z         the five degrees of freedom (q, theta)                   (5,)
C         C-functions: signed gaps, positive when apart            (n_c,) m
W_n, W_t  normal and tangential wrench matrices of the object      (3, n_c)
J_n, J_t  normal and tangential Jacobians of the fingers           (n_c, 2)
c_n, c_t  normal and tangential wrench intensities                 (n_c,) N
U, Xi     friction coefficients; sliding directions (+1 or -1)     (n_c,)
tau       joint torques                                            (2,) N m
A, A_t    [W_n^T, -J_n] and [W_t^T, -J_t]                          (n_c, 5)
c         contact forces: c_n, then c_t of the R rolling contacts  (n_c + R,) N
P         constraints: A, then A_t of rolling contacts             (n_c + R, 5)
G         forces: A - U Xi A_t, then A_t of rolling contacts       (n_c + R, 5)
M5        diag(m, m, I, J_1, J_2)                                  (5, 5)
========  =======================================================  ============

Finger 1 (index 0) is the right one, finger 2 (index 1) the left one. The normal n of a contact
points into the object and its tangent is t = (n_y, -n_x).

References
----------
S. L. Yeap and J. C. Trinkle, "Dynamic Whole-Arm Dexterous Manipulation in the Plane".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError

Array = NDArray[np.float64]

TOUCHING = 3e-6
"""Gap below which features count as touching, in radii of gyration of the object."""


def require_number(
    value: object, key: str, *, positive: bool = False, nonnegative: bool = False
) -> float:
    """Return `value` as a finite float, or raise `InputError` naming `key`."""
    allowed = "a positive number" if positive else "a number >= 0" if nonnegative else "a number"
    real = isinstance(value, int | float | np.integer | np.floating)
    try:
        result = float(value) if real and not isinstance(value, bool) else math.nan  # type: ignore[arg-type]
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise InputError("", key, f"{value!r} is not {allowed} (finite)")
    if (positive and result <= 0) or (nonnegative and result < 0):
        raise InputError("", key, f"{value!r} is not {allowed}")
    return result


def require_vector(value: object, key: str, size: int) -> Array:
    """Return `value` as a read-only float array of `size` finite numbers, or raise `InputError`."""
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != size:
        raise InputError("", key, f"{value!r} is not a list of {size} numbers")
    return _frozen([require_number(item, key) for item in value])


def _frozen(value: ArrayLike) -> Array:
    array = np.array(value, dtype=float)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Polygon:
    """The object: a rigid convex polygon.

    Parameters
    ----------
    points : array_like, shape (n_v, 2), [m]
        Corners, anticlockwise, in any frame.
    mass : float, [kg]
    inertia : float, optional, [kg m^2]
        About the centroid; that of uniform density when left out.

    Attributes
    ----------
    vertices : ndarray, shape (n_v, 2), [m]
        Corners relative to the centroid, in the orientation phi = 0.
    centroid : ndarray, shape (2,), [m]
        The centroid in the frame of `points`.

    Raises
    ------
    InputError
        If the corners are not those of a convex anticlockwise polygon, or a number is not positive.
    """

    points: ArrayLike
    mass: float
    inertia: float | None = None
    vertices: Array = field(init=False, repr=False)
    centroid: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        given = self.points
        if not isinstance(given, list | tuple | np.ndarray) or len(given) < 3:
            raise InputError("", "object.vertices", f"{given!r} is not a list of 3 or more points")
        corners = np.array(
            [require_vector(p, f"object.vertices[{i}]", 2) for i, p in enumerate(given)]
        )
        edges = np.roll(corners, -1, axis=0) - corners
        cross = _cross(corners, np.roll(corners, -1, axis=0))
        area = cross.sum() / 2
        if area <= 0:
            raise InputError(
                "",
                "object.vertices",
                f"the polygon is clockwise or flat (signed area {area:.3g} m^2); "
                "list its corners anticlockwise",
            )
        turns = _cross(np.roll(edges, 1, axis=0), edges)
        headings = np.arctan2(turns, np.sum(np.roll(edges, 1, axis=0) * edges, axis=1))
        reflex = np.flatnonzero(turns <= 1e-9 * area)
        if reflex.size:
            raise InputError(
                "",
                f"object.vertices[{reflex[0]}]",
                f"the polygon is not strictly convex at {corners[reflex[0]].tolist()}; "
                "every corner must turn left",
            )
        if headings.sum() > 2 * np.pi + 1e-6:
            raise InputError("", "object.vertices", "the polygon crosses itself; it must be convex")
        neighbours = corners + np.roll(corners, -1, axis=0)
        centroid = (neighbours * cross[:, None]).sum(axis=0) / (6 * area)
        vertices = corners - centroid
        mass = require_number(self.mass, "object.mass", positive=True)
        if self.inertia is None:
            after = np.roll(vertices, -1, axis=0)
            squares = (vertices**2 + vertices * after + after**2).sum(axis=1)
            inertia = mass * float(_cross(vertices, after) @ squares) / (12 * area)
        else:
            inertia = require_number(self.inertia, "object.inertia", positive=True)
        object.__setattr__(self, "points", _frozen(corners))
        object.__setattr__(self, "vertices", _frozen(vertices))
        object.__setattr__(self, "centroid", _frozen(centroid))
        object.__setattr__(self, "mass", mass)
        object.__setattr__(self, "inertia", inertia)

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


@dataclass(frozen=True, eq=False)
class Finger:
    """A single-link finger: a capsule on a motorised revolute joint.

    Parameters
    ----------
    base : array_like, shape (2,), [m]
        The joint.
    length : float, [m]
        From the joint to the centre of the tip.
    radius : float, [m]
        Half thickness of the link and radius of its tip; zero for a pointed line.
    inertia : float, [kg m^2]
        J_i about the joint.
    viscous, dry : float, [N m s], [N m]
        Viscous and dry friction of the joint, B_i and D_i.
    torque_limit : float, [N m]
    speed_limit : float, optional, [rad/s]
        Infinite when left out.
    name : str
        Key of this finger in messages.
    """

    base: ArrayLike
    length: float
    radius: float
    inertia: float
    viscous: float
    dry: float
    torque_limit: float
    speed_limit: float = math.inf
    name: str = "fingers"

    def __post_init__(self) -> None:
        object.__setattr__(self, "base", require_vector(self.base, f"{self.name}.base", 2))
        for key in ("length", "inertia", "torque_limit"):
            value = require_number(getattr(self, key), f"{self.name}.{key}", positive=True)
            object.__setattr__(self, key, value)
        for key in ("radius", "viscous", "dry"):
            value = require_number(getattr(self, key), f"{self.name}.{key}", nonnegative=True)
            object.__setattr__(self, key, value)
        if self.speed_limit != math.inf:
            key = f"{self.name}.speed_limit"
            value = require_number(self.speed_limit, key, positive=True)
            object.__setattr__(self, "speed_limit", value)


@dataclass(frozen=True)
class Friction:
    """Coulomb coefficients between the object and each part of the hand."""

    palm: float
    finger1: float
    finger2: float

    def __post_init__(self) -> None:
        for key in ("palm", "finger1", "finger2"):
            value = require_number(getattr(self, key), f"friction.{key}", nonnegative=True)
            object.__setattr__(self, key, value)

    def of(self, finger: int | None) -> float:
        """Coefficient with finger 0 or 1, or with the palm when `finger` is None."""
        return self.palm if finger is None else (self.finger1, self.finger2)[finger]


class Scales(NamedTuple):
    """The scene's own units, which every tolerance is relative to.

    Attributes
    ----------
    length : float, [m]
        Radius of gyration of the object.
    mass : float, [kg]
        Of the object.
    force : float, [N]
        Weight of the object, or a hundredth of what the weaker finger can press with at its tip
        where that is more.
    """

    length: float
    mass: float
    force: float

    @property
    def torque(self) -> float:
        """Force times length [N m]."""
        return self.force * self.length

    @property
    def time(self) -> float:
        """In which the force moves the mass by about the length [s]."""
        return math.sqrt(self.mass * self.length / self.force)

    @property
    def speed(self) -> float:
        """Length over time [m/s]."""
        return self.length / self.time

    @property
    def acceleration(self) -> float:
        """Force over mass [m/s^2]."""
        return self.force / self.mass


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that does not move by plan: object, both fingers, friction and gravity.

    Parameters
    ----------
    polygon : Polygon
    fingers : (Finger, Finger)
        The right one, then the left one.
    friction : Friction
    gravity : float, [m/s^2]
    fingers_collide : bool
        Whether the links are solid to each other; False for fingers in different planes.

    Raises
    ------
    InputError
        If finger 1 is not to the right of finger 2, or a value is not of its type.
    """

    polygon: Polygon
    fingers: tuple[Finger, Finger]
    friction: Friction
    gravity: float = 9.81
    fingers_collide: bool = True

    def __post_init__(self) -> None:
        value = require_number(self.gravity, "gravity", nonnegative=True)
        object.__setattr__(self, "gravity", value)
        if not isinstance(self.fingers_collide, bool):
            given = f"{self.fingers_collide!r} given; allowed are true and false"
            raise InputError("", "fingers_collide", given)
        right, left = (np.asarray(finger.base) for finger in self.fingers)
        if right[0] <= left[0]:
            raise InputError(
                "",
                "fingers.1.base",
                f"{right.tolist()} is not to the right of fingers.2.base {left.tolist()}",
            )

    @cached_property
    def scales(self) -> Scales:
        """Units that fit the scene: tolerances count in them."""
        mass = self.polygon.mass
        press = min(finger.torque_limit / finger.length for finger in self.fingers)
        force = max(mass * self.gravity, press / 100)
        return Scales(self.polygon.gyration_radius, mass, force)

    @cached_property
    def shape(self) -> tuple[object, ...]:
        """Equal for scenes whose object and links have the same shapes and joints."""
        joints = [np.asarray(finger.base).tobytes() for finger in self.fingers]
        sizes = [(finger.length, finger.radius) for finger in self.fingers]
        return (self.polygon.vertices.tobytes(), *joints, *sizes)

    @property
    def touching(self) -> float:
        """Gap below which features count as touching [m]: above rounding, below real clearance."""
        return TOUCHING * self.scales.length

    @property
    def mass_diagonal(self) -> Array:
        """Diagonal of M5, shape (5,): m, m, I, J_1, J_2 [kg, kg m^2]."""
        body = self.polygon
        assert body.inertia is not None
        joints = [finger.inertia for finger in self.fingers]
        return np.array([body.mass, body.mass, body.inertia, *joints])

    @property
    def applied_force(self) -> Array:
        """Gravity as a force on z, shape (5,) [N, N m]: the vector g of the equations of motion."""
        return np.array([0.0, -self.polygon.mass * self.gravity, 0.0, 0.0, 0.0])

    @property
    def viscous(self) -> Array:
        """Joint viscous friction B as a force on z' per speed, shape (5,) [N m s]."""
        return np.array([0.0, 0.0, 0.0, *(finger.viscous for finger in self.fingers)])

    @property
    def dry(self) -> Array:
        """Joint dry friction D as a force on z, shape (5,) [N m]."""
        return np.array([0.0, 0.0, 0.0, *(finger.dry for finger in self.fingers)])

    @property
    def torque_limit(self) -> Array:
        """Torque limits, shape (2,) [N m]."""
        return np.array([finger.torque_limit for finger in self.fingers])

    @property
    def speed_limit(self) -> Array:
        """Joint speed limits, shape (2,) [rad/s], infinite where there is none."""
        return np.array([finger.speed_limit for finger in self.fingers])


def _cross(a: Array, b: Array) -> Array:
    """Plane cross product a_x b_y - a_y b_x along the last axis."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
