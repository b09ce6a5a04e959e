"""Definition of a problem: scene, start, phases or goals, and ranges of uncertain parameters."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..common.arguments import check_kinds
from ..common.arrays import Array
from ..common.errors import InputError, name_source, read_fraction, require_number, require_vector
from ..common.fields import (
    NONNEGATIVE,
    NUMBER,
    POSITIVE,
    TEXT,
    FieldKind,
    choice,
    declare,
    key,
    refer,
    unread,
)
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..scene.model import EPSILON, PLACE, SETTLE, SETTLE_GAP, TURN, Friction, Scene

ROWS = {"x": 0, "phi": 2}  # rows of z that may be given where a phase ends


class End(Enum):
    """Transition of a phase to the next one."""

    REST = "rest"
    """Everything stops."""
    SMOOTH = "smooth"
    """The velocity is continuous: a contact is gained without impact, or released."""
    IMPACT = "impact"
    """Plastic impact: a contact is gained, and the velocity jumps."""


class ModeGuess(NamedTuple):
    """A contact mode of the initial guess of a phase, with time and pose at its end."""

    t: float  # [s]: from the start of the phase
    x: float  # [m]
    phi: float  # [rad]
    signs: tuple[float, ...]  # of sliding velocities (0: rolling) and of joint velocities


INDEX = unread({"type": "integer", "minimum": 0})  # number of an edge
_NAME = "([ev][0-9]+-tip[12]|v[0-9]+-(palm|finger[12]))"
CONTACT = {"type": "string", "pattern": f"^{_NAME}$"}  # JSON Schema of the name of a contact
DWELL = FieldKind(
    lambda value, key: (read_fraction if isinstance(value, str) else NONNEGATIVE.read)(value, key),
    {"anyOf": [NONNEGATIVE.schema, {"type": "string", "pattern": "^[^%]+%\\s*$"}]},
)
"""A time [s], or a percentage of the duration of the motion."""


def _measure(pin: tuple[str, float], z: Array, length: float) -> Array:
    """Distance of z, shape (5, ...), to a pinned coordinate: x over `length`, phi in rad."""
    name, value = pin
    return np.asarray(np.abs(z[ROWS[name]] - value) / (length if name == "x" else 1.0))


@dataclass(frozen=True)
class Until:
    """End of a phase: a contact is gained, a coordinate of the pose is reached, or a release.

    With neither contact nor coordinate, the phase ends by a release of the contacts that the next
    phase does not have, at a place that the planner chooses.
    """

    contact: Contact | None = None  # the contact that is gained
    coordinate: str = ""  # {"", "x", "phi"}: the coordinate, if there is one
    value: float | None = None  # [m] or [rad]
    pins: tuple[tuple[str, float], ...] = ()  # other coordinates, and their values [m] or [rad]

    @property
    def coordinates(self) -> tuple[tuple[str, float], ...]:
        """Coordinates fixed at the end of the phase, and their values [m] or [rad]."""
        return self.pins if self.value is None else ((self.coordinate, self.value), *self.pins)

    @property
    def poses(self) -> tuple[tuple[int, float], ...]:
        """Rows of z fixed at the end of the phase, and their values [m] or [rad]."""
        return tuple((ROWS[name], value) for name, value in self.coordinates)

    @property
    def conditions(self) -> int:
        """Number of conditions at the end of the phase."""
        return len(self.coordinates) + (self.contact is not None)

    def measure_pins(self, z: Array, length: float) -> Array:
        """Largest distance of z, shape (5, ...), to the pins: x over `length`, phi in rad."""
        distances = [_measure(pin, z, length) for pin in self.pins]
        return np.asarray(np.max(distances, axis=0, initial=0.0))

    def lead(self, z: Array, length: float) -> Until:
        """The condition with the coordinate first that is farthest from z, shape (5,).

        This coordinate ends the phase. Distances of x are over `length`, those of phi in rad.
        """
        if self.value is None or not self.pins:
            return self
        (name, value), *pins = sorted(self.coordinates, key=lambda at: -_measure(at, z, length))
        return replace(self, coordinate=name, value=value, pins=tuple(pins))

    @property
    def is_release(self) -> bool:
        """Whether the phase ends by a release, at a place that the planner chooses."""
        return self.contact is None and self.value is None

    def __str__(self) -> str:
        if self.is_release:
            return "release"
        parts = [
            f"x = {value:g} m" if name == "x" else f"phi = {math.degrees(value):g} deg"
            for name, value in self.coordinates
        ]
        if self.contact is not None:
            parts[:1] = [" at ".join([self.contact.name, *parts[:1]])]
        return ", ".join(parts)


@declare(
    key(
        "contacts",
        "Contacts that touch throughout, such as v1-palm, v3-finger1, e2-tip1; with ' rolling' "
        "behind it one does not slide.",
        unread(
            {
                "type": "array",
                "minItems": 1,
                "items": CONTACT | {"pattern": f"^{_NAME}( rolling)?$"},
            }
        ),
        attribute="formation",
    ),
    key(
        "until",
        "What ends the phase: a contact that is gained, or a coordinate; with two freedoms also "
        "both, or both coordinates: the one with the longer way ends it. Left out with end = "
        "'smooth': where the planner lets a contact go.",
        unread({"oneOf": [refer("contact"), refer("until")]}),
        default=None,
    ),
    key("end", "How the phase passes into the next one.", choice(*(end.value for end in End))),
    key(
        "settle",
        "For how long its end is held, instead of the problem's [s].",
        *(NONNEGATIVE, "time", SETTLE),
    ),
    key(
        "guess",
        "Initial guess in place of the planner's own, for phases planned over time: contact modes "
        "in order, each with time t since the start of the phase [s], x [m] and phi_deg at its "
        "end, and the signs of the sliding velocities of `contacts` (0 if one rolls) and of the "
        "joint velocities, such as '-+0 ++'.",
        unread({"type": "array", "minItems": 1, "items": refer("mode")}),
    ),
)
@dataclass(frozen=True, eq=False)
class Phase:
    """A part of the motion with one contact formation."""

    index: int  # from 0; messages and files count from 1
    formation: Formation
    until: Until
    end: End = End.REST
    settle: float | None = None
    guess: tuple[ModeGuess, ...] | None = None

    @property
    def number(self) -> int:
        """Number of the phase in messages and files, from 1."""
        return self.index + 1

    def __post_init__(self) -> None:
        check_kinds(Phase.__annotations__, vars(self))


@declare(
    key("flush", "The edge that shall lie on the palm.", INDEX),
    key(
        "phi_deg",
        "The angle that the object shall have instead [degrees].",
        *(NUMBER, "", TURN),
        attribute="phi",
    ),
    key("x", "Of the centroid [m]; anywhere if it is left out.", NUMBER, "length", PLACE),
)
@dataclass(frozen=True)
class Goal:
    """Pose at which the object shall come to rest: an edge on the palm, or an angle phi [rad].

    Both are set if that edge lies on the palm at that angle.
    """

    flush: int | None = None
    phi: float | None = None
    x: float | None = None

    def __str__(self) -> str:
        text = f"edge {self.flush} on the palm"
        if self.phi is not None:
            text = f"phi = {math.degrees(self.phi):g} deg"
        return text if self.x is None else f"{text} at x = {self.x:g} m"

    def find_angle(self, scene: Scene, near: float) -> float:
        """Angle of the goal [rad]; of an edge, modulo 2 pi, the angle nearest to `near`."""
        if self.phi is not None:
            return self.phi
        assert self.flush is not None
        angle = scene.polygon.flush_angle(self.flush)
        return angle + 2 * math.pi * round((near - angle) / (2 * math.pi))

    def with_edge(self, scene: Scene, tol: float) -> Goal:
        """The goal with the edge that lies on the palm at its angle to within `tol` [rad]."""
        if self.phi is None:
            return self
        for edge in range(scene.polygon.n_vertices):
            if abs(math.remainder(self.phi - scene.polygon.flush_angle(edge), math.tau)) < tol:
                return replace(self, flush=edge)
        return self


@declare(
    key("name", "", TEXT, default="unnamed"),
    key("epsilon", "Least normal force of every contact [N].", NONNEGATIVE, "force", EPSILON),
    key(
        "settle",
        "For how long ends at rest are held, so that contacts close [s]; or a share of the "
        'motion\'s time for all of them, such as "10 %".',
        *(DWELL, "time", SETTLE),
    ),
    key("settle_gap", "From how far open they then close [m].", POSITIVE, "length", SETTLE_GAP),
)
@dataclass(frozen=True, eq=False)
class Problem:
    """A manipulation to plan; an `InputError` names the key of a value that is not allowed.

    Formations of the phases are moved to `scene`, so that `dataclasses.replace` returns a
    consistent problem. It does not check values; `with_` does.
    """

    name: str
    scene: Scene
    epsilon: float
    start: Array  # (5,): configuration z at the start, with the fingers closed; see `place_start`
    phases: tuple[Phase, ...]  # none for a map, or with goals; replays need one or more
    source: str = ""  # the file this was read from
    # half widths of ranges by name, by default those of `PARAMETERS`; None if the file has none
    uncertainty: Mapping[str, float] | None = None
    checked: bool = field(default=False, repr=False)  # if false, the constructor checks values
    settle: float | str = 0.0
    settle_gap: float | None = None
    goals: tuple[Goal, ...] = ()  # poses to reach, in place of phases

    def __post_init__(self) -> None:
        with name_source(self.source):
            check_kinds(Problem.__annotations__, vars(self))
        phases = tuple(
            phase
            if phase.formation.scene is self.scene
            else replace(phase, formation=replace(phase.formation, scene=self.scene))
            for phase in self.phases
        )
        object.__setattr__(self, "phases", phases)
        if self.checked:
            return
        from .read import check_problem

        with name_source(self.source):
            object.__setattr__(self, "start", require_vector(self.start, "start", 5))
            check_problem(self)
        object.__setattr__(self, "checked", True)

    @cached_property
    def table(self) -> Mapping[str, Any]:
        """The nested tables of a problem file; empty if no file can describe it (`write_table`)."""
        from .table import write_table

        return write_table(self)

    def __repr__(self) -> str:
        count = len(self.phases)
        return f"Problem({self.name!r}, {count} phase{'' if count == 1 else 's'})"

    def with_(self, changes: Mapping[str, Any] | None = None, /, **named: Any) -> Problem:
        """Return the problem with other values, checked like those of a file.

        Parameters
        ----------
        changes : mapping, optional
            New values by dotted keys as messages write them, such as ``fingers.1.base`` or
            ``phases[2].until``, or by the short names of `named`.
        **named
            Keys of a problem file: those at the top, of the object, of the start, of both fingers
            or of one as in `torque_limit1`; `finger_inertia`; `friction` of all parts or of one as
            in `friction_palm`. None removes an optional value.

        Raises
        ------
        InputError  if a name is unknown, a value is not allowed, or the problem has no table
        """
        if not self.table:
            raise InputError(self.source, "", "the problem has no table that could be changed")
        from .read import build_problem, name_keys
        from .table import change_table

        # The source is set afterwards: errors would name a file without the changed values.
        table = change_table(self.table, {**(changes or {}), **named}, name_keys())
        return replace(build_problem(table), source=self.source)

    @property
    def ranges(self) -> dict[str, float]:
        """Half widths of all ranges; defaults of lengths are relative to the scene's length."""
        return read_widths(self.uncertainty or {}, length=self.scene.scales.length)

    @property
    def settle_share(self) -> float:
        """Total dwell time over the duration of the motion; zero if `settle` is no percentage."""
        return read_fraction(self.settle, "settle") if isinstance(self.settle, str) else 0.0

    def settles(self, phase: Phase) -> float | None:
        """Dwell time at the end of a phase [s]; None if it is allocated by the planner."""
        if phase.settle is None:
            return None if isinstance(self.settle, str) else self.settle
        return phase.settle

    @property
    def gap(self) -> float:
        """Largest gap from which a contact closes during a dwell [m]."""
        default = 3e-3 * self.scene.scales.length  # 0.1 mm of 35 mm
        return default if self.settle_gap is None else self.settle_gap

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All contacts of the phases, in the order of first use."""
        contacts = (contact for phase in self.phases for contact in phase.formation.contacts)
        return tuple(dict.fromkeys(contacts))


LENGTH = 1 / 30
"""Length scale without a scene [m]: about that of the scenes in `problems/`."""
_RATIO = "Half width, relative."
_RELATIVE = unread({"type": "number", "minimum": 0, "exclusiveMaximum": 1})
_LENGTH = "Half width [m]."
_RANGES = (
    ("", "mass inertia", _RATIO, _RELATIVE, 0.05),
    ("friction", "friction_palm friction_finger1 friction_finger2", _RATIO, _RELATIVE, 0.1),
    ("geometry", "length1 length2 base1_x base1_y base2_x base2_y", _LENGTH, NONNEGATIVE, 6e-3),
    ("", "start_x", _LENGTH, NONNEGATIVE, 6e-3),
    ("gain", "gain1 gain2", _RATIO, _RELATIVE, 0.01),
    ("", "delay", "Half width [s].", NONNEGATIVE, 1e-3),
)
PARAMETERS = tuple(
    key(name, text, kind, default=width)
    for _, names, text, kind, width in _RANGES
    for name in names.split()
)
"""Uncertain parameters; defaults of lengths are over the scene's length. The range of the delay is
[0, half width]."""

NAMES = tuple(parameter.name for parameter in PARAMETERS)
GROUPS = {group: tuple(names.split()) for group, names, *_ in _RANGES if group}
"""Groups of parameters by their common name."""


def read_widths(
    widths: Mapping[str, object], label: str = "uncertainty.{}", length: float = LENGTH
) -> dict[str, float]:
    """Half widths of all ranges: `widths` (see `expand_widths`) and defaults of the others.

    Zero is no range. Defaults of lengths are proportional to the scene's `length` [m].
    """
    defaults = {
        parameter.name: parameter.default * (length if parameter.unit == "m" else 1)
        for parameter in PARAMETERS
    }
    return defaults | expand_widths(widths, label)


def expand_widths(ranges: Mapping[str, object], label: str) -> dict[str, float]:
    """Half widths by parameter, with groups replaced by their parameters.

    The range of a parameter takes precedence over that of its group. `label` is the format of a
    range's name in messages. InputError if a name is unknown, or a width is not a number >= 0, and
    < 1 if it is relative.
    """
    widths = dict[str, float]()
    for name, value in sorted(ranges.items(), key=lambda item: item[0] not in GROUPS):
        key = label.format(name)
        if name not in (*NAMES, *GROUPS):
            raise InputError("", key, f"is unknown; allowed are {', '.join((*GROUPS, *NAMES))}")
        width, names = require_number(value, key, nonnegative=True), GROUPS.get(name, (name,))
        if width >= 1 and any(
            parameter.name in names and not parameter.unit for parameter in PARAMETERS
        ):
            raise InputError("", key, f"{width:g} given; a relative range is below 1")
        widths |= dict.fromkeys(names, width)
    return widths


def change_scene(scene: Scene, changes: Mapping[str, float]) -> Scene:
    """The scene with parameters changed by `changes`, relative or in the parameters' units.

    Changes of torques and of the start are ignored.
    """
    changes, polygon = defaultdict(float, changes), scene.polygon
    assert polygon.inertia is not None
    mass, inertia = polygon.mass * (1 + changes["mass"]), polygon.inertia * (1 + changes["inertia"])
    first, second = (
        replace(
            finger,
            length=finger.length + changes[f"length{number}"],
            base=np.asarray(finger.base) + [changes[f"base{number}_{axis}"] for axis in "xy"],
        )
        for number, finger in enumerate(scene.fingers, start=1)
    )
    parts = ("palm", "finger1", "finger2")
    mu = {part: getattr(scene.friction, part) * (1 + changes[f"friction_{part}"]) for part in parts}
    return replace(
        scene,
        polygon=replace(polygon, mass=mass, inertia=inertia),
        fingers=(first, second),
        friction=Friction(**mu),
    )
