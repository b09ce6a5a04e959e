"""Forward simulation: joint torques in, motion, contact forces and events out.

Event-driven integration (DOP853). Contact modes follow from the formations of the problem
(`prescribed`), or from linear complementarity problems (`complementarity`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array, sort_unique
from ..common.errors import InputError, SimulationError, require_array, require_number
from ..common.fields import SHARE, Range, choice
from ..common.sharing import exclusive
from ..contacts.contact_limits import measure_gaps
from ..problem.definition import Problem
from ..problem.read import require_phases
from ..results.adopt import Torques, adopt_torques, require_same_contacts
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from .events import Energies, Outcome, Simulation, list_stretches
from .prescribed import Replay
from .run import Feedback, Law, Run
from .system import REST_SPEED, Modes, build_system

if TYPE_CHECKING:
    from .complementarity import FreeRun


@exclusive
def simulate(
    problem: Problem,
    what: Torques | Law,
    *,
    contacts: Literal["prescribed", "free"] = "prescribed",
    start: ArrayLike | None = None,
    until: float | None = None,
    restitution: float = 0.0,
    tolerance: float = 1e-9,
    times: ArrayLike | None = None,
    minima: bool = False,
    halt: Callable[[FreeRun], bool] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Simulation:
    """Simulate torques, or a feedback law, from the problem's start at rest.

    Parameters
    ----------
    contacts          prescribed: the contacts of the problem's phases, replayed open loop. Free:
                      contacts are computed, and a loss does not end the simulation; phases only
                      follow the clock of a plan.
    tolerance         largest error of each step in z and z', relative to their size or to the
                      scene's length, 1 rad, speed and angular speed (`Scene.scales`) if larger
    times : (n,) [s]  instants at which steps have to end. Instants outside the time range of
                      the torques are ignored.

    With free contacts:

    start : (5,) or (10,)  z, and z' if not at rest. Gaps smaller than the touching distance are
                           closed.
    until : [s]            the end, by default that of the torques; the last torques are held
                           after it. Required for a law.
    restitution            Poisson's coefficient, 0 for plastic impacts to 1
    halt                   called with the run at every event; True ends the simulation

    With prescribed contacts:

    minima    whether to record also minima of normal forces and friction margins within steps
    progress  receives a line at the start of each phase

    Returns
    -------
    Simulation  whatever happens to the object: a lost contact is an outcome, not an error

    Raises
    ------
    InputError       if a number is out of its range, a time is not finite, or an option belongs to
                     other contacts
    JammingError     if friction makes the reduced inertia vanish or turn negative
    SimulationError  if a formation does not close at its start, features overlap there, a law
                     gives no two numbers, or the step size underflows
    """
    contacts = choice("prescribed", "free").read(contacts, "contacts")
    tolerance = Range(1e-14, 1e-2).read(tolerance, "tolerance")
    instants = require_array(np.atleast_1d([] if times is None else times), "times", -1)
    if not np.isfinite(instants).all():
        raise InputError("", "times", "holds numbers that are not finite")
    instants = sort_unique(instants)
    if contacts == "prescribed":
        if isinstance(what, Law) or start is not None or until is not None or restitution:
            text = "a law, start, until and restitution need contacts that are free"
            raise InputError("", "contacts", text)
        problem, profile, plan = adopt_torques(problem, what)
        require_phases(problem)
        require_same_contacts(problem, plan)
        run = Replay(problem, profile, tolerance, instants, minima)
        return _conclude(run, problem, *run.play(progress))
    state = require_array(problem.start if start is None else start, "start", -1)
    if state.size not in (5, 10) or not np.isfinite(state).all():
        text = f"shape {state.shape} given; 5 or 10 finite numbers are needed"
        raise InputError("", "start", text)
    state = np.concatenate([state, np.zeros(10 - len(state))])
    restitution = SHARE.read(restitution, "restitution")
    end = None if until is None else require_number(until, "until", positive=True)
    options: dict[str, Any] = {"tolerance": tolerance, "restitution": restitution}
    options |= {"times": instants, "halt": halt}
    if isinstance(what, Law):
        if end is None:
            raise InputError("", "until", "none given; a law of torques needs an end")
        return _simulate(problem, Feedback(what, end), state, [0.0], **options)
    problem, profile, plan = adopt_torques(problem, what)
    profile = profile if end is None else profile.cut(0.0, end)
    starts = [0.0] if plan is None else plan.phase_starts[:-1].tolist()
    hint = None if plan is None or start is not None else _read_modes(problem, plan, 0)
    return _simulate(problem, profile, state, starts, hint, **options)


def simulate_free(problem: Problem, what: Torques | Law, **options: Any) -> Simulation:
    """`simulate` with free contacts."""
    return simulate(problem, what, contacts="free", **options)


def simulate_phases(
    problem: Problem,
    plan: Trajectory,
    progress: Callable[[str], None] | None = None,
    **options: float,
) -> Iterator[tuple[range, Simulation]]:
    """Indices and simulations of a plan's phases, each from its planned start, with free contacts.

    Consecutive phases without rest in between, by the plan's velocities, are simulated together.
    `options` are restitution and tolerance, as of `simulate`.
    """
    starts, system = plan.phase_starts, build_system(problem.scene)
    rows = [int(row) for row in np.flatnonzero(np.diff(plan.phase, prepend=-1))]
    rests = [k for k in range(1, len(rows)) if system.is_slower(plan.z_dot[rows[k]], REST_SPEED)]
    for first, stop in pairwise([0, *rests, len(rows)]):
        if progress is not None:
            progress(f"simulating phase {problem.phases[first].number} of {len(rows)}")
        profile = plan.torque.cut(float(starts[first]), float(starts[stop]))
        row, clock = rows[first], starts[first:stop].tolist()
        state, hint = np.append(plan.z[row], plan.z_dot[row]), _read_modes(problem, plan, row)
        yield range(first, stop), _simulate(problem, profile, state, clock, hint, None, **options)


def _simulate(
    problem: Problem,
    profile: TorqueProfile | Feedback,
    state: Array,
    starts: Sequence[float],
    hint: Modes | None = None,
    halt: Callable[[FreeRun], bool] | None = None,
    **options: Any,
) -> Simulation:
    z, v = np.split(state, 2)
    system, touching = build_system(problem.scene), problem.scene.touching
    depths = -measure_gaps(problem.scene, z[None])[0]
    worst = int(depths.argmax())
    if depths[worst] > 10 * touching:
        pairs = "palm and object", "finger 1 and object", "finger 2 and object", "both fingers"
        raise SimulationError(f"{pairs[worst]} overlap by {depths[worst]:.3g} m at the start")
    from .complementarity import FreeRun

    run = FreeRun(system, profile, z, v, hint=hint, **options)
    return _conclude(run, problem, run.play(touching, halt), clock=np.asarray(starts))


def _conclude(
    run: Run,
    problem: Problem,
    outcome: Outcome,
    missed_by: float = math.nan,
    clock: Array | None = None,
) -> Simulation:
    """The result of a run; `clock`: starts of phases by time alone [s]."""
    system, records = run.system, run.records
    names, n = system.names, system.n
    contacts = [contact.name for contact in problem.contacts]
    events = sorted(run.events, key=lambda event: event.time)
    numbers = [(row.t, row.phase, row.y, row.acceleration, row.tau, row.impact) for row in records]
    t, phase, y, z_ddot, tau, impact = map(np.array, zip(*numbers, strict=True))
    if clock is not None:
        pressing = dict.fromkeys(names[pair] for row in records for pair in row.kept)
        # Contacts without a name in problem files occur in the stretches only.
        unnamed = re.compile("tip|joint|.*-(back|joint)")
        contacts += [n for n in pressing if n not in contacts and not unnamed.match(n)]
    forces = np.full((2, len(records), len(names)), np.nan)
    for index, row in enumerate(records):
        forces[:, index, list(row.kept)] = row.c_n, row.c_t
    c_n, c_t = forces[:, :, [names.index(name) for name in contacts]]
    z, z_dot = y[:, :n], y[:, n : 2 * n]
    work, viscous, dry, contact = y[:, 2 * n :].T
    simulation = Simulation(
        t=t,
        z=z,
        z_dot=z_dot,
        z_ddot=z_ddot,
        tau=tau,
        phase=phase,
        contacts=tuple(contacts),
        c_n=c_n,
        c_t=c_t,
        energies=Energies(system.compute_energy(z, z_dot), work, viscous, dry, contact, impact),
        problem=problem,
        torque=run.torque,
        events=tuple(events),
        outcome=outcome,
        missed_by=missed_by,
        steps=run.steps,
        rejected=run.rejected,
        stretches=list_stretches(records, names),
        residual=run.residual,
    )
    return simulation if clock is None else simulation.count_phases(clock)


def _read_modes(problem: Problem, plan: Trajectory, row: int) -> Modes:
    """Initial contact modes of a plan, to select one of several solutions."""
    system = build_system(problem.scene)
    names = [name for name, c in zip(plan.contacts, plan.c_n[row], strict=True) if c == c]
    if unknown := {*names} - {*system.names}:
        text = f"{', '.join(sorted(unknown))} of the plan are not of this scene"
        raise InputError("", "contacts", text)
    kept = sorted(system.names.index(name) for name in names)
    z, v, a = plan.z[row], plan.z_dot[row], plan.z_ddot[row]
    rows = system.evaluate(z, v, kept)
    dt = 1e-3 * system.scales.time
    sliding_signs = np.sign(rows.A_t @ v + dt * (rows.A_t @ a + rows.A_t_dot_v))
    phase = problem.phases[int(plan.phase[row])]
    is_rolling = [system.names[pair] in {c.name for c in phase.formation.rolling} for pair in kept]
    Xi = np.where(is_rolling, 0.0, sliding_signs)
    joint_signs = np.sign(v + dt * a) * (system.dry > 0)
    return Modes(tuple(kept), (), tuple(Xi.tolist()), tuple(joint_signs.tolist()))
