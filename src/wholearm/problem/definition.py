"""Problem files: TOML in, a validated `Problem` out.

Every message names the file and the key, says what was given and what is allowed.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, TypeVar

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, name_source
from ..common.require import require_number
from ..common.sharing import exclusive
from ..contacts.elemental import Contact, parse_contact
from ..contacts.formation import Formation, close_finger, describe, find_touching, place_flush
from ..contacts.links import evaluate_finger_gap
from ..scene.model import Finger, Friction, Scene
from ..scene.polygon import Polygon
from ..scene.ranges import TURN, check_epsilon, check_place, check_ranges
from .table import change_table, match_table, name_keys

_T = TypeVar("_T")

ROLLING = " rolling"
"""Follows the name of a contact that rolls in a phase's `contacts`."""

_OPTIONAL = {"name", "gravity", "fingers_collide"}
_TOP = _OPTIONAL | {"epsilon", "object", "fingers", "friction", "start", "phases"}
_OBJECT = {"vertices", "mass", "inertia"}
_FINGER = {
    "base": True,
    "length": True,
    "radius": False,
    "inertia": True,
    "viscous": False,
    "dry": False,
    "torque_limit": True,
    "speed_limit": False,
}


class End(Enum):
    """How a phase passes into the next one."""

    REST = "rest"
    """Everything stops."""
    SMOOTH = "smooth"
    """Position and velocity are continuous: a contact is gained softly or released."""
    IMPACT = "impact"
    """A contact is gained at speed: the velocity jumps onto the next phase's contacts."""


_ENDS = ", ".join(repr(end.value) for end in End)


@dataclass(frozen=True)
class Until:
    """What ends a phase: a contact gained, a coordinate of the pose reached, or a release.

    Attributes
    ----------
    contact : Contact or None
        The contact that is gained.
    coordinate : {"", "x", "phi"}
        The coordinate, when there is one.
    value : float or None, [m] or [rad]

    Notes
    -----
    With neither contact nor coordinate the phase ends where the planner chooses, by releasing the
    contacts that the next phase does not have.
    """

    contact: Contact | None = None
    coordinate: str = ""
    value: float | None = None

    @property
    def is_release(self) -> bool:
        """Whether the phase ends by a release, where the planner chooses."""
        return self.contact is None and self.value is None

    def __str__(self) -> str:
        if self.contact is not None:
            return self.contact.name
        if self.value is None:
            return "release"
        if self.coordinate == "x":
            return f"x = {self.value:g} m"
        return f"phi = {math.degrees(self.value):g} deg"


@dataclass(frozen=True, eq=False)
class Phase:
    """A stretch of the motion on one contact formation.

    Attributes
    ----------
    index : int
        From 0; messages and files count from 1.
    formation : Formation
    until : Until
    end : End
        How it passes into the next phase; the last one ends at rest.
    """

    index: int
    formation: Formation
    until: Until
    end: End = End.REST

    @property
    def number(self) -> int:
        """The phase's number for people, from 1."""
        return self.index + 1

    def move_to(self, scene: Scene) -> Phase:
        """The phase in another scene."""
        if self.formation.scene is scene:
            return self
        return replace(self, formation=replace(self.formation, scene=scene))


