"""Numbers of a problem that are not known exactly, by how much, and the table that says so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..common.errors import InputError, require_number
from ..common.fields import NONNEGATIVE, Field, leave
from ..common.fields import key as declare_key
from ..scene.model import Friction, Scene

LENGTH = 1 / 30
"""Length of a scene, where none is known [m]: about that of the scenes in `problems/`."""
_RELATIVE = leave({"type": "number", "minimum": 0, "exclusiveMaximum": 1})


def _declare(names: str, default: float, unit: str = "") -> list[Field]:
    """Half widths of the ranges of numbers, relative where there is no unit."""
    text, kind = (f"Half width [{unit}].", NONNEGATIVE) if unit else (_TEXT, _RELATIVE)
    return [declare_key(name, text, kind, default=default) for name in names.split()]


_TEXT = "Half width, relative."
PARAMETERS = (
    *_declare("mass inertia", 0.05),
    *_declare("friction_palm friction_finger1 friction_finger2", 0.1),
    *_declare("length1 length2 base1_x base1_y base2_x base2_y start_x", 6e-3, "m"),
    *_declare("gain1 gain2", 0.01),
    *_declare("delay", 1e-3, "s"),
)
"""All that can be varied; defaults of lengths are over the scene's length. A delay is never
negative: its range is [0, half width]."""

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
    given, label  as for `spread_widths`
    length : [m]  the scene's, which defaults of lengths are in proportion to
    """
    defaults = {own.name: own.default * (length if own.unit == "m" else 1) for own in PARAMETERS}
    return defaults | spread_widths(given, label)


def spread_widths(given: Mapping[str, object], label: str) -> dict[str, float]:
    """Half widths of the ranges that are given, by parameter; zero leaves one as it is.

    A parameter's own range counts before that of a group.

    Parameters
    ----------
    given  by name of the parameter, or of a group
    label  what messages call a range, with a place for its name

    Raises
    ------
    InputError  if a name is unknown, or a width is not a number from zero to what makes sense:
                below one for relative ones
    """
    widths = dict[str, float]()
    for name, value in sorted(given.items(), key=lambda item: item[0] not in GROUPS):
        key = label.format(name)
        if name not in (*NAMES, *GROUPS):
            raise InputError("", key, f"is unknown; allowed are {', '.join((*GROUPS, *NAMES))}")
        width, names = require_number(value, key, nonnegative=True), GROUPS.get(name, (name,))
        if width >= 1 and any(own.name in names and not own.unit for own in PARAMETERS):
            raise InputError("", key, f"{width:g} given; a relative range is below 1")
        widths |= dict.fromkeys(names, width)
    return widths


def change_scene(scene: Scene, changes: Mapping[str, float]) -> Scene:
    """A scene whose numbers are off.

    Parameters
    ----------
    changes  by name of the parameter: relative, or in the parameter's unit. Those of torques and of
             the start do nothing here.

    Raises
    ------
    InputError  if a number makes no sense any more
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
