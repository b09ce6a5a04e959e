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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.fields import (
    BOOLEAN,
    COEFFICIENT,
    NONNEGATIVE,
    POINT,
    POSITIVE,
    choice,
    declare,
    key,
    read_keys,
)
from .polygon import Polygon
from .ranges import (
    CONTROL_PERIOD,
    DRY,
    FRICTION,
    GRAVITY,
    JOINT,
    LAG,
    LENGTH,
    PLACE,
    RADIUS,
    SPEED,
    STRENGTH,
    TORQUE,
    TORQUE_RATE,
    VISCOUS,
)

LIGHT = 1e-4  # weight, over what the weaker finger can press with, that is next to nothing
HOLDS = ("constant", "linear")  # how torques may be held over control periods
TOUCHING = 3e-6  # gap below which features count as touching, in radii of gyration of the object


@declare(
    key("base", "The joint [m].", POINT, "length", PLACE),
    key("length", "From the joint to the centre of the tip [m].", POSITIVE, "length", LENGTH),
    key("radius", "Half thickness of the link [m].", NONNEGATIVE, "length", RADIUS, default=0.0),
    key("inertia", "About the joint [kg m^2].", POSITIVE, "inertia", JOINT),
    key(
        "viscous",
        "Viscous friction of the joint [N m s].",
        *(NONNEGATIVE, "drag", VISCOUS),
        default=0.0,
    ),
    key("dry", "Dry friction of the joint [N m].", NONNEGATIVE, "torque", DRY, default=0.0),
    key("torque_limit", "[N m]", POSITIVE, "torque", TORQUE, STRENGTH),
    key("speed_limit", "Of the joint [rad/s]; none by default.", POSITIVE, "rate", SPEED),
    key(
        "torque_rate_limit",
        "How quickly the torque may change [N m/s]; none by default: it may step.",
        *(POSITIVE, "torque_rate", TORQUE_RATE),
    ),
    key(
        "actuator_lag",
        "Time constant with which the torque follows its command [s].",
        *(NONNEGATIVE, "time", LAG),
    ),
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


class Scales(NamedTuple):
    """The scene's own units, which every tolerance is relative to."""

    length: float  # [m]: radius of gyration of the object
    mass: float  # [kg]: of the object
    # [N]: weight of the object; next to nothing, or without gravity, a hundredth of what the weaker
    # finger can press with at its tip
    force: float

    @property
    def torque(self) -> float:
        """Force times length [N m]."""
        return self.force * self.length

    @property
    def inertia(self) -> float:
        """Mass times length squared [kg m^2]."""
        return self.mass * self.length**2

    @property
    def drag(self) -> float:
        """Torque times time [N m s]."""
        return self.torque * self.time

    @property
    def rate(self) -> float:
        """One over time [rad/s]."""
        return 1 / self.time

    @property
    def torque_rate(self) -> float:
        """Torque over time [N m/s]."""
        return self.torque / self.time

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


@declare(
    key("gravity", "[m/s^2]", NONNEGATIVE, "acceleration", GRAVITY),
    key(
        "fingers_collide",
        "Whether the links stop each other; false where they move in different planes.",
        BOOLEAN,
    ),
    key(
        "control_period",
        "Period over which torques are held; with 0 they are free [s].",
        *(NONNEGATIVE, "time", CONTROL_PERIOD),
    ),
    key(
        "control_hold",
        "Whether torques are constant over each period, or lines that go on from period to period.",
        choice(*HOLDS),
    ),
)
@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that does not move by plan: object, both fingers, friction and gravity.

    Raises
    ------
    InputError  if finger 1 is not to the right of finger 2, or a value is not of its type
    """

    polygon: Polygon
    fingers: tuple[Finger, Finger]  # the right one, then the left one
    friction: Friction
    gravity: float = 9.81
    fingers_collide: bool = True
    control_period: float = 0.0
    control_hold: str = HOLDS[0]

    def __post_init__(self) -> None:
        read_keys(self)
        # Messages name a finger by its place here, whatever it was made as.
        named = zip(self.fingers, ("fingers.1", "fingers.2"), strict=True)
        fingers = tuple(f if f.name == name else replace(f, name=name) for f, name in named)
        object.__setattr__(self, "fingers", fingers)
        right, left = (np.asarray(finger.base) for finger in self.fingers)
        if right[0] <= left[0]:
            text = f"{right.tolist()} is not to the right of fingers.2.base {left.tolist()}"
            raise InputError("", "fingers.1.base", text)

    @cached_property
    def scales(self) -> Scales:
        """Units that fit the scene: tolerances count in them."""
        mass = self.polygon.mass
        press = min(finger.torque_limit / finger.length for finger in self.fingers)
        weight = mass * self.gravity
        force = weight if weight > LIGHT * press else press / 100
        return Scales(self.polygon.gyration_radius, mass, force)

    @cached_property
    def shape(self) -> tuple[object, ...]:
        """Equal for scenes whose object and links have the same shapes and joints."""
        joints = [np.asarray(finger.base).tobytes() for finger in self.fingers]
        sizes = [(finger.length, finger.radius) for finger in self.fingers]
        return (self.polygon.vertices.tobytes(), *joints, *sizes)

    @cached_property
    def equations(self) -> tuple[object, ...]:
        """Equal for scenes with the same equations of motion and the same features to touch.

        Limits of torques and speeds, and names, are no part of it.
        """
        known = (self.mass_diagonal, self.viscous, self.dry, self.applied_force)
        solid = self.fingers_collide
        return (self.shape, *(part.tobytes() for part in known), self.friction, solid)

    @property
    def touching(self) -> float:
        """Gap below which features count as touching [m]: above rounding, below real clearance."""
        return TOUCHING * self.scales.length

    @cached_property
    def mass_diagonal(self) -> Array:
        """Diagonal of M5, shape (5,): m, m, I, J_1, J_2 [kg, kg m^2]."""
        body = self.polygon
        assert body.inertia is not None
        joints = [finger.inertia for finger in self.fingers]
        diagonal = np.array([body.mass, body.mass, body.inertia, *joints])
        diagonal.setflags(write=False)
        return diagonal

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

    @property
    def torque_rate_limit(self) -> Array:
        """Limits of the torques' rates, shape (2,) [N m/s], infinite where there is none."""
        return np.array([finger.torque_rate_limit for finger in self.fingers])

    @property
    def actuator_lag(self) -> Array:
        """Time constants of the motors, shape (2,) [s]."""
        return np.array([finger.actuator_lag for finger in self.fingers])

    @property
    def has_slow_motors(self) -> bool:
        """Whether torques may not step."""
        return bool(np.isfinite(self.torque_rate_limit).any() or self.actuator_lag.any())
