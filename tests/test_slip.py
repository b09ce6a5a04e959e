from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from plane import make_formation, make_scene
from test_elemental import KITE, NAMES, STEP, configurations, measure_gap
from wholearm.contacts.elemental import build_features
from wholearm.contacts.formation import build_slip
from wholearm.scene.model import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(KITE)


@pytest.mark.parametrize("name", NAMES)
def test_slip_coordinate_integrates_the_sliding_velocity(scene: Scene, name: str) -> None:
    """Where a contact touches, the gradient of its slip is A_t, by derivative and difference."""
    formation = make_formation(scene, name)
    slip, z_symbol = build_slip(formation.contacts[0], scene), build_features(scene).z
    function = ca.Function("slip", [z_symbol], [slip, ca.jacobian(slip, z_symbol)])
    rng = np.random.default_rng(6)
    for z in configurations(6, 8):
        gap, _, normal = measure_gap(scene, formation.contacts[0], z)
        z[:2] -= gap * normal
        v = rng.uniform(-1, 1, 5)
        A_t = formation.evaluate(z[None], v[None]).A_t[0]
        np.testing.assert_allclose(function(z)[1].full(), A_t, atol=1e-14)
        rise = float(function(z + STEP * v)[0] - function(z - STEP * v)[0])
        # On a tip's arc truncation is (STEP / radius)^2.
        assert rise / (2 * STEP) == pytest.approx(A_t[0] @ v, abs=(STEP / 0.005) ** 2)
