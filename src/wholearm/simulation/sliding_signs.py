"""Contact mode after a sliding or joint velocity reaches zero: stick, reverse or continue.

A contact at rest may slide with a sign if it then accelerates with it, or stick if its c_t stays in
the cone; a joint likewise. Each combination is one linear system, and every contact has to press.
Forces are evaluated a short time later, which tells one that leaves its cone from one that returns.
The first combination that is consistent by more than rounding is taken, or else the one with the
largest margin. What has just come to rest tries to reverse, then to stick, then to continue; all
else tries its present mode, or to slip if its cone is just reached.

What cannot move because something else sticks has no independent constraint. Its friction is
indeterminate and has either sign: margins elsewhere are monotonic in it, so some sign is consistent
for as long as any friction is. It counts as stuck.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..common.errors import JammingError, SimulationError
from ..scene.model import Scene
from .events import describe_change
from .modes import Mode, Unit, evaluate_rows, find_fixed, find_grips, list_units, respond
from .tolerances import ROUNDING_FORCE, STANDING, is_slower

if TYPE_CHECKING:
    from .prescribed import Replay

CLEAR = 1e-8  # least margin of a clear decision, over the scene's units
TRIES = 50  # most decisions in a row without any time passing


class Choice(NamedTuple):
    """Combination of friction signs, with its margins."""

    signs: Array  # (n_c + 2,): directions of contacts and joints, zero for what is held or rolls
    fixed: NDArray[np.bool_]  # (n_c + 2,): held, or immobile because of what else is held
    margin: float  # least relative acceleration along the signs or friction margin
    pressing: float  # least c_n over the scene's force


def choose_mode(
    run: Replay, turned: Sequence[int] = (), *, time: float | None = None, enters: bool = False
) -> bool:
    """Choose the friction signs of all that stands still; whether the motion has ended.

    Parameters as of `simulate.restart`.
    """
    formation, signs = run.formation, run.signs
    run.look()
    slow = np.abs(run.values[run.leg.rows.turning]) < STANDING
    still = [
        unit
        for unit in list_units(formation)
        if set(unit.rows) & set(turned) or (unit.grips and slow[list(unit.rows)].any())
    ]
    if not still:
        return False
    if is_slower(run.problem.scene, run.v, STANDING):
        return True
    count = run.decided[1] + 1 if run.t <= run.decided[0] else 1
    run.decided = (run.t, count)
    if count > TRIES:
        names = " ".join(formation.names)
        raise SimulationError(f"sticking and slipping of {names} do not end {run.where()}")
    orders = [_list_options(run, unit, float(signs[unit.rows[0]]), turned) for unit in still]
    choice = _choose(run, signs, still, orders)
    _take(run, choice.signs, still)
    for unit in still:
        row = unit.rows[0]
        before = 0.0 if row in run.stuck else float(signs[row])
        after = float(choice.signs[row]) if not choice.fixed[row] else 0.0
        changes = before != after and not (enters and after) and unit.grips
        for row in unit.rows if changes else ():
            note_change(run, row, before, after, run.t if time is None else time)
        run.stuck = (run.stuck - set(unit.rows)) | set(() if after else unit.rows)
    return False


def measure_rates(scene: Scene, count: int) -> Array:
    """The scene's speed for `count` contacts, then that of joints, shape (count + 2,)."""
    scales = scene.scales
    return np.repeat([scales.speed, 1 / scales.time], [count, 2])


def note_change(run: Replay, row: int, before: float, after: float, time: float) -> None:
    """Record that a contact or joint sticks, slips or turns back."""
    names = run.formation.names
    contact = row < len(names)
    name = names[row] if contact else f"joint {row - len(names) + 1}"
    kind, text = describe_change(name, before, after, "slides" if contact else "turns")
    run.note(kind, f"{text} at t = {time:.5g} s, phase {run.phase.number}", name, time=time)


