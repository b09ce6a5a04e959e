from __future__ import annotations

import numpy as np

from wholearm.benchmark.stress.newton import balance, locate
from wholearm.contacts.elemental import candidate_contacts
from wholearm.contacts.formation import Formation
from wholearm.problem.definition import Problem
from wholearm.results.trajectory import Trajectory


def test_contacts_are_those_of_the_planner(heptagon: Problem) -> None:
    """Points and normals of rigid bodies give the Jacobians of the C-functions."""
    scene, random = heptagon.scene, np.random.default_rng(3)
    z = heptagon.start + random.normal(0.0, 0.02, (7, 5))
    contacts = tuple(c for part in (None, 0, 1) for c in candidate_contacts(scene, part))
    rows = Formation(scene, contacts).evaluate(z, z)
    for k, contact in enumerate(contacts):
        touch = locate(scene, contact.name, z)
        np.testing.assert_allclose(touch.gap, rows.C[:, k], atol=1e-14)
        np.testing.assert_allclose(touch.normal, rows.A[:, k], atol=1e-14)
        np.testing.assert_allclose(touch.tangent, rows.A_t[:, k], atol=1e-14)


def test_a_gap_changes_by_the_rate_of_separation(heptagon: Problem) -> None:
    scene, step = heptagon.scene, 1e-6
    way = np.array([0.3, -0.2, 1.0, 0.7, -0.4])
    for name in ("v2-palm", "v2-finger1", "v5-finger2", "e3-tip1", "v3-tip2"):
        z = np.stack([heptagon.start - step * way, heptagon.start + step * way])
        gaps = locate(scene, name, z).gap
        rate = locate(scene, name, heptagon.start[None]).normal[0] @ way
        np.testing.assert_allclose((gaps[1] - gaps[0]) / (2 * step), rate, rtol=1e-6)


def test_what_is_left_of_the_equations_is_the_force_that_is_missing(
    heptagon: Problem, trajectory: Trajectory
) -> None:
    scene, motion = heptagon.scene, trajectory.motions[0]
    rows = motion.evaluate(np.linspace(0.01, 0.05, 5))
    touches = [locate(scene, name, rows.z) for name in motion.contacts]
    forces = np.stack([rows.c_n, rows.c_t])
    rates = (rows.z_dot, rows.z_ddot)
    assert np.abs(balance(scene, touches, rates, rows.tau, forces)).max() < 1e-9
    more = rows.tau + np.array([0.0, 0.25])
    left = balance(scene, touches, rates, more, forces)
    np.testing.assert_allclose(left[:, 4], -0.25, atol=1e-9)
    forces[0, :, 0] -= 0.5
    left = balance(scene, touches, rates, rows.tau, forces)
    np.testing.assert_allclose(left, 0.5 * touches[0].normal, atol=1e-9)
