"""Numbers of a problem that are not known exactly, by how much, and the table that says so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..common.errors import InputError
from ..common.require import require_number
from ..scene.model import Friction, Scene

LENGTH = 1 / 30
"""Length of a scene, where none is known [m]: about that of the scenes in `problems/`."""


@dataclass(frozen=True)
class Parameter:
    """A number of a problem that may be off, or one of its torques.

    Attributes
    ----------
    name : str
    default : float
        Half width of its range; of lengths over the scene's length.
    unit : str
        Of the half width; empty for a relative one.
    """

    name: str
    default: float
    unit: str = ""

    def find_default(self, length: float = LENGTH) -> float:
        """The default in its unit, with the length of the scene [m]."""
        return self.default * length if self.unit == "m" else self.default


PARAMETERS = (
    Parameter("mass", 0.05),
    Parameter("inertia", 0.05),
    Parameter("friction_palm", 0.1),
    Parameter("friction_finger1", 0.1),
    Parameter("friction_finger2", 0.1),
    Parameter("length1", 6e-3, "m"),
    Parameter("length2", 6e-3, "m"),
    Parameter("base1_x", 6e-3, "m"),
    Parameter("base1_y", 6e-3, "m"),
    Parameter("base2_x", 6e-3, "m"),
    Parameter("base2_y", 6e-3, "m"),
    Parameter("start_x", 6e-3, "m"),
    Parameter("gain1", 0.01),
    Parameter("gain2", 0.01),
    Parameter("delay", 1e-3, "s"),
)
"""All that can be varied. A delay is never negative: its range is [0, half width]."""

NAMES = tuple(parameter.name for parameter in PARAMETERS)
GROUPS: Mapping[str, tuple[str, ...]] = {
    "friction": ("friction_palm", "friction_finger1", "friction_finger2"),
    "geometry": ("length1", "length2", "base1_x", "base1_y", "base2_x", "base2_y"),
    "gain": ("gain1", "gain2"),
}
"""Names that stand for several."""


def read_widths(
    given: Mapping[str, object], label: str = "uncertainty.{}", length: float = LENGTH
) -> dict[str, float]:
    """Half widths of all ranges, with the defaults of those that are not named; zero is none.

    Parameters
    ----------
    given, label
        As for `spread_widths`.
    length : float, [m]
        The scene's, which defaults of lengths are in proportion to.
    """
    return {own.name: own.find_default(length) for own in PARAMETERS} | spread_widths(given, label)


def spread_widths(given: Mapping[str, object], label: str) -> dict[str, float]:
    """Half widths of the ranges that are given, by parameter; zero leaves one as it is.

    A parameter's own range counts before that of a group.

    Parameters
    ----------
    given : mapping
        By name of the parameter, or of a group.
    label : str
        What messages call a range, with a place for its name.

    Raises
    ------
    InputError
        If a name is unknown, or a width is not a number from zero to what makes sense: below one
        for relative ones.
    """
    widths = dict[str, float]()
    for key, value in sorted(given.items(), key=lambda item: item[0] not in GROUPS):
        if key not in (*NAMES, *GROUPS):
            allowed = ", ".join((*GROUPS, *NAMES))
            raise InputError("", label.format(key), f"is unknown; allowed are {allowed}")
        width, names = require_number(value, label.format(key), nonnegative=True), _list_names(key)
        if width >= 1 and any(own.name in names and not own.unit for own in PARAMETERS):
            text = f"{width:g} given; a relative range is below 1"
            raise InputError("", label.format(key), text)
        widths |= dict.fromkeys(names, width)
    return widths


def _list_names(key: str) -> tuple[str, ...]:
    return GROUPS.get(key, (key,))


def change_scene(scene: Scene, changes: Mapping[str, float]) -> Scene:
    """A scene whose numbers are off.

    Parameters
    ----------
    scene : Scene
    changes : mapping of str to float
        By name of the parameter: relative, or in the parameter's unit. Those of torques and of the
        start do nothing here.

    Raises
    ------
    InputError
        If a number makes no sense any more.
    """

    def change(name: str) -> float:
        return changes.get(name, 0.0)

    body = scene.polygon
    assert body.inertia is not None
    mass, inertia = body.mass * (1 + change("mass")), body.inertia * (1 + change("inertia"))
    first, second = (
        replace(
            finger,
            length=finger.length + change(f"length{number}"),
            base=np.asarray(finger.base) + [change(f"base{number}_{axis}") for axis in "xy"],
        )
        for number, finger in enumerate(scene.fingers, start=1)
    )
    parts = ("palm", "finger1", "finger2")
    mu = {part: getattr(scene.friction, part) * (1 + change(f"friction_{part}")) for part in parts}
    return replace(
        scene,
        polygon=replace(body, mass=mass, inertia=inertia),
        fingers=(first, second),
        friction=Friction(**mu),
    )
