"""Replays in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..policy.playback import ClosedLoop
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from .mjcf import Softness, write_mjcf
from .shapes import find_pairs, list_pairs
from .stretch import (
    EngineDrive,
    EngineRun,
    EngineStretch,
    Setting,
    list_steps,
    press_in,
    record,
)


def play(
    problem: Problem, stretch: EngineStretch, torque: TorqueProfile | ClosedLoop, setting: Setting
) -> EngineRun:
    """Replay a stretch in MuJoCo; an `Engine`.

    ImportError if MuJoCo is not installed.
    """
    import mujoco

    steps = list_steps(problem, stretch, torque, setting.step)
    drive = EngineDrive(problem.scene, torque, steps.h) if isinstance(torque, ClosedLoop) else None
    own, factor = Softness(), setting.softness
    own = own._replace(press=factor * own.press, rub=factor * own.rub)
    text = write_mjcf(problem, step=steps.h, softness=own)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    pairs = list_pairs(problem.scene)
    # Numbers of the pairs by the numbers of their shapes, in either order.
    numbers = np.full((model.ngeom, model.ngeom), -1)
    for number, pair in enumerate(pairs):
        first, second = (model.geom(name).id for name in (pair.first, pair.second))
        numbers[first, second] = numbers[second, first] = number

    def add(total: Array, find: Callable[[Any], Array]) -> None:
        """Add to totals of pairs what `find` has for the rows of their constraints."""
        contact, held = data.contact, data.contact.efc_address >= 0
        pair = numbers[contact.geom1[held], contact.geom2[held]]
        np.add.at(total, pair, find(contact.efc_address[held]))

    def advance(start: int, end: int) -> Array:
        total = np.zeros(len(pairs))
        for step in range(start, end):
            tau = steps.tau[step]
            if drive is not None:
                tau = drive.step(step * steps.h, data.qpos[3:], data.qvel[3:])
            data.ctrl[:] = tau
            mujoco.mj_step(model, data)
            if data.ncon:
                add(total, lambda rows: data.efc_force[rows])
        return total / (end - start)

    # MuJoCo computes stiffnesses from time constants and inertias; they are read at a small depth.
    nowhere = dict.fromkeys(stretch.c_n, np.inf)
    little = 1e-6 * problem.scene.scales.length
    touching = {name: max(force, 0.0) / little for name, force in stretch.c_n.items()}
    data.qpos[:] = press_in(problem, stretch, {**nowhere, **touching})
    mujoco.mj_forward(model, data)
    found = np.zeros(len(pairs))
    add(found, lambda k: data.efc_KBIP[k, 0] * data.efc_KBIP[k, 2] / data.efc_R[k])
    names, corners = [pair.name for pair in pairs], problem.scene.polygon.n_vertices
    shares = {
        name: sum(found[names.index(own)] for own in find_pairs(name, corners)) or np.inf
        for name in stretch.c_n
    }
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = press_in(problem, stretch, shares), steps.v
    # Warnings of states that are not finite would go to stderr and to a file; the deviation shows.
    mujoco.set_mju_user_warning(lambda _: None)
    run = record(
        stretch, steps, pairs, drive, advance, lambda: (data.qpos.copy(), data.qvel.copy())
    )
    mujoco.set_mju_user_warning(None)
    return run
