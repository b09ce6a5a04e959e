"""A plan's torques as parts of an MJCF model, which has no element for torques over time.

A joint of its own, the clock, moves at unit speed, driven and damped so much that nothing else
moves it. For each finger a fixed tendon adds clock and joint angle. Springs on the tendon, each of
which force limits let act from one row of the torque table to the next, make up the torque: a sum
of ramps. The angle's weight in the tendon, `SHARE`, is so small that the springs see the clock
alone, and they are that much stiffer. So the model plays the plan wherever it is opened. The
controls ``motor1`` and ``motor2`` add to it, and are the only ones that a viewer lists: the rest is
in a group that it hides. Keyframes at the starts of phases set the clock too.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

import numpy as np

from ..common.arrays import Array
from ..results.torque_table import place_rows
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from .applied import apply_friction
from .elements import add

SHARE = 1e-6
"""Weight of a joint's angle in its tendon, over the scene's time; that of the clock is 1."""
DRIVE = 1e9
"""Force that drives the clock, over what all springs may exert."""
BEND = 1e-3
"""Largest error of the ramps, relative to the largest torque."""
RISE = 1e-6
"""Least time from row to row, over the time step."""
CLOCK = "clock"
HIDDEN = {"group": 3}
"""Group of joints and actuators for which MuJoCo's viewer has no sliders, unless asked for."""


def list_ramps(scene: Scene, plan: Trajectory, step: float) -> tuple[Array, Array]:
    """Rows of applied torque in increasing time: shape (n,) [s] and (n, 2) [N m].

    At the start of a time step the lines between rows are at the average over that step, so that
    torques that jump within one have the right effect.
    """
    rows = place_rows(apply_friction(scene, plan), BEND)
    t, again = rows[:, 0] - step / 2, np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    t[again] -= step / 2
    t[again + 1] += step / 2
    # Rows that are nearer to a step than that keep their order.
    t = np.maximum.accumulate(t) + RISE * step * np.arange(len(t))
    return t, rows[:, 1:]


def add_clock(root: Element, scene: Scene, plan: Trajectory, step: float) -> None:
    """Add clock, tendons, springs, and a keyframe for the start and for each phase."""
    t, tau = list_ramps(scene, plan, step)
    share = SHARE * scene.scales.time
    rises = np.diff(tau, axis=0) / share
    drive = DRIVE * (np.abs(rises).sum() + np.abs(tau[0]).sum() / share + scene.scales.force)
    body = add(_find(root, "worldbody"), "body", name=CLOCK)
    add(body, "inertial", pos=[0, 0, 0], mass=scene.scales.mass, diaginertia=[1, 1, 1])
    add(body, "joint", name=CLOCK, type="slide", axis=[0, 0, 1], damping=drive, **HIDDEN)
    tendons, springs = add(root, "tendon"), _find(root, "actuator")
    spring = {"gainprm": [0], "biastype": "affine", **HIDDEN}
    add(springs, "general", name=CLOCK, joint=CLOCK, biasprm=[drive, 0, 0], **spring)
    for k, name in enumerate(("torque1", "torque2")):
        tendon = add(tendons, "fixed", name=name)
        add(tendon, "joint", joint=CLOCK, coef=1)
        add(tendon, "joint", joint=f"theta{k + 1}", coef=share)
        first = [tau[0, k] / share, 0, 0]
        add(springs, "general", name=f"{name}-start", tendon=name, biasprm=first, **spring)
        for row in np.flatnonzero(rises[:, k]):
            rise, slope = rises[row, k], rises[row, k] / (t[row + 1] - t[row])
            ramp = {"biasprm": [-slope * t[row], slope, 0], "forcerange": sorted((0.0, rise))}
            add(springs, "general", name=f"{name}-{row}", tendon=name, **ramp, **spring)
    _add_keys(_find(root, "keyframe"), plan)


def _add_keys(keys: Element, plan: Trajectory) -> None:
    """Keyframes with positions, velocities and the clock."""
    starts = plan.phase_starts[:-1]
    rows = [int(np.flatnonzero(plan.phase == index)[0]) for index in range(len(starts))]
    names = ["home", *(f"phase{number}" for number in range(1, len(starts) + 1))]
    for name, row in zip(names, [0, *rows], strict=True):
        t = plan.t[row]
        add(keys, "key", name=name, time=t, qpos=[*plan.z[row], t], qvel=[*plan.z_dot[row], 1.0])


def _find(root: Element, tag: str) -> Element:
    found = root.find(tag)
    assert found is not None
    return found
