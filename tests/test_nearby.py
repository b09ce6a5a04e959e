from __future__ import annotations

import numpy as np

from test_legs import PHI, on_border
from wholearm.mapping.legs import choose_leg, describe_miss, find_miss, tolerance
from wholearm.problem.definition import Problem


def test_near_miss_names_the_border_and_its_distance(heptagon: Problem) -> None:
    scene, near = heptagon.scene, tolerance(heptagon.scene)
    aside = np.array([near[0], 0.0])
    start, stop = (on_border(heptagon, phi) + 2.0 * aside for phi in (PHI, PHI + 0.2))
    miss = find_miss(scene, start, stop)
    assert miss is not None and miss.track.flush == (1, 6)
    assert 1.0 < miss.off <= 2.0
    text = describe_miss(scene, miss)
    assert (
        "e6 flush on finger 2" in text
        and " up to -" in text
        and "mm in x" in text
        and "0.5 deg" in text
    )
    assert find_miss(scene, start + 10 * aside, stop + 10 * aside) is None
    phi = scene.polygon.flush_angle(0) + 3 * near[1]
    palm = find_miss(scene, np.array([0.045, phi]), np.array([0.0, phi]))
    assert palm is not None and "e0 flush on the palm, is up to -1.5 deg" in describe_miss(
        scene, palm
    )


def test_tolerance_is_relative_to_the_object(heptagon: Problem) -> None:
    """1.5 % of the radius of gyration, half a millimetre for the heptagon, and half a degree."""
    near = tolerance(heptagon.scene)
    assert near[0] == 0.015 * heptagon.scene.scales.length
    np.testing.assert_allclose(near, [5e-4, np.radians(0.5)], rtol=0.01)


def test_leg_with_one_end_off_the_border_is_straight(heptagon: Problem) -> None:
    scene, near = heptagon.scene, tolerance(heptagon.scene)
    start, stop = on_border(heptagon, PHI), on_border(heptagon, PHI + 0.2)
    assert choose_leg(scene, start, stop).track.flush == (1, 6)
    off = stop + np.array([4 * near[0], 4 * near[1]])
    assert choose_leg(scene, start, off).track.flush is None
