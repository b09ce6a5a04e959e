from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plane import SQUARE, make_formation, make_scene
from tipping import roll
from wholearm.contacts.cones import find_weakest, force_limit_rows, slip_margins
from wholearm.contacts.formation import Formation
from wholearm.scene.model import Friction


@pytest.fixture
def formation() -> Formation:
    scene = replace(make_scene(SQUARE), friction=Friction(0.5, 0.2, 0.3))
    return roll(make_formation(scene, "v0-finger2 v1-palm v2-finger1"), "v1-palm", "v2-finger1")


def test_rows_are_normal_forces_and_both_sides_of_each_cone(formation: Formation) -> None:
    c = np.array([1.0, 2.0, 3.0, 0.7, -0.4])
    expected = [1.0, 2.0, 3.0, 0.5 * 2 - 0.7, 0.2 * 3 + 0.4, 0.5 * 2 + 0.7, 0.2 * 3 - 0.4]
    np.testing.assert_allclose(force_limit_rows(formation) @ c, expected)


def test_without_rolling_contacts_only_normal_forces_count() -> None:
    formation = make_formation(make_scene(SQUARE), "v0-palm v2-finger1")
    np.testing.assert_array_equal(force_limit_rows(formation), np.eye(2))
    assert slip_margins(formation, np.ones((4, 2)), np.ones((4, 2))).shape == (4, 0)
    assert find_weakest(formation, np.array([0.3, -0.2])) == (1, -0.2, None)


def test_margin_to_slipping(formation: Formation) -> None:
    c_n, c_t = np.array([[1.0, 2.0, 3.0]]), np.array([[9.0, -0.7, 0.8]])
    np.testing.assert_allclose(slip_margins(formation, c_n, c_t), [[0.3, -0.2]])


def test_what_gives_way_first(formation: Formation) -> None:
    H = force_limit_rows(formation)
    row, c_n, c_t = find_weakest(formation, H @ [1.0, 2.0, 3.0, 0.7, -0.9])
    assert (row, c_n) == (2, 3.0) and c_t == pytest.approx(-0.9)
    row, c_n, c_t = find_weakest(formation, H @ [1.0, 2.0, 3.0, 1.2, 0.1])
    assert (row, c_n) == (1, 2.0) and c_t == pytest.approx(1.2)
    # A contact that pulls has no cone to be in.
    assert find_weakest(formation, H @ [1.0, 2.0, -0.1, 0.0, 0.0]) == (2, -0.1, None)
