"""Replays in MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..policy.playback import ClosedLoop
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from .departure import find_pairs
from .mjcf import Softness, write_mjcf
from .pressing import EngineDrive, press_in
from .shapes import list_pairs
from .stretch import EngineRun, EngineStretch, Setting, list_steps

_LITTLE = 1e-6  # depth at which stiffnesses are read, over the scene's length


def play(
    problem: Problem, stretch: EngineStretch, torque: TorqueProfile | ClosedLoop, setting: Setting
) -> EngineRun:
    """Replay a stretch in MuJoCo; an `Engine`.

    ImportError if MuJoCo is not installed.
    """
    import mujoco

    steps = list_steps(problem, stretch, torque, setting.step)
    drive = EngineDrive(problem.scene, torque, steps.h) if isinstance(torque, ClosedLoop) else None
    text = write_mjcf(problem, step=steps.h, softness=Softness().scale(setting.softness))
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    names = tuple(pair.name for pair in list_pairs(problem.scene))
    numbers = _number_pairs(model, problem)
    data.qpos[:], data.qvel[:] = _press(problem, stretch, model, data, numbers), steps.v
    states, press, start = [(stretch.z, stretch.z_dot)], [], 0
    # Warnings of states that are not finite would go to stderr and to a file; the deviation shows.
    mujoco.set_mju_user_warning(lambda _: None)
    for end in steps.ends:
        total = np.zeros(len(names))
        for step in range(start, end):
            tau = steps.tau[step]
            if drive is not None:
                tau = drive.step(step * steps.h, data.qpos[3:], data.qvel[3:])
            data.ctrl[:] = tau
            mujoco.mj_step(model, data)
            if data.ncon:
                contact = data.contact
                address = contact.efc_address
                held = address >= 0
                pair = numbers[contact.geom1[held], contact.geom2[held]]
                np.add.at(total, pair, data.efc_force[address[held]])
        press.append(total / (end - start))
        states.append((data.qpos.copy(), data.qvel.copy()))
        start = end
        if drive is not None and drive.over:
            break
    mujoco.set_mju_user_warning(None)
    z, z_dot = (np.array(part) for part in zip(*states, strict=True))
    t = stretch.start + steps.h * np.array([0, *steps.ends[: len(press)]])
    return EngineRun(t, z, z_dot, names, np.array(press))


def _number_pairs(model: Any, problem: Problem) -> NDArray[np.int64]:
    """Numbers of the pairs by the numbers of their shapes, in either order."""
    table = np.full((model.ngeom, model.ngeom), -1)
    for number, pair in enumerate(list_pairs(problem.scene)):
        first, second = (model.geom(name).id for name in (pair.first, pair.second))
        table[first, second] = table[second, first] = number
    return table


def _press(
    problem: Problem, stretch: EngineStretch, model: Any, data: Any, numbers: NDArray[np.int64]
) -> Array:
    """The planned start with penetrations that give the planned forces.

    MuJoCo computes stiffnesses from time constants and inertias; they are read at a small depth.
    """
    import mujoco

    nowhere = dict.fromkeys(stretch.c_n, np.inf)
    little = _LITTLE * problem.scene.scales.length
    touching = {name: max(force, 0.0) / little for name, force in stretch.c_n.items()}
    data.qpos[:] = press_in(problem, stretch, {**nowhere, **touching})
    mujoco.mj_forward(model, data)
    contact, found = data.contact, np.zeros(len(list_pairs(problem.scene)))
    held = contact.efc_address >= 0
    rows = contact.efc_address[held]
    stiffness_row = data.efc_KBIP[rows, 0] * data.efc_KBIP[rows, 2] / data.efc_R[rows]
    np.add.at(found, numbers[contact.geom1[held], contact.geom2[held]], stiffness_row)
    names, corners = [pair.name for pair in list_pairs(problem.scene)], problem.scene.polygon
    pairs = {name: find_pairs(name, corners.n_vertices) for name in stretch.c_n}
    stiffness = {k: sum(found[names.index(p)] for p in v) for k, v in pairs.items()}
    mujoco.mj_resetData(model, data)
    return press_in(problem, stretch, {k: v if v > 0 else np.inf for k, v in stiffness.items()})
