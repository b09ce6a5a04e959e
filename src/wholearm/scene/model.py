"""Data model of a scene: polygon, palm and two fingers, friction, gravity; allowed ranges.

The notation of all docstrings, such as q, theta, z, C, A, A_t, c, P, G and M5, is that of
`mechanics/README.md`. Finger 1 (index 0) is the right one, finger 2 (index 1) the left one. The
normal n of a contact points into the object and its tangent is t = (n_y, -n_x).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arguments import check_kinds
from ..common.arrays import Array
from ..common.errors import InputError, frozen
from ..common.fields import (
    BOOLEAN,
    COEFFICIENT,
    NONNEGATIVE,
    POINT,
    POSITIVE,
    FieldKind,
    Range,
    choice,
    declare,
    key,
    keys_of,
    read_keys,
)

# Allowed ranges of the numbers of a problem, most of them relative to others: sizes and masses
# span decades, and what counts is how heavy, strong and fast the hand is for its object. Inside the
# ranges planning and simulation should work, in any units; numbers outside are taken for mistakes.
_SIZE, _DRIVE = "times the object's size", "times the torque limit or m g length"


def _get_drive(scene: Any, finger: Any) -> float:
    return float(max(finger.torque_limit, scene.weight * finger.length))


def _get_strength(scene: Any, finger: Any) -> float | None:
    """Torque of finger 1 for the largest tip force of finger 2; None for finger 2."""
    right, left = scene.fingers
    return left.torque_limit / left.length * right.length if finger is right else None


def _get_press(scene: Any, _: object) -> float:
    forces = (finger.torque_limit / finger.length for finger in scene.fingers)
    return float(max(scene.weight, *forces))


FRICTION = Range(0.0, 10.0)
PLACE = Range(-300.0, 300.0, lambda scene, _: scene.polygon.size, _SIZE)
"""Coordinates of joints and of the object."""
TURN = Range(-3600.0, 3600.0)  # angle of the object at which a phase ends [degrees]


def relate_time(low: float, high: float, text: str) -> Range:
    """A range of multiples of the scene's time."""
    return Range(low, high, lambda scene, _: scene.scales.time, text)


SETTLE = relate_time(1e-4, 1e3, "times the scene's time, or 0")
SETTLE_GAP = Range(1e-6, 0.1, lambda scene, _: scene.scales.length, "times the scene's length")
EPSILON = Range(0.0, 1e3, _get_press, "times what presses at most")


def check_ranges(scene: Scene) -> None:
    """Raise an `InputError` for the first number of a scene that is out of its range."""
    groups: list[list[tuple[str, Any]]] = [
        [("object.", scene.polygon)],
        [("", scene)],
        [("friction.", scene.friction)],
        [(f"{finger.name}.", finger) for finger in scene.fingers],
    ]
    for owners in groups:
        for attribute, entry in keys_of(owners[0][1]).items():
            for bounds, (prefix, owner) in product(entry.ranges, owners):
                key = f"{prefix}{entry.name}"
                bounds.check(key, getattr(owner, attribute), entry.unit, scene, owner)


def find_unit_hint(scene: Scene) -> str:
    """Message about a value that may be in mm or ms, with the key first; empty if there is none."""
    size, time = scene.polygon.size, scene.scales.time
    # A sheet of paper has 0.08 kg/m^2.
    if size > 2.0 and scene.polygon.mass < 0.01 * size**2:
        return f"object.vertices: {size:g} m across at {scene.polygon.mass:g} kg; are they in mm?"
    if scene.control_period > time:
        ratio = scene.control_period / time
        text = f"{scene.control_period:g} s is {ratio:.3g} times a fall over the radius of gyration"
        return f"control_period: {text}; is it in ms?"
    return ""


