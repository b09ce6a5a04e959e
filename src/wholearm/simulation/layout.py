"""Packed vectors of compiled steps: layouts, buffers, and torques of a polynomial piece."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array, Expression
from ..results.torque import TorqueProfile

STATE = 14  # length of the integrated vector: z, z', then work, viscous, dry and contact losses
MOVING = 10  # length of what the motion depends on: z, z'


class Inputs(NamedTuple):
    """Where each input of a step is in its packed vector."""

    y: slice  # state, shape (STATE,)
    # t, h, tolerance: time and step [s]; largest error of z and z' over the step, in units of the
    # scene
    t: int
    h: int
    tolerance: int
    Xi: slice  # Xi, sigma: directions of sliding and of the joints, zero for what is held
    sigma: slice
    # slip coordinates of rolling and stuck contacts [m], then angles of held joints [rad]
    kept: slice
    # velocity at the start of the step, scaled to one in the metric M5 (or the impending one)
    heading: slice
    piece: slice  # start and end of the torque's piece [s]
    torque: slice  # its coefficients, joint by joint, as in `TorqueProfile`
    size: int


class Outputs(NamedTuple):
    """Where each output of a step is in its packed vector; all but `error` hold at its end."""

    y: slice  # state, shape (STATE,)
    acceleration: slice  # z'', shape (5,)
    c_n: slice  # c_n, c_t: forces [N]
    c_t: slice
    tau: slice  # torques [N m]
    heading: slice  # the velocity scaled to one in the metric M5
    ratio: int  # reduced inertia over that without friction
    error: int  # estimated error over the tolerance; accept at 1 and below
    worst: int  # least of the event values plus their slacks: below zero something has happened
    # least c_n and reserve of friction at the stages within the step, in units of the scene
    dip: int
    stage_forces: (
        slice  # c_n at the stages of `INNER_STAGES`, one after the other [N]; zero without a step
    )
    until_rate: int  # time derivative of the distance to the phase's end
    events: slice  # values that are positive until something happens; see `EventRows`
    size: int


class EventRows(NamedTuple):
    """Where each kind of event value is among `Outputs.events`."""

    force: slice  # c_n [N]
    # what friction still has to give where it holds (`Mode.holders`): mu c_n - c_t of contacts [N]
    # and D - f of joints [N m], then the same with the other sign
    cone: slice
    # slide, joint: sliding velocities times Xi [m/s], joint speeds times sigma [rad/s]
    slide: slice
    joint: slice
    # the formation's limits [m]; that of the contact to be gained counts as `until` instead
    limit: slice
    until: int  # distance to the end of the phase [m or rad]; one if that is a release
    # speed along the heading, in the metric M5; one with more than one freedom, where contacts and
    # joints come to rest one by one
    speed: int
    size: int


def lay_out(*sizes: int | None) -> tuple[Any, ...]:
    """Consecutive slices of the given sizes, an index where None is given, and the total."""
    places: list[Any] = []
    stop = 0
    for size in sizes:
        places.append(stop if size is None else slice(stop, stop + size))
        stop += 1 if size is None else size
    return (*places, stop)


def bind(n_inputs: int, n_outputs: int, functions: Sequence[Expression]) -> tuple[Any, ...]:
    """Packed inputs and outputs, a call of each function on them, and the buffers to keep alive."""
    inputs, outputs = np.zeros(n_inputs), np.zeros(n_outputs)
    buffers = [function.buffer() for function in functions]
    for buffer, _ in buffers:
        buffer.set_arg(0, inputs.data)
        buffer.set_res(0, outputs.data)
    return inputs, outputs, *(call for _, call in buffers), buffers


def build_torque(time: Expression, piece: Expression, coefficients: Expression) -> Expression:
    """Torques on a polynomial piece with ends `piece` [s], shape (2,) [N m], by Horner's rule."""
    start, stop = piece[0], piece[1]
    x = (2 * time - start - stop) / (stop - start)
    coefficients = ca.reshape(coefficients, -1, 2)
    value = coefficients[-1, :]
    for power in range(coefficients.shape[0] - 2, -1, -1):
        value = value * x + coefficients[power, :]
    return value.T


def find_torque_steps(before: Array, after: Array, least: float) -> NDArray[np.bool_]:
    """Whether torques step by more than `least` from pieces to pieces, (n, 2, d + 1) each, (n,)."""
    jump = after @ (-1.0) ** np.arange(after.shape[2]) - before.sum(axis=2)
    return np.asarray(np.abs(jump).max(axis=1) > least)


def evaluate_piece(torque: TorqueProfile, piece: int, t: float) -> Array:
    """Torques of a piece at time `t`, also beyond its ends, shape (2,) [N m]."""
    start, stop = torque.breaks[piece : piece + 2].tolist()
    x = (2 * t - start - stop) / (stop - start)
    return np.asarray(torque.coefficients[piece] @ x ** np.arange(torque.coefficients.shape[2]))
