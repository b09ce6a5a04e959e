"""Scenes whose numbers differ in the last bits, as other processors and libraries make them."""

from __future__ import annotations

import random
from dataclasses import fields
from functools import cache
from numbers import Real
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..scene.model import Finger, Friction, Scene
from ..scene.polygon import Polygon

LARGEST = 4
"""Largest change of a number, in units of 2^-52 of it."""


def perturb_scenes(seed: int) -> None:
    """Multiply every number of each scene that is made from now on by 1 + k 2^-52, |k| <= 4.

    k follows from the seed, the name of the number and its first 14 digits, to which the number
    is rounded first. So a scene that is made again from its own numbers keeps them.
    """
    for kind in (Polygon, Finger, Friction, Scene):
        _perturb(kind, seed)


def _perturb(kind: Any, seed: int) -> None:
    check = getattr(kind.__post_init__, "exact", kind.__post_init__)
    names = [field.name for field in fields(kind) if field.init and field.name != "name"]

    def check_and_perturb(self: Any) -> None:
        # First as they were given: messages about bad numbers quote them.
        given = [name for name in names if getattr(self, name) is not None]
        left_out = set(names) - set(given)
        check(self)
        for name in left_out:
            object.__setattr__(self, name, None)
        for name in given:
            label = f"{seed} {kind.__name__}.{getattr(self, 'name', '')}.{name}"
            object.__setattr__(self, name, _change(getattr(self, name), label))
        check(self)

    check_and_perturb.exact = check  # type: ignore[attr-defined]
    kind.__post_init__ = check_and_perturb


def _change(value: Any, label: str) -> Any:
    if isinstance(value, np.ndarray):
        return _change_array(value, label)
    if isinstance(value, Real) and not isinstance(value, bool):
        return _change_number(float(value), label)
    return value


def _change_array(values: Array, label: str) -> Array:
    places = np.ndenumerate(values)
    return np.array([_change_number(float(v), f"{label}{i}") for i, v in places]).reshape(
        values.shape
    )


@cache
def _change_number(value: float, label: str) -> float:
    if value == 0.0 or not np.isfinite(value):
        return value
    rounded = float(f"{value:.13e}")
    k = random.Random(f"{label} {rounded!r}").randint(-LARGEST, LARGEST)
    return rounded * (1 + k * 2.0**-52)