def _list_options(
    run: Replay, unit: Unit, present: float, turned: Sequence[int]
) -> tuple[float, ...]:
    """Directions to try for one unit, in the order in which the first clear one is taken."""
    if present != 0:
        first = -present if set(unit.rows) & set(turned) else present
        return (first, 0.0, -first) if unit.grips else (first, -first)
    holder = run.leg.mode.holders.index(unit.rows)
    low, high = run.values[run.leg.rows.cone].reshape(2, -1)[:, holder]
    sign = 1.0 if high < low else -1.0
    # Friction is at the edge of its cone and opposes the slip to come.
    edge = min(low, high) < ROUNDING_FORCE
    return (sign, -sign, 0.0) if edge else (0.0, sign, -sign)


def _choose(
    run: Replay, signs: Array, still: Sequence[Unit], orders: Sequence[tuple[float, ...]]
) -> Choice:
    """Signs of the first clear combination or of the best; `JammingError` if none is consistent."""
    formation, scales, ahead = run.formation, run.system.scales, run.settling
    loads = [np.array([1.0, *run.tau(t)]) for t in (run.t, run.t + ahead)]
    present, count, ratios = evaluate_rows(formation, run.z, run.v), formation.n_contacts, [1.0]

    def measure(signs: Array) -> Choice | None:
        """Margins of one combination; None if it jams or leaves its forces undetermined."""
        mode = Mode(formation, find_grips(formation, signs))
        if mode.n_constraints > 4:
            return None
        acceleration, rates = np.zeros(5), np.zeros(count + 2)
        for delay, load in zip((0.0, ahead), loads, strict=True):
            v = run.v + delay * acceleration
            z = run.z + delay * (run.v + v) / 2
            rows = evaluate_rows(formation, z, v) if delay else present
            response = respond(mode, signs, rows, v)
            if response is None or not response.ratio > 0:
                ratios.extend([] if response is None else [response.ratio])
                return None
            acceleration, rates = response.acceleration @ load, rates + response.rates @ load / 2
            held = response.force_limits @ load / mode.force_limit_units
        gained = signs * rates / (measure_rates(run.problem.scene, count) / scales.time)
        cones = held[count:].reshape(2, -1).min(axis=0)
        margins = [np.inf]
        for unit in still:
            row = unit.rows[0]
            if signs[row] == 0:
                margins.append(cones[mode.holders.index(unit.rows)])
            elif abs(gained[row]) > CLEAR:
                margins.append(gained[row])
        fixed = find_fixed(mode, present.A, present.A_t)
        return Choice(signs, fixed, float(min(margins)), float(held[:count].min()))

    choices: list[Choice] = []
    for options in product(*orders):
        tried = signs.copy()
        for unit, sign in zip(still, options, strict=True):
            tried[list(unit.rows)] = sign
        choice = measure(tried)
        if choice is None:
            continue
        if choice.margin > CLEAR and choice.pressing > -CLEAR:
            return choice
        choices.append(choice)
    pressing = [choice for choice in choices if choice.pressing > -CLEAR]
    best = max(pressing, key=lambda choice: choice.margin, default=None)
    if best is not None and best.margin > -CLEAR:
        return best
    # A contact is about to be lost, and its forces say which.
    pulling = [choice for choice in choices if choice.pressing <= -CLEAR]
    if pulling:
        return max(pulling, key=lambda choice: choice.margin)
    if min(ratios) <= 0:
        run.fail_to_step(min(ratios))
    names = " ".join(formation.names)
    raise JammingError(
        f"{names} jams {run.where()}: no combination of sliding and sticking is consistent"
    )


def _take(run: Replay, signs: Array, still: Sequence[Unit]) -> None:
    """Go on with the directions chosen; rounding of speeds against them is taken away."""
    formation, v = run.formation, run.v
    kinematics = formation.evaluate(run.z[None], v[None])
    gradients = np.vstack([kinematics.A_t[0], np.eye(5)[3:]])
    wrong = [
        unit.rows[0]
        for unit in still
        if signs[unit.rows[0]] == 0 or signs[unit.rows[0]] * (gradients[unit.rows[0]] @ v) < 0
    ]
    run.project_velocity(np.vstack([kinematics.P[0], gradients[wrong]]))
    grips = find_grips(formation, signs)
    if grips != run.leg.mode.grips:
        run.take(grips)
    run.signs = signs
    run.heading = run.v / np.sqrt(run.system.mass @ run.v**2)
