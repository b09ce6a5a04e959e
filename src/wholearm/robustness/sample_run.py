"""Replay of a plan in a perturbed scene by complementarity simulation, compared with the plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, SimulationError
from ..contacts.closing import close_fingers, describe_obstacle
from ..policy.playback import ROOM, ClosedLoop, Policy
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..simulation.events import EventKind, FreeSimulation, OutcomeKind, list_pauses
from ..simulation.simulate import simulate_free
from .error_model import Uncertainty, change_problem, change_torques

PAUSE = 1e-3
"""Time for which a planned contact may be open, in the scene's unit of time, and still be kept."""
CLOSING = 0.1
"""Time, likewise, in which a contact that is open when its phase begins has to close for good."""
SNAPSHOTS = 24  # poses of a motion that are kept for figures


class TimeWindow(NamedTuple):
    """A phase by the clock of a plan."""

    phase: int  # its number
    stop: float  # [s]
    contacts: tuple[str, ...]  # that it is planned with
    gained: str  # the contact that it ends with; empty where it ends otherwise
    start: float = 0.0  # [s]: of the first window


@dataclass(frozen=True, eq=False)
class Trial:
    """What is tried: a plan or one phase of it, with numbers that are off."""

    problem: Problem
    torque: TorqueProfile  # from time 0 on
    # (5,): configuration at the start, at rest. Where numbers are off the object is put on the palm
    # at the same x and phi, and the fingers are closed on it.
    state: Array
    windows: tuple[TimeWindow, ...]
    goal: Array  # (3,): the pose that is planned for the end
    uncertainty: Uncertainty
    # what the torques are by, instead of the clock; its period is that of the samples
    policy: Policy | None = None

    def run(self, sample: Array) -> dict[str, Any]:
        """What becomes of one sample, as plain values.

        Parameters
        ----------
        sample : (len(varied) + 1,)  a row of `Uncertainty.draw`

        Returns
        -------
        dict  `distance` [m] and `angle` [rad] from the goal; `reached` and `kept`; the first
              contact that was `lost`, the number of its `phase` and the `time` [s]; the `least` c_n
              [N] of planned contacts; `path`, poses at even times; `ended`, empty or why the
              simulation ended early or could not begin
        """
        names = [own.name for own in self.uncertainty.varied]
        changes = dict(zip(names, sample[:-1].tolist(), strict=True))
        return self.change(changes, self.uncertainty.sample_rate, float(sample[-1]))

    def change(
        self, changes: Mapping[str, float], rate: float | None = None, offset: float = 0.0
    ) -> dict[str, Any]:
        """The same for numbers that are off by `changes`, torques sampled and held at a rate."""
        what: TorqueProfile | ClosedLoop
        if self.policy is None:
            what = change_torques(self.torque, changes, rate, offset)
        else:
            gains = (1 + changes.get("gain1", 0.0), 1 + changes.get("gain2", 0.0))
            delay = changes.get("delay", self.policy.settings.delay)
            what = ClosedLoop(self.policy, self.windows[0].phase, delay, gains)
        try:
            simulation = self.simulate(changes, what, self.uncertainty.tolerance)
        except (InputError, SimulationError) as error:
            return {"ended": str(error), "reached": False, "kept": False, "lost": "start"}
        if isinstance(what, ClosedLoop):
            return self._take_windows(what, simulation).judge(simulation)
        return self.judge(simulation, changes.get("delay", 0.0))

    def _take_windows(self, loop: ClosedLoop, simulation: FreeSimulation) -> Trial:
        """The trial with phases as a policy has begun them, from when their torques take effect."""
        end = float(simulation.t[-1])
        began = {number: time + loop.delay for number, time in loop.began.items()}
        last = self.windows[-1].phase
        windows = []
        for window in self.windows:
            stop = end if window.phase == last else began.get(window.phase + 1, math.inf)
            windows.append(window._replace(start=began.get(window.phase, end), stop=stop))
        return replace(self, windows=tuple(windows))

    def simulate(
        self,
        changes: Mapping[str, float],
        torque: TorqueProfile | ClosedLoop,
        tolerance: float = 1e-9,
    ) -> FreeSimulation:
        """Replay torques in the scene whose numbers are off, free of assumptions.

        Raises
        ------
        InputError, SimulationError  if the changed scene has no start
        """
        problem = change_problem(self.problem, changes)
        x = self.state[:1] + changes.get("start_x", 0.0)
        closed = close_fingers(problem.scene, x, self.state[2:3])
        if text := describe_obstacle(closed):
            raise SimulationError(f"the hand cannot close at the start: {text}")
        until = None
        if isinstance(torque, ClosedLoop):
            until = (1 + ROOM) * torque.find_duration(self.windows[-1].phase)
        return simulate_free(problem, torque, start=closed.z[0], until=until, tolerance=tolerance)

    def judge(self, simulation: FreeSimulation, delay: float = 0.0) -> dict[str, Any]:
        """Compare a motion with the plan; as `run`."""
        off = simulation.z[-1, :3] - self.goal
        distance, angle = float(np.hypot(off[0], off[1])), float(abs(off[2]))
        given_up = simulation.outcome.kind is OutcomeKind.GIVEN_UP
        lost, phase, time, least = self._follow(simulation, delay)
        even = np.linspace(0.0, simulation.t[-1], SNAPSHOTS)
        path = np.column_stack([np.interp(even, simulation.t, column) for column in simulation.z.T])
        near = distance <= self.uncertainty.find_distance(self.problem.scene)
        near = near and angle <= self.uncertainty.angle
        ended = simulation.outcome.text if given_up else ""
        verdict = {"reached": near and not given_up, "kept": not lost and not given_up}
        loss = {"lost": lost, "phase": phase, "time": time, "least": least}
        ends = {"distance": distance, "angle": angle}
        return ends | verdict | loss | {"path": path.tolist(), "ended": ended}

    def _follow(
        self, simulation: FreeSimulation, delay: float
    ) -> tuple[str, int | None, float | None, float]:
        """The first planned contact that is lost, its phase and when, and the least c_n.

        A phase goes on from when the last one's contact was gained to when its own is, or to its
        end by the clock. Where a start is off, contacts are not closed yet, and are not lost so.
        """
        unit = self.problem.scene.scales.time
        began, losses, least = self.windows[0].start, list[tuple[float, int, str]](), math.inf
        for window in self.windows:
            gains = [
                stretch.start
                for stretch in simulation.stretches
                if stretch.contact == window.gained
            ]
            gain = min((time for time in gains if time > began), default=math.inf)
            # A phase ends when its contact is made, even if it bounces then.
            makes = [
                event.time
                for event in simulation.events
                if event.contact == window.gained and event.kind is EventKind.GAINED
            ]
            made = min((time for time in makes if time > began), default=gain)
            planned = window.stop + delay
            for name in window.contacts:
                time, force = _find_loss(simulation, name, began, min(planned, gain, made), unit)
                least = min(least, force)
                if time is not None:
                    losses.append((time, window.phase, name))
            began = max(planned, gain) if window.gained else planned
            if began > simulation.t[-1]:
                # What ends the whole motion may be a little short: that is for the goal to say.
                if window is not self.windows[-1]:
                    losses.append((planned, window.phase, window.gained))
                break
        if not losses:
            return "", None, None, least
        first, phase, name = min(losses)
        return name, phase, first, least