def _read_corners(points: object, key: str) -> Array:
    if not isinstance(points, list | tuple | np.ndarray):
        raise InputError("", key, f"{points!r} is not a list of 3 or more points")
    if not 3 <= len(points) <= 500:
        raise InputError("", key, f"{len(points)} corners given; allowed are 3 to 500")
    return frozen([POINT.read(point, f"{key}[{k + 1}]") for k, point in enumerate(points)])


CORNERS = FieldKind(
    _read_corners, {"type": "array", "minItems": 3, "maxItems": 500, "items": POINT.schema}
)
_CORNERS_TEXT = "Corners of a convex polygon, anticlockwise, from any origin [m]."
_BODY = Range(1e-2, 1e2, lambda _, body: body.uniform_inertia, "times uniform density")
_BODY_TEXT = "About the centroid [kg m^2]; by default that of uniform density."


@declare(
    key("vertices", _CORNERS_TEXT, CORNERS, "length", attribute="points"),
    key("mass", "[kg]", POSITIVE, "mass", Range(1e-6, 1e6)),
    key("inertia", _BODY_TEXT, POSITIVE, "inertia", _BODY),
)
@dataclass(frozen=True, eq=False)
class Polygon:
    """The object: a rigid convex polygon.

    InputError if the corners are not those of a convex anticlockwise polygon, or a number is not
    positive; if the polygon is too small, too large or too slender, or has too short an edge.
    """

    points: ArrayLike
    mass: float
    inertia: float | None = None
    # (n_v, 2) [m]: corners relative to the centroid, in the orientation phi = 0
    vertices: Array = field(init=False, repr=False)
    # (2,) [m]: the centroid in the frame of `points`
    centroid: Array = field(init=False, repr=False)
    # [kg m^2]: inertia about the centroid for uniform density
    uniform_inertia: float = field(init=False, repr=False)
    size: float = field(init=False, repr=False)  # [m]: largest distance between two corners

    def __post_init__(self) -> None:
        read_keys(self, "object.")
        corners = np.asarray(self.points)
        least, largest, extent = 1e-4, 1e3, float(np.abs(corners).max())
        if extent > 1e3 * largest:
            corner = corners[int(np.abs(corners).max(axis=1).argmax())].tolist()
            text = f"{corner} given; allowed are coordinates up to {1e3 * largest:g} m"
            raise InputError("", "object.vertices", text)
        size = float(np.hypot(*(corners[:, None] - corners).transpose(2, 0, 1)).max())
        if not least <= size <= largest:
            text = f"{size:.3g} m from corner to corner; allowed are {least:g} to {largest:g} m"
            raise InputError("", "object.vertices", text)
        if extent > 1e3 * size:
            text = f"allowed are {1e3 * size:.3g} m, 1000 times the polygon's size"
            raise InputError("", "object.vertices", f"{extent:.3g} m from the origin; {text}")
        edges = np.roll(corners, -1, axis=0) - corners
        # Relative to a corner: far from the origin, areas would suffer from cancellation.
        local = corners - corners[0]
        cross = cross_product(local, np.roll(local, -1, axis=0))
        area = cross.sum() / 2
        if area <= 0:
            text = f"the polygon is clockwise or flat (signed area {area:.3g} m^2); "
            raise InputError("", "object.vertices", f"{text}list its corners anticlockwise")
        previous_edges = np.roll(edges, 1, axis=0)
        corner_crosses = cross_product(previous_edges, edges)
        exterior_angles = np.arctan2(corner_crosses, np.sum(previous_edges * edges, axis=1))
        reflex = np.flatnonzero(corner_crosses <= 1e-9 * area)
        if reflex.size:
            text = f"the polygon is not strictly convex at {corners[reflex[0]].tolist()}; "
            key = f"object.vertices[{reflex[0] + 1}]"
            raise InputError("", key, f"{text}every corner must turn left")
        min_edge, least_ratio, lengths = 1e-4, 1e-3, np.hypot(*edges.T)
        k = int(lengths.argmin())
        if lengths[k] < min_edge * size:
            text = (
                f"allowed are {min_edge * size:.3g} m and more, {min_edge:g} of the polygon's size"
            )
            text = f"the edge from there has {lengths[k]:.3g} m; {text}"
            raise InputError("", f"object.vertices[{k + 1}]", text)
        distances = cross_product(edges[:, None], corners - corners[:, None]) / lengths[:, None]
        width = float(distances.max(axis=1).min())
        if width < least_ratio * size:
            text = f"allowed are {least_ratio * size:.3g} m and more, {least_ratio:g} of its size"
            raise InputError("", "object.vertices", f"the polygon is {width:.3g} m wide; {text}")
        if exterior_angles.sum() > 2 * np.pi + 1e-6:
            raise InputError("", "object.vertices", "the polygon crosses itself; it must be convex")
        centroid = ((local + np.roll(local, -1, axis=0)) * cross[:, None]).sum(axis=0) / (6 * area)
        vertices = local - centroid
        after = np.roll(vertices, -1, axis=0)
        squares = (vertices**2 + vertices * after + after**2).sum(axis=1)
        uniform = self.mass * float(cross_product(vertices, after) @ squares) / (12 * float(area))
        object.__setattr__(self, "vertices", frozen(vertices))
        object.__setattr__(self, "centroid", frozen(corners[0] + centroid))
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
        direction = self.vertices[(edge + 1) % self.n_vertices] - self.vertices[edge]
        return -math.atan2(direction[1], direction[0])


