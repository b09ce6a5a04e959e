"""Ranges that the numbers of a problem have to be in, most of them relative to one another.

Inside them planning and simulation are meant to work, in any units: sizes and masses span decades,
and what counts is how heavy, strong and quick a hand is for its object. Outside, a number is taken
for a mistake.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

from ..common.fields import Range, keys_of

if TYPE_CHECKING:
    from .model import Scene

_SIZE, _DRIVE = "times the object's size", "times the torque limit or m g length"


def _get_drive(scene: Any, finger: Any) -> float:
    return float(max(finger.torque_limit, scene.polygon.mass * scene.gravity * finger.length))


def _get_strength(scene: Any, finger: Any) -> float | None:
    """The torque with which finger 1 presses with its tip like finger 2; None for finger 2."""
    right, left = scene.fingers
    return left.torque_limit / left.length * right.length if finger is right else None


def _get_press(scene: Any, _: object) -> float:
    press = (finger.torque_limit / finger.length for finger in scene.fingers)
    return float(max(scene.polygon.mass * scene.gravity, *press))


MASS = Range(1e-6, 1e6)
INERTIA = Range(1e-2, 1e2, lambda _, body: body.uniform_inertia, "times uniform density")
GRAVITY = Range(1e-3, 1e5)
FRICTION = Range(0.0, 10.0)
PLACE = Range(-300.0, 300.0, lambda scene, _: scene.polygon.size, _SIZE)
"""Coordinates of joints and of the object."""
TURN = Range(-3600.0, 3600.0)  # angle of the object at which a phase ends [degrees]
LENGTH = Range(0.03, 100.0, PLACE.scale, _SIZE)
RADIUS = Range(1e-4, 1.0, lambda _, finger: finger.length, "times the length, or 0")
JOINT = Range(
    1e-8, 1e3, lambda scene, finger: scene.polygon.mass * finger.length**2, "times m length^2"
)
TORQUE = Range(
    1e-6,
    1e3,
    lambda scene, finger: scene.polygon.mass * scene.gravity * finger.length or None,
    "times m g length",
)
STRENGTH = Range(1e-6, 1e6, _get_strength, "times finger 2's strength")
VISCOUS = Range(
    *(0.0, 200.0),
    lambda scene, finger: _get_drive(scene, finger) * scene.scales.time,
    f"{_DRIVE}, x {{time}}",
)
DRY = Range(0.0, 1e3, _get_drive, _DRIVE)
SPEED = Range(1e-3, 1e6, lambda scene, _: scene.scales.rate, "radians in {time}")
TORQUE_RATE = Range(
    1e-4,
    1e9,
    lambda scene, finger: finger.torque_limit / scene.scales.time,
    "torque limits in {time}",
)
LAG = Range(0.0, 1e2, lambda scene, _: scene.scales.time, "x {time}")
CONTROL_PERIOD = Range(1e-3, 1e2, LAG.scale, "times the scene's time")
SETTLE = Range(1e-4, 1e3, LAG.scale, "times the scene's time, or 0")
SETTLE_GAP = Range(1e-6, 0.1, lambda scene, _: scene.scales.length, "times the scene's length")
EPSILON = Range(0.0, 1e3, _get_press, "times what presses at most")


LARGE, THIN = 2.0, 1e-2
"""Size [m] from which on so little mass over its square [kg/m^2] looks like corners in mm: a sheet
of paper has 0.08."""
SLOW = 1.0
"""Control period over the scene's time that looks like one in ms: shipped scenes have 0.06 s."""


def check_ranges(scene: Scene) -> None:
    """Check the numbers of a scene.

    Raises
    ------
    InputError  for the first that is out of its range; names the key, what is given and what is
                allowed
    """
    parts: list[list[tuple[str, Any]]] = [
        [("object.", scene.polygon)],
        [("", scene)],
        [("friction.", scene.friction)],
        [(f"{finger.name}.", finger) for finger in scene.fingers],
    ]
    for owners in parts:
        for attribute, own in keys_of(owners[0][1]).items():
            for one, (prefix, owner) in product(own.ranges, owners):
                key = f"{prefix}{own.name}"
                one.check(key, getattr(owner, attribute), own.unit, scene, owner)


def find_unit_hint(scene: Scene) -> str:
    """What looks as if it were in mm or ms, with the key first; empty where nothing does."""
    size, time = scene.polygon.size, scene.scales.time
    if size > LARGE and scene.polygon.mass < THIN * size**2:
        return f"object.vertices: {size:g} m across at {scene.polygon.mass:g} kg; are they in mm?"
    if scene.control_period > SLOW * time:
        many = scene.control_period / time
        text = f"{scene.control_period:g} s is {many:.3g} times a fall over the radius of gyration"
        return f"control_period: {text}; is it in ms?"
    return ""


def check_place(scene: Scene, key: str, value: float) -> None:
    """Check a coordinate x of the object [m]; raises like `check_ranges`."""
    PLACE.check(key, value, "m", scene)
