"""Torques at a junction at rest between two phases, under torque rate limits and lag.

A motion starts and ends with torques at the limit of static equilibrium: without acceleration, with
the friction of its directions. There the internal force is free, so these torques are a line for
each of the two phases. The pair that is the nearest in time is taken, and torques change linearly
between them while everything rests. The former also have to hold the object in the next formation;
then so do all in between, as balanced forces within their cones are a convex set. A plan in the
time domain begins and ends with the torques of its motion; a pause changes the torques before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError
from ...contacts.formation import Formation
from ...geometry.curve import Curve
from ...geometry.tracing import trace_phase
from ...mechanics.dynamics import LAMBDA, ONE
from ...mechanics.statics import Statics
from ...problem.definition import Phase
from ...results.dwell_record import TorqueChange, change_torques, find_change_times
from ...results.plan_record import ModeSpan
from ...results.torque import TorqueProfile
from ...results.trajectory import Motion, Samples
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan, Plans, runs_along_curves, split_blocks
from .first_guess import find_internal_force_range
from .path_data import PhaseData, prepare
from .path_mesh import make_grid

if TYPE_CHECKING:
    from ..blocks import Planning

_INSIDE = 0.01  # part of the range left out at both ends


class Joint(NamedTuple):
    """Internal forces [N] and torques, (2,) [N m], of both sides, and the pause between [s].

    Internal forces are NaN for phases planned in the time domain.
    """

    ends: float
    begins: float
    before: Array
    after: Array
    pause: float


def choose_joint(
    ending: Curve | Array, beginning: Curve | Formation, z: Array, epsilon: float, phase: int
) -> Joint:
    """The torques that change in the least time where phase number `phase` begins.

    Parameters
    ----------
    ending : (2,) [N m]  curve that ends, or final torques of a phase planned in the time domain
    beginning            curve that begins, or its formation in the time domain: then the final
                         torques before are those that friction holds with the largest margin

    Notes
    -----
    Where none of the torques hold the object in the formation that begins, contacts that it does
    not have any more help to hold it until the motion begins.

    Raises
    ------
    InfeasibleError  if no torques hold the object at one of the two ends
    """
    if isinstance(ending, Curve):
        before, ends = _list_torques(ending, epsilon, phase - 1, -1)
    else:
        before, ends = ending[None], np.full(1, np.nan)
    formation = beginning.formation if isinstance(beginning, Curve) else beginning
    scene, static = formation.scene, Statics(formation, z).torque_polygon()
    beyond = static.measure(before)
    held = beyond <= 1e-6 * scene.scales.torque  # rounding
    if not held.any():
        held = beyond <= beyond.min()
    if not isinstance(beginning, Curve):
        firmest = int(beyond.argmin())
        tau = before[firmest]
        return Joint(float(ends[firmest]), np.nan, tau, tau, 0.0)
    after, begins = _list_torques(beginning, epsilon, phase, 0)
    times = find_change_times(scene, before[held][:, None], after[None])
    p, q = np.unravel_index(int(times.argmin()), times.shape)
    forces = float(ends[held][p]), float(begins[q])
    return Joint(*forces, before[held][p], after[q], float(times[p, q]))


def _list_torques(curve: Curve, epsilon: float, phase: int, place: int) -> tuple[Array, Array]:
    """Torques at an end of a curve at the limit of rest, (n, 2) [N m], and internal forces [N]."""
    data = prepare(curve, epsilon, make_grid(curve, np.zeros(0), 3, held=True), phase)  # ends count
    low, high = require_hold(data, phase, place)
    high = min(high, low + 40.0 * curve.formation.scene.scales.force)  # the widest range
    share = np.linspace(_INSIDE, 1 - _INSIDE, 129)  # internal forces to try
    lams = low + share * (high - low)
    forces = data.nodes.forces
    T0, by_lambda = forces.of_tau[place, :, ONE], forces.of_tau[place, :, LAMBDA]
    return T0 + np.outer(lams, by_lambda), lams


def require_hold(data: PhaseData, phase: int, place: int) -> tuple[float, float]:
    """The range of internal forces that hold the object at an end of a phase [N].

    Raises
    ------
    InfeasibleError  if there is none
    """
    low, high = (float(bound[place]) for bound in find_internal_force_range(data, 0.0))
    if low <= high:
        return low, high
    where = "end" if place else "start"
    raise InfeasibleError(
        f"phase {phase}: torques may not step, and within the limits none hold the object at rest "
        f"at its {where}, on the verge of the motion; leave out torque_rate_limit and actuator_lag"
    )


@dataclass(frozen=True, eq=False)
class PausedMotion:
    """A motion that begins after a pause at rest, in which torques and forces change."""

    motion: Motion
    change: TorqueChange
    forces: Array  # (2, n_c) [N]: c_n and c_t before it; NaN if other contacts may share in them

    @property
    def pause(self) -> float:
        """How long the pause lasts [s]."""
        return self.change.duration

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""
        return self.pause + self.motion.duration

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.motion.contacts

    @property
    def modes(self) -> tuple[ModeSpan, ...]:
        """Its contact modes, if planned in the time domain: the first start with the pause."""
        return tuple(
            span._replace(start=span.start + self.pause if k else 0.0, stop=span.stop + self.pause)
            for k, span in enumerate(getattr(self.motion, "modes", ()))
        )

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        t = np.asarray(t, dtype=float)
        samples = self.motion.evaluate(np.maximum(t - self.pause, 0.0))
        left = np.where(t < self.pause, 1 - self.change.share(t), 0.0)[:, None]
        mixed = (
            np.where(left > 0, left * first + (1 - left) * now, now)
            for first, now in zip((self.change.before, *self.forces), samples[3:], strict=True)
        )
        return Samples(*samples[:3], *mixed)


def add_pause(
    plan: PhasePlan[Motion], joint: Joint, formation: Formation, z: Array, options: PlanOptions
) -> PhasePlan[Motion]:
    """The plan of a phase that begins at `z`, with the pause before it."""
    if not joint.pause:
        return plan
    forces = Statics(formation, z).find_firmest_forces(joint.before)
    change = change_torques(formation.scene, joint.before, joint.after)
    effort = change.torque.integrate_squares() + options.time_weight * joint.pause
    value = {
        Objective.TIME: plan.value + joint.pause,
        Objective.EFFORT: plan.value + effort,
        Objective.MARGIN: float(np.fmin(plan.value, forces[0].min())),
    }[options.goal]
    return _pause(plan, change, forces)._replace(value=value)


def _pause(plan: PhasePlan[Motion], change: TorqueChange, forces: Array) -> PhasePlan[Motion]:
    motion = PausedMotion(plan.motion, change, forces)
    torque = TorqueProfile.chain([change.torque, plan.torque])
    return plan._replace(motion=motion, torque=torque)


def begin_from(plan: PhasePlan[Motion], formation: Formation, before: Array) -> PhasePlan[Motion]:
    """The plan of a phase with other torques before it, shape (2,) [N m], and the pause from them.

    Its value stays as it is.
    """
    if isinstance(motion := plan.motion, PausedMotion):
        torque = plan.torque.cut(motion.pause, float(plan.torque.breaks[-1]))
        plan = plan._replace(motion=motion.motion, torque=TorqueProfile.chain([torque]))
    change = change_torques(formation.scene, before, plan.torque.at(np.zeros(1))[0])
    # Other contacts than the phase's may help to hold the object until it moves.
    forces = np.full((2, formation.n_contacts), np.nan)
    return _pause(plan, change, forces) if change.duration else plan


def find_beside(
    planning: Planning, block: Sequence[Phase], end: Array, options: PlanOptions
) -> tuple[Curve | Array | None, Curve | Formation | None]:
    """Neighbours of a block along curves that ends at `end`, for `plan_slowly`."""
    index, later = block[-1].index + 1, planning.problem.phases[block[-1].index + 1 :]
    before: Curve | Array | None = _find_torque_before(planning, block)
    own = planning.find_before(block)
    if own is not None and own.chain is not None:
        before = own.chain.curves[-1]
    if not later:
        return before, None
    following = next(own for own in split_blocks(planning.problem) if own[0] is later[0])
    if not runs_along_curves(following, options):
        return before, later[0].formation
    known = planning.curves[index] if index < len(planning.curves) else None
    return before, known or trace_phase(later[0], end, later[1:])


def plan_with_pauses(
    planning: Planning,
    block: Sequence[Phase],
    plan: Callable[[float | None], Plans],
    duration: float | None,
) -> Plans:
    """Plans of a block in the time domain by `plan` for a longest duration [s], with pauses."""
    plans = plan(duration)
    junctions = _list_junctions(planning, block, plans)
    pause = sum(junction.pause for junction in junctions if junction)
    if duration is not None and pause:
        plans = plan(duration - pause)
        junctions = _list_junctions(planning, block, plans)
    paused: Plans = []
    for own, junction, phase in zip(plans, junctions, block, strict=True):
        if junction is not None:
            z = own.motion.evaluate(np.zeros(1)).z[0]
            own = add_pause(own, junction, phase.formation, z, planning.options)
        paused.append(own)
    return paused


def _list_junctions(planning: Planning, block: Sequence[Phase], plans: Plans) -> list[Joint | None]:
    """Starts of the phases at which torques change."""
    ends = [_find_torque_before(planning, block), *map(_find_last, plans[:-1])]
    junctions = list[Joint | None]()
    for end, own, phase in zip(ends, plans, block, strict=True):
        first, scene = own.torque.at(np.zeros(1))[0], planning.problem.scene
        pause = 0.0 if end is None else float(find_change_times(scene, end, first))
        if end is None or not pause:
            junctions.append(None)
            continue
        z = own.motion.evaluate(np.zeros(1)).z[0]
        junction = choose_joint(end, phase.formation, z, planning.problem.epsilon, phase.number)
        junctions.append(junction._replace(after=first, pause=pause))
    return junctions


def _find_torque_before(planning: Planning, block: Sequence[Phase]) -> Array | None:
    """The last torques of the block before, shape (2,) [N m], if that is planned."""
    before = planning.find_before(block)
    return None if before is None else _find_last(before.plans[-1])


def _find_last(plan: PhasePlan[Motion]) -> Array:
    return np.asarray(plan.torque.at(plan.torque.breaks[-1:])[0])