@dataclass(frozen=True, eq=False)
class Problem:
    """A manipulation to plan.

    Attributes
    ----------
    name : str
    scene : Scene
    epsilon : float, [N]
        Least normal force of every contact.
    start : ndarray, shape (5,)
        Configuration z at the start, with the fingers closed.
    phases : tuple of Phase
    source : str
        The file this was read from.
    table : mapping
        The contents of that file, which trajectory files carry along; in step with the rest, or
        empty if there is none.

    Notes
    -----
    Formations of the phases are those of `scene`, whichever they were made for, so that
    `dataclasses.replace` makes another problem of one scene. `with_` also checks the values.
    """

    name: str
    scene: Scene
    epsilon: float
    start: Array
    phases: tuple[Phase, ...]
    source: str = ""
    table: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        phases = tuple(phase.move_to(self.scene) for phase in self.phases)
        object.__setattr__(self, "phases", phases)
        object.__setattr__(self, "table", match_table(self))

    def __repr__(self) -> str:
        return f"Problem({self.name!r}, {len(self.phases)} phases)"

    def with_(self, changes: Mapping[str, Any] | None = None, /, **named: Any) -> Problem:
        """Return the problem with other values, checked like those of a file.

        Parameters
        ----------
        changes : mapping, optional
            New values by dotted keys as messages write them, such as ``fingers.1.base`` or
            ``phases[2].until``, or by the short names of `named`.
        **named
            `name`, `epsilon`, `gravity` and the other keys at the top of a problem file; `mass`,
            `inertia`, `vertices` of the object; `friction` of all parts, or `friction_palm`,
            `friction_finger1`, `friction_finger2`; `flush`, `x` of the start; `length`, `radius`,
            `finger_inertia`, `viscous`, `dry`, `torque_limit`, `speed_limit` of both fingers, or of
            one as in `torque_limit1`; `base1`, `base2`. None leaves out what is optional.

        Raises
        ------
        InputError
            If a name is unknown, a value is not allowed, or the problem has no table.
        """
        if not self.table:
            raise InputError(self.source, "", "the problem has no table that could be changed")
        given = {**(changes or {}), **named}
        try:
            table = change_table(self.table, given, name_keys(_TOP, _FINGER))
        except InputError as error:
            raise InputError(self.source, error.key, error.problem) from None
        return build_problem(table, self.source)

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Every contact of the plan, in the order of first use."""
        used = (contact for phase in self.phases for contact in phase.formation.contacts)
        return tuple(dict.fromkeys(used))


def read_problem(path: str) -> Problem:
    """Read and validate a problem file; whether each phase can be reached is not checked here.

    Raises
    ------
    InputError
        If the file cannot be read or anything in it is malformed.
    """
    try:
        with open(path, "rb") as stream:
            table = tomllib.load(stream)
    except OSError as error:
        raise InputError(str(path), "", f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(str(path), "", f"is not TOML: {error}") from None
    except RecursionError:
        raise InputError(str(path), "", "is nested too deeply") from None
    return build_problem(table, str(path))


@exclusive
def build_problem(table: Mapping[str, Any], source: str = "") -> Problem:
    """Validate a problem given as the nested tables of a problem file.

    Raises
    ------
    InputError
        If anything in it is malformed; names `source`.
    """
    with name_source(source):
        return _build_problem(table, source)


def _build_problem(table: Mapping[str, Any], source: str) -> Problem:
    _check_keys(table, "", _TOP, required=_TOP - _OPTIONAL)
    name = table.get("name", "unnamed")
    if not isinstance(name, str):
        raise InputError("", "name", f"{name!r} is not a string")
    epsilon = require_number(table["epsilon"], "epsilon", nonnegative=True)
    scene = _read_scene(table)
    check_ranges(scene)
    check_epsilon(scene, epsilon)
    start = _read_start(scene, _table(table, "start"))
    given = table["phases"]
    if not isinstance(given, list) or not given:
        raise InputError("", "phases", f"{given!r} is not a list of one or more [[phases]]")
    phases = tuple(_read_phase(scene, i, entry) for i, entry in enumerate(given))
    for phase, following in zip(phases, [*phases[1:], None], strict=True):
        _check_end(phase, following)
    problem = Problem(name, scene, epsilon, start, phases, source, table)
    _check_start(problem)
    _check_first_formation(problem)
    return problem


def _read_scene(table: Mapping[str, Any]) -> Scene:
    body = _table(table, "object")
    _check_keys(body, "object", _OBJECT, required=_OBJECT - {"inertia"})
    polygon = Polygon(body["vertices"], body["mass"], body.get("inertia"))
    fingers = _table(table, "fingers")
    _check_keys(fingers, "fingers", {"1", "2"}, required={"1", "2"})
    friction = _table(table, "friction")
    parts = {"palm", "finger1", "finger2"}
    _check_keys(friction, "friction", parts, required=parts)
    return Scene(
        polygon,
        (_read_finger(fingers, "1"), _read_finger(fingers, "2")),
        Friction(friction["palm"], friction["finger1"], friction["finger2"]),
        table.get("gravity", 9.81),
        table.get("fingers_collide", True),
    )


def _read_finger(fingers: Mapping[str, Any], key: str) -> Finger:
    name = f"fingers.{key}"
    entry = _table(fingers, key, name)
    _check_keys(entry, name, set(_FINGER), required={k for k, needed in _FINGER.items() if needed})
    defaults = {"radius": 0.0, "viscous": 0.0, "dry": 0.0}
    return Finger(**(defaults | dict(entry)), name=name)


def _read_start(scene: Scene, start: Mapping[str, Any]) -> Array:
    _check_keys(start, "start", {"flush", "x"}, required={"flush", "x"})
    edge, count = start["flush"], scene.polygon.n_vertices
    if not isinstance(edge, int) or isinstance(edge, bool) or not 0 <= edge < count:
        raise InputError(
            "", "start.flush", f"{edge!r} is not an edge; allowed are 0 to {count - 1}"
        )
    x = require_number(start["x"], "start.x")
    check_place(scene, "start.x", x)
    q = place_flush(scene, edge, x)
    z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
    z.setflags(write=False)
    return z


def _read_phase(scene: Scene, index: int, entry: object) -> Phase:
    key = f"phases[{index + 1}]"
    if not isinstance(entry, dict):
        raise InputError("", key, f"{entry!r} is not a table")
    _check_keys(entry, key, {"contacts", "until", "end"}, required={"contacts"})
    names = entry["contacts"]
    if not isinstance(names, list) or not names:
        raise InputError("", f"{key}.contacts", f"{names!r} is not a list of contact names")
    formation = _at(f"{key}.contacts", lambda: _read_formation(scene, names))
    contacts = formation.contacts
    given = entry.get("end", End.REST.value)
    if given not in [end.value for end in End]:
        raise InputError("", f"{key}.end", f"{given!r} given; allowed are {_ENDS}")
    until, end = Until(), End(given)
    if "until" in entry:
        until = _at(f"{key}.until", lambda: _read_until(scene, entry["until"]))
    elif end is not End.SMOOTH:
        raise InputError(
            "", f"{key}.until", "is missing; only a phase with end = 'smooth' has none"
        )
    if until.contact in contacts and until.contact is not None:
        raise InputError("", f"{key}.until", f"{until} is already in the phase's contacts")
    return Phase(index, formation, until, end)


def _read_formation(scene: Scene, names: list[object]) -> Formation:
    """Read contacts, each sliding unless its name is followed by ``rolling``."""
    stems = [n.removesuffix(ROLLING) if isinstance(n, str) else n for n in names]
    contacts = tuple(_parse_name(stem, scene) for stem in stems)
    twice = {contact.name for contact in contacts if contacts.count(contact) > 1}
    if twice:
        raise InputError("", "", f"{', '.join(sorted(twice))} is given twice")
    rolls = [stem != name for stem, name in zip(stems, names, strict=True)]
    rolling = tuple(contact for contact, own in zip(contacts, rolls, strict=True) if own)
    formation = Formation(scene, contacts, rolling)
    for row in formation.rolling_rows:
        if formation.friction[row] == 0:
            finger = contacts[row].finger
            part = "palm" if finger is None else f"finger{finger + 1}"
            raise InputError(
                "", "", f"{contacts[row]} cannot roll without friction, and friction.{part} is 0"
            )
    if rolling and formation.n_constraints > 4:
        raise InputError(
            "",
            "",
            f"{len(contacts)} contacts of which {len(rolling)} roll leave no freedom to move: a "
            f"rolling one counts twice, which makes {formation.n_constraints}; allowed are up to 4",
        )
    return formation


def _parse_name(name: object, scene: Scene) -> Contact:
    try:
        return parse_contact(name, scene)
    except InputError as error:
        if isinstance(name, str) and " " in name:
            raise InputError("", "", f"{error.problem}; {ROLLING!r} may follow") from None
        raise


def _read_until(scene: Scene, given: object) -> Until:
    if isinstance(given, str):
        return Until(contact=parse_contact(given, scene))
    allowed = "allowed are a contact name, { phi_deg = ... } or { x = ... }"
    if not isinstance(given, dict) or len(given) != 1 or not set(given) <= {"phi_deg", "x"}:
        raise InputError("", "", f"{given!r} does not end a phase; {allowed}")
    ((key, value),) = given.items()
    number = require_number(value, "")
    if key == "x":
        check_place(scene, "", number)
        return Until(coordinate="x", value=number)
    TURN.check("", number, "degrees")
    return Until(coordinate="phi", value=math.radians(number))


def _check_end(phase: Phase, following: Phase | None) -> None:
    """Check that a phase passes into the next one as its `end` says."""
    if phase.end is End.REST:
        return
    key, until = f"phases[{phase.number}].end", phase.until
    given = f"{phase.end.value!r} given"
    if following is None:
        raise InputError("", key, f"{given}, but the last phase ends at rest")
    contacts = following.formation.contacts
    if phase.end is End.IMPACT and until.contact is None:
        raise InputError("", key, f"{given}, but until is {until}, not a contact that is gained")
    if phase.end is End.IMPACT and until.contact not in contacts:
        raise InputError("", key, f"{given}, but phase {following.number} does not have {until}")
    before = {*phase.formation.contacts, until.contact}
    extra = [c.name for c in contacts if c not in before]
    if extra:
        raise InputError(
            "", key, f"{given}, but phase {following.number} has {', '.join(extra)} too"
        )
    same = set(contacts) == set(phase.formation.contacts)
    if (
        until.is_release
        and same
        and set(following.formation.rolling) == set(phase.formation.rolling)
    ):
        raise InputError(
            "", key, f"phase {following.number} releases no contact, and none rolls or slides anew"
        )


def _check_first_formation(problem: Problem) -> None:
    """Check that what the first phase names touches; it may let go what else does."""
    touching = find_touching(problem.scene, problem.start)
    first = problem.phases[0].formation.contacts
    if not set(first) <= set(touching):
        raise InputError(
            "",
            "phases[1].contacts",
            f"{describe(first)} given, but the closed fingers touch {describe(touching)}",
        )


def _check_start(problem: Problem) -> None:
    """Check that the fingers do not overlap at the start."""
    scene = problem.scene
    if not scene.fingers_collide:
        return
    gap = float(evaluate_finger_gap(scene, problem.start[None])[0])
    if gap < -scene.touching:
        raise InputError(
            "",
            "start.x",
            f"{problem.start[0]:g} closes the fingers into each other: their gap is {gap:.4g} m; "
            "allowed is 0 or more, unless fingers_collide = false",
        )


def _at(key: str, read: Callable[[], _T]) -> _T:
    """Run `read`, giving the key to an error that does not know its own."""
    try:
        return read()
    except InputError as error:
        raise InputError("", key, error.problem) from None


def _table(parent: Mapping[str, Any], key: str, name: str = "") -> Mapping[str, Any]:
    value = parent[key]
    if not isinstance(value, dict):
        raise InputError("", name or key, f"{value!r} is not a table")
    return value


def _check_keys(
    table: Mapping[str, Any], where: str, allowed: set[str], required: set[str]
) -> None:
    prefix = f"{where}." if where else ""
    for key in table:
        if key not in allowed:
            from difflib import get_close_matches

            near = get_close_matches(key, allowed, 1, 0.5)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise InputError(
                "", f"{prefix}{key}", f"unknown key; {hint}allowed are {', '.join(sorted(allowed))}"
            )
    for key in sorted(required - set(table)):
        raise InputError("", f"{prefix}{key}", "is missing")