def _find_loss(
    simulation: FreeSimulation, name: str, start: float, stop: float, unit: float
) -> tuple[float | None, float]:
    """When a contact opens for longer than a pause, None if it does not; and its least c_n."""
    column = simulation.contacts.index(name)
    t, c_n = simulation.t, simulation.c_n[:, column]
    here = (t >= start) & (t < stop)
    known = c_n[here & (c_n == c_n)]
    least = float(known.min()) if len(known) else math.inf
    pauses = list_pauses(simulation.stretches, name, start, stop)
    if pauses and pauses[0][0] <= start:
        pauses = [pause for pause in pauses if pause[1] > start + CLOSING * unit]
    return next((first for first, after in pauses if after - first > PAUSE * unit), None), least


def make_trial(
    problem: Problem,
    plan: Trajectory,
    uncertainty: Uncertainty,
    phase: int | None = None,
    policy: Policy | None = None,
) -> Trial:
    """What is tried of a plan: all of it, or the phase of a number, by a policy if one is given.

    Raises
    ------
    InputError  if the plan has no phase of that number, or one that does not start at rest; or the
                policy has other phases
    """
    starts = plan.phase_starts
    count = len(starts) - 1
    if phase is not None and not 1 <= phase <= count:
        raise InputError("", "--phase", f"{phase} given; the plan has phases 1 to {count}")
    if policy is not None and policy.count != count:
        given = f"{policy.count} given; the plan has {count}"
        raise InputError("", "phases of the policy", given)
    first, last = (0, count - 1) if phase is None else (phase - 1, phase - 1)
    rows = np.flatnonzero((plan.phase >= first) & (plan.phase <= last))
    scales = problem.scene.scales
    units = np.array([scales.speed, scales.speed, *[scales.rate] * 3])
    if np.abs(plan.z_dot[rows[0]] / units).max() > 1e-6:
        given = f"{phase} given; it does not start at rest, so that it is no trial of its own"
        raise InputError("", "--phase", given)
    begin = float(starts[first])
    windows = tuple(
        TimeWindow(
            own.number,
            float(starts[own.index + 1]) - begin,
            tuple(own.formation.names),
            "" if own.until.contact is None else own.until.contact.name,
        )
        for own in problem.phases[first : last + 1]
    )
    torque = plan.torque.cut(begin, float(starts[last + 1]))
    torque = TorqueProfile(torque.breaks - begin, torque.coefficients)
    goal = plan.q[rows[-1]]
    if policy is not None:
        policy = policy.cut(last + 1)
    return Trial(problem, torque, plan.z[rows[0]], windows, goal, uncertainty, policy)
