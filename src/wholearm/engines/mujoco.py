"""Replays in MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from .mjcf import Softness, write_mjcf
from .shapes import list_pairs
from .stretch import Run, Setting, Stretch, list_steps


def play(problem: Problem, stretch: Stretch, torque: TorqueProfile, setting: Setting) -> Run:
    """Replay a stretch in MuJoCo; an `Engine`.

    Raises
    ------
    ImportError
        If MuJoCo is not installed.
    """
    import mujoco

    steps = list_steps(problem, stretch, torque, setting.step)
    text = write_mjcf(problem, step=steps.h, softness=Softness().scale(setting.softness))
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = stretch.z, steps.v
    names = tuple(pair.name for pair in list_pairs(problem.scene))
    numbers = _number_pairs(model, problem)
    states, press, start = [(stretch.z, stretch.z_dot)], [], 0
    for end in steps.ends:
        total = np.zeros(len(names))
        for step in range(start, end):
            data.ctrl[:] = steps.tau[step]
            mujoco.mj_step(model, data)
            if data.ncon:
                contact = data.contact
                own = contact.efc_address
                held = own >= 0
                pair = numbers[contact.geom1[held], contact.geom2[held]]
                np.add.at(total, pair, data.efc_force[own[held]])
        press.append(total / (end - start))
        states.append((data.qpos.copy(), data.qvel.copy()))
        start = end
    z, z_dot = (np.array(part) for part in zip(*states, strict=True))
    t = stretch.start + steps.h * np.array([0, *steps.ends])
    return Run(t, z, z_dot, names, np.array(press))


def _number_pairs(model: Any, problem: Problem) -> NDArray[np.int64]:
    """Numbers of the pairs by the numbers of their shapes, in either order."""
    table = np.full((model.ngeom, model.ngeom), -1)
    for number, pair in enumerate(list_pairs(problem.scene)):
        first, second = (model.geom(name).id for name in (pair.first, pair.second))
        table[first, second] = table[second, first] = number
    return table