def cross_product(a: Array, b: Array) -> Array:
    """Plane cross product a_x b_y - a_y b_x along the last axis."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


TOUCHING = 3e-6  # gap below which features count as touching, in radii of gyration of the object
HOLDS = ("constant", "linear")  # zero- and first-order hold of torques over control periods


_LENGTH = Range(0.03, 100.0, PLACE.scale, _SIZE)
_RADIUS = Range(1e-4, 1.0, lambda _, finger: finger.length, "times the length, or 0")
_INERTIA = Range(1e-8, 1e3, lambda scene, f: scene.polygon.mass * f.length**2, "times m length^2")
_VISCOUS = Range(
    0.0, 200.0, lambda scene, f: _get_drive(scene, f) * scene.scales.time, f"{_DRIVE}, x {{time}}"
)
_DRY = Range(0.0, 1e3, _get_drive, _DRIVE)
_TORQUE = Range(1e-6, 1e3, lambda scene, f: scene.weight * f.length or None, "times m g length")
_STRENGTH = Range(1e-6, 1e6, _get_strength, "times finger 2's strength")
_SPEED = Range(1e-3, 1e6, lambda scene, _: scene.scales.rate, "radians in {time}")
_RATE = Range(
    1e-4, 1e9, lambda scene, f: f.torque_limit / scene.scales.time, "torque limits in {time}"
)
_LAG = relate_time(0.0, 1e2, "x {time}")
_VISCOUS_TEXT = "Viscous friction of the joint [N m s]."
_RATE_TEXT = "How quickly the torque may change [N m/s]; none by default: it may step."
_LAG_TEXT = "Time constant with which the torque follows its command [s]."


@declare(
    key("base", "The joint [m].", POINT, "length", PLACE),
    key("length", "From the joint to the centre of the tip [m].", POSITIVE, "length", _LENGTH),
    key("radius", "Half thickness of the link [m].", NONNEGATIVE, "length", _RADIUS, default=0.0),
    key("inertia", "About the joint [kg m^2].", POSITIVE, "inertia", _INERTIA),
    key("viscous", _VISCOUS_TEXT, NONNEGATIVE, "drag", _VISCOUS, default=0.0),
    key("dry", "Dry friction of the joint [N m].", NONNEGATIVE, "torque", _DRY, default=0.0),
    key("torque_limit", "[N m]", POSITIVE, "torque", _TORQUE, _STRENGTH),
    key("speed_limit", "Of the joint [rad/s]; none by default.", POSITIVE, "rate", _SPEED),
    key("torque_rate_limit", _RATE_TEXT, POSITIVE, "torque_rate", _RATE),
    key("actuator_lag", _LAG_TEXT, NONNEGATIVE, "time", _LAG),
)
@dataclass(frozen=True, eq=False)
class Finger:
    """A single-link finger: a capsule on a motorised revolute joint.

    `name` is the key of the finger in messages.
    """

    base: ArrayLike
    length: float
    radius: float
    inertia: float
    viscous: float
    dry: float
    torque_limit: float
    speed_limit: float = math.inf
    torque_rate_limit: float = math.inf
    actuator_lag: float = 0.0
    name: str = "fingers"

    def __post_init__(self) -> None:
        read_keys(self, f"{self.name}.")


@declare(*(key(part, "", COEFFICIENT, "", FRICTION) for part in ("palm", "finger1", "finger2")))
@dataclass(frozen=True)
class Friction:
    """Coulomb coefficients between the object and each part of the hand."""

    palm: float
    finger1: float
    finger2: float

    def __post_init__(self) -> None:
        read_keys(self, "friction.")

    def of(self, finger: int | None) -> float:
        """Coefficient with finger 0 or 1, or with the palm when `finger` is None."""
        return self.palm if finger is None else (self.finger1, self.finger2)[finger]


class _FingerValues:
    """Descriptor: an attribute of both fingers as an array, after `zeros` zeros."""

    def __init__(self, zeros: int = 0) -> None:
        self._zeros = (0.0,) * zeros

    def __set_name__(self, _: type, name: str) -> None:
        self._name = name

    def __get__(self, scene: Scene, _: type) -> Array:
        return np.array([*self._zeros, *(getattr(f, self._name) for f in scene.fingers)])


class Scales(NamedTuple):
    """Characteristic units of a scene, to which tolerances are relative."""

    length: float  # [m]: radius of gyration of the object
    mass: float  # [kg]: mass of the object
    # [N]: weight of the object; if that is negligible, a hundredth of the tip force of the weaker
    # finger at its torque limit
    force: float
    time: float  # [s]: sqrt(mass length / force)
    speed: float  # [m/s]: this and the following units are derived
    acceleration: float  # [m/s^2]
    rate: float  # [rad/s]
    inertia: float  # [kg m^2]
    torque: float  # [N m]
    torque_rate: float  # [N m/s]
    drag: float  # [N m s]

    @staticmethod
    def of(length: float, mass: float, force: float) -> Scales:
        """Units derived from those of length [m], mass [kg] and force [N]."""
        time, torque = math.sqrt(mass * length / force), force * length
        motion = time, length / time, force / mass, 1 / time
        derived = mass * length**2, torque, torque / time, torque * time
        return Scales(length, mass, force, *motion, *derived)


_PERIOD = relate_time(1e-3, 1e2, "times the scene's time")
_COLLIDE_TEXT = "Whether the links stop each other; false where they move in different planes."
_PERIOD_TEXT = "Period over which torques are held; with 0 they are free [s]."
_HOLD_TEXT = (
    "Whether torques are constant over each period, or lines that go on from period to period."
)


@declare(
    key("gravity", "[m/s^2]", NONNEGATIVE, "acceleration", Range(1e-3, 1e5)),
    key("fingers_collide", _COLLIDE_TEXT, BOOLEAN),
    key("control_period", _PERIOD_TEXT, NONNEGATIVE, "time", _PERIOD),
    key("control_hold", _HOLD_TEXT, choice(*HOLDS)),
)
@dataclass(frozen=True, eq=False)
class Scene:
    """The mechanical system: object, both fingers, friction, gravity and control period.

    InputError if finger 1 is not to the right of finger 2, or a value is not of its type.
    """

    polygon: Polygon
    fingers: tuple[Finger, Finger]  # the right one, then the left one
    friction: Friction
    gravity: float = 9.81
    fingers_collide: bool = True
    control_period: float = 0.0
    control_hold: str = HOLDS[0]

    viscous = _FingerValues(3)  # (5,) [N m s]: joint viscous friction B, a force on z' per speed
    dry = _FingerValues(3)  # (5,) [N m]: joint dry friction D as a force on z
    torque_limit = _FingerValues()  # (2,) [N m]
    speed_limit = _FingerValues()  # (2,) [rad/s]: infinite where there is none
    torque_rate_limit = _FingerValues()  # (2,) [N m/s]: infinite where there is none
    actuator_lag = _FingerValues()  # (2,) [s]: time constants of the motors

    def __post_init__(self) -> None:
        check_kinds(Scene.__annotations__, vars(self))
        read_keys(self)
        # Messages name a finger by its position here.
        pairs = zip(self.fingers, ("fingers.1", "fingers.2"), strict=True)
        fingers = tuple(f if f.name == name else replace(f, name=name) for f, name in pairs)
        object.__setattr__(self, "fingers", fingers)
        right, left = (np.asarray(finger.base) for finger in self.fingers)
        if right[0] <= left[0]:
            text = f"{right.tolist()} is not to the right of fingers.2.base {left.tolist()}"
            raise InputError("", "fingers.1.base", text)

    @cached_property
    def scales(self) -> Scales:
        """Characteristic units of the scene."""
        mass, weight = self.polygon.mass, self.weight
        min_force = min(finger.torque_limit / finger.length for finger in self.fingers)
        force = weight if weight > 1e-4 * min_force else min_force / 100
        return Scales.of(self.polygon.gyration_radius, mass, force)

    @cached_property
    def shape(self) -> tuple[object, ...]:
        """Key of the geometry: equal for scenes with the same polygon, links and joints."""
        joints = [np.asarray(finger.base).tobytes() for finger in self.fingers]
        sizes = [(finger.length, finger.radius) for finger in self.fingers]
        return (self.polygon.vertices.tobytes(), *joints, *sizes)

    @cached_property
    def equations(self) -> tuple[object, ...]:
        """Key of the dynamics: equal for scenes with the same geometry and equations of motion.

        Limits of torques and speeds, and names, are not included.
        """
        numbers = (self.mass_diagonal, self.viscous, self.dry, self.applied_force)
        collide = self.fingers_collide
        return (self.shape, *(part.tobytes() for part in numbers), self.friction, collide)

    @property
    def touching(self) -> float:
        """Gap below which features count as touching [m]: larger than rounding errors."""
        return TOUCHING * self.scales.length

    @cached_property
    def mass_diagonal(self) -> Array:
        """Diagonal of M5, shape (5,): m, m, I, J_1, J_2 [kg, kg m^2]."""
        body, joint_inertias = self.polygon, [finger.inertia for finger in self.fingers]
        assert body.inertia is not None
        return frozen([body.mass, body.mass, body.inertia, *joint_inertias])

    @property
    def weight(self) -> float:
        """Weight of the object [N]."""
        return self.polygon.mass * self.gravity

    @property
    def applied_force(self) -> Array:
        """Gravity as a force on z, shape (5,) [N, N m]: the vector g of the equations of motion."""
        return np.array([0.0, -self.weight, 0.0, 0.0, 0.0])

    @property
    def has_slow_motors(self) -> bool:
        """Whether torques are continuous: with rate limits or lags of the motors."""
        return bool(np.isfinite(self.torque_rate_limit).any() or self.actuator_lag.any())

    def quicken(self, factor: float) -> Scene:
        """The scene with torque rate limits multiplied, and motor lags divided, by a factor."""

        def quicken_finger(finger: Finger) -> Finger:
            rate, lag = factor * finger.torque_rate_limit, finger.actuator_lag / factor
            return replace(finger, torque_rate_limit=rate, actuator_lag=lag)

        right, left = map(quicken_finger, self.fingers)
        return replace(self, fingers=(right, left))
