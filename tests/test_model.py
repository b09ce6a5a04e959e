from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from plane import SQUARE, make_finger, make_scene
from wholearm.common.errors import LONGEST, InputError, name_source, require_number, require_vector
from wholearm.common.fields import keys_of
from wholearm.scene.model import Finger, Friction, Scene
from wholearm.scene.polygon import Polygon


@pytest.mark.parametrize("value", [-1.0, math.nan, True, "1"])
@pytest.mark.parametrize(
    "key", ["length", "radius", "inertia", "viscous", "dry", "torque_limit", "speed_limit"]
)
def test_bad_finger_number(key: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        replace(make_finger([0, 0]), **{key: value}, name="fingers.2")
    assert caught.value.key == f"fingers.2.{key}"
    assert repr(value) in caught.value.problem


@pytest.mark.parametrize("key", ["radius", "viscous", "dry"])
def test_zero_is_allowed_where_it_means_none(key: str) -> None:
    change: dict[str, Any] = {key: 0}
    assert getattr(replace(make_finger([0, 0]), **change), key) == 0.0


@pytest.mark.parametrize("key", ["length", "inertia", "torque_limit", "speed_limit"])
def test_zero_is_refused_where_it_means_nothing(key: str) -> None:
    change: dict[str, Any] = {key: 0.0}
    with pytest.raises(InputError, match="positive"):
        replace(make_finger([0, 0]), **change)


@pytest.mark.parametrize("base", [[0.1], [0.1, math.nan], "ab", None, [0.1, 0.2, 0.3]])
def test_bad_base(base: Any) -> None:
    with pytest.raises(InputError) as caught:
        replace(make_finger([0, 0]), base=base)
    assert caught.value.key == "fingers.base"


@pytest.mark.parametrize("key", ["palm", "finger1", "finger2"])
@pytest.mark.parametrize("value", [-0.1, math.nan, False, "x"])
def test_bad_friction(key: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        Friction(**({"palm": 0.1, "finger1": 0.1, "finger2": 0.1} | {key: value}))
    assert caught.value.key == f"friction.{key}"


@pytest.mark.parametrize("right", [-0.081, -0.2])
def test_swapped_fingers(right: float) -> None:
    scene = make_scene()
    with pytest.raises(InputError, match="not to the right") as caught:
        replace(scene, fingers=(make_finger([right, 0.0]), scene.fingers[1]))
    assert caught.value.key == "fingers.1.base"


def test_scene_vectors_follow_the_order_of_z() -> None:
    scene = make_scene()
    right, left = scene.fingers
    fingers = (
        replace(right, inertia=1.0, viscous=2.0, dry=3.0, torque_limit=4.0, speed_limit=5.0),
        replace(left, inertia=6.0, viscous=7.0, dry=8.0, torque_limit=9.0),
    )
    scene = Scene(Polygon(SQUARE, 0.5, 0.25), fingers, scene.friction, gravity=2.0)
    assert scene.mass_diagonal == pytest.approx([0.5, 0.5, 0.25, 1.0, 6.0])
    assert scene.applied_force == pytest.approx([0.0, -1.0, 0.0, 0.0, 0.0])
    assert scene.viscous == pytest.approx([0.0, 0.0, 0.0, 2.0, 7.0])
    assert scene.dry == pytest.approx([0.0, 0.0, 0.0, 3.0, 8.0])
    assert scene.torque_limit == pytest.approx([4.0, 9.0])
    assert scene.speed_limit == pytest.approx([5.0, math.inf])


def test_scales_follow_the_units() -> None:
    scene = make_scene(SQUARE)
    scales = scene.scales
    assert scales.force == scene.polygon.mass * scene.gravity
    assert scales.speed * scales.time == pytest.approx(scales.length, rel=1e-14)
    assert scales.acceleration * scales.time**2 == pytest.approx(scales.length, rel=1e-14)
    assert scales.acceleration == pytest.approx(scene.gravity, rel=1e-14)


def test_without_gravity_the_weaker_finger_sets_the_force() -> None:
    long, short = make_finger([0.1, 0.0], length=0.3), make_finger([-0.1, 0.0], length=0.1)
    scene = replace(make_scene(SQUARE), gravity=0.0, fingers=(long, short))
    assert scene.scales.force == pytest.approx(long.torque_limit / 0.3 / 100, rel=1e-14)


def test_every_number_of_a_finger_has_a_unit_of_the_scene() -> None:
    """Problem files and planning in own units take new fields from here."""
    scene = make_scene()
    known = keys_of(Finger)
    assert {own.name for own in fields(Finger)} - set(known) == {"name"}
    assert all(getattr(scene.scales, own.scale) > 0 for own in known.values())


@pytest.mark.parametrize("value", [3, 3.0, np.float32(3), np.int64(3)])
def test_require_number_takes_every_real_kind(value: Any) -> None:
    number = require_number(value, "key")
    assert number == 3.0 and type(number) is float


@pytest.mark.parametrize("value", [np.bool_(True), np.complex128(1), b"1"])
def test_require_number_refuses_what_is_not_real(value: Any) -> None:
    with pytest.raises(InputError, match="key"):
        require_number(value, "key")


def test_require_vector_takes_tuples_and_arrays() -> None:
    assert require_vector((1, 2), "key", 2).tolist() == [1.0, 2.0]
    assert require_vector(np.array([1, 2]), "key", 2).tolist() == [1.0, 2.0]


@pytest.mark.parametrize("given", ["\n" * 3, "\x00" * 5000, "x" * 5000, "\u2028", "\x1b[2J"])
def test_a_message_is_one_line(given: str) -> None:
    text = str(InputError("a.toml", "name", f"{given} is not allowed"))
    assert text.isprintable() and len(text) <= LONGEST + 10
    assert text.startswith("a.toml: name: ") and text.endswith(" is not allowed")


def test_letters_of_all_scripts_stay() -> None:
    assert str(InputError("", "\u00e9", "\u4e2d")) == "\u00e9: \u4e2d"


def test_a_source_is_given_to_errors_without_one() -> None:
    with pytest.raises(InputError, match="b: key: problem"), name_source("b"):
        raise InputError("", "key", "problem")
    with pytest.raises(InputError, match="a: key: problem"), name_source("b"):
        raise InputError("a", "key", "problem")
