"""Layouts of the packed vectors that a compiled step reads and writes."""

from __future__ import annotations

from typing import Any, NamedTuple

STATE = 14
"""Length of the integrated vector: z, z', then work, viscous, dry and contact losses."""
MOVING = 10
"""Length of what the motion depends on: z, z'."""


class Inputs(NamedTuple):
    """Where each input of a step is in its packed vector.

    Attributes
    ----------
    y : slice
        State, shape (STATE,).
    t, h, tolerance : int
        Time and step [s]; largest error of z and z' over the step, in units of the scene.
    Xi, sigma : slice
        Directions of sliding and of the joints, zero for what is held.
    kept : slice
        Slip coordinates of rolling and stuck contacts [m], then angles of held joints [rad].
    heading : slice
        Velocity at the start of the step, scaled to one in the metric M5 (or the impending one).
    piece : slice
        Start and end of the torque's piece [s].
    torque : slice
        Its coefficients, joint by joint, as in `TorqueProfile`.
    size : int
    """

    y: slice
    t: int
    h: int
    tolerance: int
    Xi: slice
    sigma: slice
    kept: slice
    heading: slice
    piece: slice
    torque: slice
    size: int


class Outputs(NamedTuple):
    """Where each output of a step is in its packed vector; all but `error` hold at its end.

    Attributes
    ----------
    y : slice
        State, shape (STATE,).
    acceleration : slice
        z'', shape (5,).
    c_n, c_t : slice
        Forces [N].
    tau : slice
        Torques [N m].
    heading : slice
        The velocity scaled to one in the metric M5.
    ratio : int
        Reduced inertia over that without friction.
    error : int
        Estimated error over the tolerance; accept at 1 and below.
    worst : int
        Least of the event values plus their slacks: below zero something has happened.
    dip : int
        Least c_n and reserve of friction at the stages within the step, in units of the scene.
    glimpses : slice
        c_n at the stages of `GLIMPSES`, one after the other [N]; zero without a step.
    until_rate : int
        Time derivative of the distance to the phase's end.
    events : slice
        Values that are positive until something happens; see `EventRows`.
    size : int
    """

    y: slice
    acceleration: slice
    c_n: slice
    c_t: slice
    tau: slice
    heading: slice
    ratio: int
    error: int
    worst: int
    dip: int
    glimpses: slice
    until_rate: int
    events: slice
    size: int


class EventRows(NamedTuple):
    """Where each kind of event value is among `Outputs.events`.

    Attributes
    ----------
    force : slice
        c_n [N].
    cone : slice
        What friction still has to give where it holds (`Mode.holders`): mu c_n - c_t of contacts
        [N] and D - f of joints [N m], then the same with the other sign.
    slide, joint : slice
        Sliding velocities times Xi [m/s], joint speeds times sigma [rad/s].
    limit : slice
        The formation's limits [m]; that of the contact to be gained counts as `until` instead.
    until : int
        Distance to the end of the phase [m or rad]; one if that is a release.
    speed : int
        Speed along the heading, in the metric M5; one with more than one freedom, where contacts
        and joints come to rest one by one.
    size : int
    """

    force: slice
    cone: slice
    slide: slice
    joint: slice
    limit: slice
    until: int
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
