"""Projection onto closed contacts (Gauss-Newton), and global search for the end of a phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import close_fingers, find_reach, lower
from ..contacts.formation import Formation
from ..mechanics.dynamics import metric_weights

GRID = (120, 60)  # places across x and phi at which a formation is looked at
STILL = 1e-4  # distance from the start, in radii of gyration, that counts as none


Fixed = tuple[tuple[int, float | Array], ...]
"""Rows of z, and values that they have to take, one or (n,)."""


@dataclass(frozen=True, eq=False)
class Ending:
    """What has to hold where a phase ends."""

    formation: Formation  # contacts that are closed
    fixed: Fixed = ()  # rows of z and the values that they have to take
    active: tuple[int, ...] = ()  # limits of the formation that are met exactly

    def measure(self, z: Array) -> Array:
        """How far configurations with the phase's own contacts closed are from the end [m]."""
        metric = metric_weights(self.formation.scene)
        off = np.abs(self.formation.evaluate(z, z).C).max(axis=1)
        for row, value in self.fixed:
            off = np.maximum(off, np.abs(z[:, row] - value) * np.sqrt(metric[row]))
        if self.active:
            limits = self.formation.evaluate_limits(z)[:, list(self.active)]
            off = np.maximum(off, np.abs(limits).max(axis=1))
        return np.asarray(off)


def explore(formation: Formation, z: Array, slip: Array, ends: list[Ending]) -> Array | None:
    """Nearest of several ends of a phase from z, (5,), by a multistart over the formation, or None.

    Only with palm and both fingers touching, where (x, phi) determines the configuration.
    """
    parts = [contact.finger for contact in formation.contacts]
    if len(parts) != 3 or set(parts) != {None, 0, 1} or formation.rolling:
        return None
    metric = metric_weights(formation.scene)
    places = _list_places(formation, z)
    found, least = None, np.inf
    for end in ends:
        off = end.measure(places)
        order = np.argsort(off)[:24]
        for k in order[np.argsort((places[order] - z) ** 2 @ metric)]:
            goal = close_contacts(end.formation, places[k], slip, end.fixed, end.active)
            if goal is None or not is_inside(end.formation, goal):
                continue
            distance = float(metric @ (goal - z) ** 2)
            # One that holds at the start is no end to go to.
            if STILL * formation.scene.scales.length < np.sqrt(distance) < least:
                found, least = goal, np.sqrt(distance)
    return found


def is_inside(formation: Formation, z: Array) -> bool:
    """Whether a configuration, shape (5,), keeps all limits of a formation."""
    return bool(formation.evaluate_limits(z[None]).min() > -formation.scene.touching)


def _list_places(formation: Formation, z: Array) -> Array:
    """Configurations all over a formation of palm and both fingers, shape (n, 5)."""
    scene = formation.scene
    turned = z[2] + np.linspace(-np.pi, np.pi, 721)
    (lowest,) = (c.index for c in formation.contacts if c.finger is None)
    turned = turned[lower(scene, turned)[1] == lowest]
    across = np.linspace(*find_reach(scene), GRID[0])
    x, phi = np.meshgrid(across, np.linspace(turned.min(), turned.max(), GRID[1]))
    closed = close_fingers(scene, x.ravel(), phi.ravel()).z
    closed = np.vstack([z, closed[np.isfinite(closed).all(axis=1)]])
    gaps = np.abs(formation.evaluate(closed, closed).C).max(axis=1)
    inside = formation.evaluate_limits(closed).min(axis=1) > -scene.touching
    return np.asarray(closed[inside & (gaps < scene.touching)])


def close_contacts(
    formation: Formation, z: Array, slip: Array, fixed: Fixed = (), active: tuple[int, ...] = ()
) -> Array | None:
    """As `close_all` for one configuration, shape (5,); None if there is none."""
    closed = close_all(formation, z[None], slip, fixed, active)[0]
    return closed if np.isfinite(closed).all() else None


def close_all(
    formation: Formation, z: Array, slip: Array, fixed: Fixed = (), active: tuple[int, ...] = ()
) -> Array:
    """Nearest configurations with all contacts closed, by Gauss-Newton, shape (n, 5), or NaN.

    Parameters
    ----------
    z : (n, 5)       initial values
    slip : (R,) [m]  slip coordinates of rolling contacts
    fixed            rows of z and their values
    active           limits of the formation that are zero
    """
    metric, rho = metric_weights(formation.scene), formation.scene.scales.length
    sizes = np.full(formation.n_constraints, rho)
    steps = 1e-5 * np.diag([rho, rho, 1.0, 1.0, 1.0])
    sizes = np.append(sizes, [rho if row < 2 else 1.0 for row, _ in fixed])
    sizes = np.append(sizes, np.full(len(active), rho))
    found, z, left = np.full(z.shape, np.nan), z.copy(), np.arange(len(z))
    for _ in range(50):
        kinematics = formation.evaluate(z, np.zeros(z.shape))
        residual = np.hstack([kinematics.C, formation.evaluate_slip(z) - slip])
        rows = kinematics.P
        for row, value in fixed:
            own = np.broadcast_to(value, len(found))[left]
            residual = np.column_stack([residual, z[:, row] - own])
            one = np.broadcast_to(np.eye(5)[row], (len(z), 1, 5))
            rows = np.concatenate([rows, one], axis=1)
        if active:
            residual = np.hstack([residual, formation.evaluate_limits(z)[:, active]])
            near = (z[:, None] + np.vstack([steps, -steps])).reshape(-1, 5)
            around = formation.evaluate_limits(near)[:, active].reshape(len(z), 2, 5, -1)
            slopes = (around[:, 0] - around[:, 1]) / (2 * steps.diagonal()[:, None])
            rows = np.concatenate([rows, slopes.swapaxes(1, 2)], axis=1)
        rows, residual = rows / sizes[:, None], residual / sizes
        lift = (rows / metric).swapaxes(1, 2)
        change = (lift @ np.linalg.pinv(rows @ lift, rcond=1e-12) @ residual[..., None])[..., 0]
        # Long steps overshoot where links turn; a tenth of a radian keeps to one branch.
        turned = np.abs(change[:, 2:]).max(axis=1, keepdims=True)
        z = z - change * np.minimum(1.0, 0.1 / np.maximum(turned, 1e-12))
        closed = np.abs(residual).max(axis=1) < 3e-11
        found[left[closed]] = z[closed]
        z, left = z[~closed], left[~closed]
        if not len(left):
            break
    return found
