"""Ranges that the numbers of a problem have to be in, most of them relative to one another.

Inside them planning and simulation are meant to work, in any units: sizes and masses span decades,
and what counts is how heavy, strong and quick a hand is for its object. Outside, a number is taken
for a mistake.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..common.errors import InputError
from .model import Finger, Scene


class Range(NamedTuple):
    """A range of numbers, both ends included, as multiples of a scale."""

    low: float
    high: float

    def check(self, key: str, value: float, unit: str, scale: float = 1.0, of: str = "") -> None:
        """Raise an `InputError` that names `key` if a value is not within so many scales."""
        low, high = self.low * scale, self.high * scale
        if low <= value <= high:
            return
        what = f" ({self.low:g} to {self.high:g} {of})" if of else ""
        text = f"{low:.3g} to {high:.3g} {unit}".rstrip()
        raise InputError("", key, f"{value:g} given; allowed are {text}{what}")


MASS = Range(1e-6, 1e6)
"""Mass of the object [kg]."""
INERTIA = Range(1e-2, 1e2)
"""Its moment of inertia, over that of uniform density."""
GRAVITY = Range(1e-3, 1e5)
"""Gravity [m/s^2], unless it is zero."""
FRICTION = Range(0.0, 10.0)
"""Coefficients of friction."""
PLACE = Range(-300.0, 300.0)
"""Coordinates of joints and of the object, over its size."""
TURN = Range(-3600.0, 3600.0)
"""Angle of the object at which a phase ends [degrees]."""
LENGTH = Range(0.03, 100.0)
"""Length of a link, over the size of the object."""
RADIUS = Range(1e-4, 1.0)
"""Half thickness of a link over its length, unless it is zero."""
JOINT = Range(1e-8, 1e3)
"""Inertia of a joint, over that of the object's mass at the tip."""
TORQUE = Range(1e-6, 1e3)
"""Torque limit, over what the weight makes at the tip."""
STRENGTH = Range(1e-6, 1e6)
"""Ratio of the forces that one finger and the other can press with at their tips."""
VISCOUS = Range(0.0, 200.0)
"""Viscous friction, over the torque limit or m g length at one radian in the scene's time."""
DRY = Range(0.0, 1e3)
"""Dry friction, over the torque limit or m g length."""
SPEED = Range(1e-3, 1e6)
"""Speed limit, in radians in the scene's time."""
SETTLE = Range(1e-4, 1e3)
"""Time for which the end of a phase is held, over the scene's, unless it is zero."""
SETTLE_GAP = Range(1e-6, 0.1)
"""Gap that is to close in it, over the scene's length."""
TORQUE_RATE = Range(1e-4, 1e9)
"""Limit of the torque's rate, over the torque limit in the scene's time."""
LAG = Range(0.0, 1e2)
"""Time constant of a motor, over the scene's time."""
CONTROL_PERIOD = Range(1e-3, 1e2)
"""Period over which torques are held, over the scene's time."""
EPSILON = Range(0.0, 1e3)
"""Least normal force, over the weight or what the stronger finger can press with."""


LARGE, THIN = 2.0, 1e-2
"""Size [m] from which on so little mass over its square [kg/m^2] looks like corners in mm: a sheet
of paper has 0.08."""
SLOW = 1.0
"""Control period over the scene's time that looks like one in ms: shipped scenes have 0.06 s."""


def check_ranges(scene: Scene) -> None:
    """Check the numbers of a scene.

    Raises
    ------
    InputError
        For the first that is out of its range; names the key, what is given and what is allowed.
    """
    body = scene.polygon
    assert body.inertia is not None
    MASS.check("object.mass", body.mass, "kg")
    uniform = body.uniform_inertia
    INERTIA.check("object.inertia", body.inertia, "kg m^2", uniform, "times uniform density")
    if scene.gravity:
        GRAVITY.check("gravity", scene.gravity, "m/s^2")
    for part in ("palm", "finger1", "finger2"):
        FRICTION.check(f"friction.{part}", getattr(scene.friction, part), "")
    if scene.control_period:
        given = scene.control_period, "s", scene.scales.time, "times the scene's time"
        CONTROL_PERIOD.check("control_period", *given)
    for finger in scene.fingers:
        _check_shape(scene, finger)
        _check_joint(scene, finger)
    right, left = scene.fingers
    weaker = left.torque_limit / left.length * right.length
    STRENGTH.check(
        f"{right.name}.torque_limit", right.torque_limit, "N m", weaker, "times finger 2's strength"
    )
    for finger in scene.fingers:
        _check_friction(scene, finger)


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


def check_epsilon(scene: Scene, epsilon: float) -> None:
    """Check the least normal force of a scene [N]; raises like `check_ranges`."""
    press = max(finger.torque_limit / finger.length for finger in scene.fingers)
    much = max(scene.polygon.mass * scene.gravity, press)
    EPSILON.check("epsilon", epsilon, "N", much, "times what presses at most")


def check_settle(scene: Scene, key: str, value: float) -> None:
    """Check for how long the end of a phase is held [s]; raises like `check_ranges`."""
    if value:
        SETTLE.check(key, value, "s, or 0", scene.scales.time, "times the scene's time")


def check_settle_gap(scene: Scene, value: float) -> None:
    """Check by how much a contact may then be open [m]; raises like `check_ranges`."""
    SETTLE_GAP.check("settle_gap", value, "m", scene.scales.length, "times the scene's length")


def check_place(scene: Scene, key: str, value: float) -> None:
    """Check a coordinate x of the object [m]; raises like `check_ranges`."""
    PLACE.check(key, value, "m", scene.polygon.size, "times the object's size")


def _check_shape(scene: Scene, finger: Finger) -> None:
    size = scene.polygon.size
    LENGTH.check(f"{finger.name}.length", finger.length, "m", size, "times the object's size")
    if finger.radius:
        key = f"{finger.name}.radius"
        RADIUS.check(key, finger.radius, "m", finger.length, "times the length, or 0")
    for value in np.asarray(finger.base):
        PLACE.check(f"{finger.name}.base", float(value), "m", size, "times the object's size")


def _check_joint(scene: Scene, finger: Finger) -> None:
    body, length = scene.polygon, finger.length
    at_tip = body.mass * length * length
    JOINT.check(f"{finger.name}.inertia", finger.inertia, "kg m^2", at_tip, "times m length^2")
    if scene.gravity:
        key, weight = f"{finger.name}.torque_limit", body.mass * scene.gravity
        TORQUE.check(key, finger.torque_limit, "N m", weight * length, "times m g length")


def _check_friction(scene: Scene, finger: Finger) -> None:
    time, weight = scene.scales.time, scene.polygon.mass * scene.gravity
    much = max(finger.torque_limit, weight * finger.length)
    of = "times the torque limit or m g length"
    key = f"{finger.name}.viscous"
    VISCOUS.check(key, finger.viscous, "N m s", much * time, f"{of}, x {time:.3g} s")
    DRY.check(f"{finger.name}.dry", finger.dry, "N m", much, of)
    if finger.speed_limit < float("inf"):
        SPEED.check(f"{finger.name}.speed_limit", finger.speed_limit, "rad/s", 1 / time)
    if finger.torque_rate_limit < float("inf"):
        key, much = f"{finger.name}.torque_rate_limit", finger.torque_limit / time
        TORQUE_RATE.check(
            key, finger.torque_rate_limit, "N m/s", much, f"torque limits in {time:.3g} s"
        )
    LAG.check(f"{finger.name}.actuator_lag", finger.actuator_lag, "s", time, f"x {time:.3g} s")
