"""Integrating a motion up to its next event."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..results.sampled import interpolate_quintic
from ..simulation.locate import find_root
from ..simulation.runge_kutta import ORDER
from .state import AHEAD, ARMED, CLOSED, Run
from .stepper import Stepper

GROWTH = 10.0
"""Largest growth of a step."""
SHORTEST = 1e-13
"""Step below which the integration gives up, relative to the scene's time and the time gone by."""
LOOKS = 8
"""Instants of a step at which gaps are looked at, its end among them."""
REACH = 0.3
"""Farthest that a step may go, in units of the scene: gaps are seen every `REACH` / `LOOKS`."""
ROUNDING = 1e-9
"""Shortfall of a force that counts as rounding, in the scene's unit."""
SPEED_ROUNDING = 1e-12
"""Likewise of a sliding or turning speed."""


class StuckError(ArithmeticError):
    """Steps become too short to get anywhere."""


def move(run: Run) -> None:
    """Integrate until something happens or the piece of the torques ends."""
    s = run.load()
    run.stay(s)
    s.look()
    run.record(s)
    floor = _make_floor(run, s)
    run.h = min(run.h, _time_to_return(run, s))
    while True:
        before = s.outputs.copy()
        h, whole = _try_step(run, s)
        found = _stop_at_event(run, s, before, floor, h)
        run.t = run.t + float(s.inputs[s.at.h]) if found or not whole else run.stop
        run.y = s.outputs[s.to.y].copy()
        run.steps += 1
        run.record(s)
        gaps, _ = run.system.measure(run.z[None])
        run.armed = gaps[0] > ARMED * run.system.scales.length
        if found or (run.t >= run.stop and (run.torque_steps() or not run.next_piece())):
            return
        floor = np.where(measure_values(run, s) > 0, _slacks(run), floor)
        run.feed(s)


def _try_step(run: Run, s: Stepper) -> tuple[float, bool]:
    """Make a step within the tolerance; its length, and whether it ends the piece of torques."""
    inputs, outputs, at, to = s.inputs, s.outputs, s.at, s.to
    remaining = run.stop - run.t
    system = run.system
    speed = float(np.abs(run.v / system.units[: system.n]).max())
    push = float(np.abs(outputs[to.acceleration] / system.units[: system.n]).max())
    reach = 2 * REACH / (speed + np.sqrt(speed**2 + 2 * push * REACH) + 1e-300)
    least = SHORTEST * max(system.scales.time, abs(run.t))
    while True:
        h = min(run.h, reach)
        whole = h >= 0.999 * remaining
        h = remaining if whole else min(h, remaining / 2)
        inputs[at.h] = h
        s.step()
        error = float(outputs[to.error])
        sudden = outputs[to.dip] < -1e-6 and h > AHEAD * system.scales.time
        if error <= 1 and sudden and (measure_values(run, s) >= -_slacks(run)).all():
            run.h, run.rejected = h / 2, run.rejected + 1
            continue
        if error <= 1:
            grown = h * min(GROWTH, 0.9 * max(error, 1e-300) ** (-1 / ORDER))
            run.h = grown if h >= run.h else max(run.h, grown)
            return h, whole
        run.rejected += 1
        if not error > 1 or h < least:
            raise StuckError(f"steps at t = {run.t:.6g} s become too short")
        run.h = h * max(0.1, 0.9 * error ** (-1 / ORDER))


def measure_values(run: Run, s: Stepper) -> Array:
    """Forces, reserves of friction, speeds and ranges at the end of the step just made.

    Each is positive until something happens, in units of the scene.
    """
    system, modes, out, to = run.system, run.modes, s.outputs, s.to
    scales, n = system.scales, system.n
    c_n, f = out[to.c_n], out[to.f]
    stuck = [modes.kept.index(pair) for pair in modes.stuck]
    held = list(modes.held)
    bound = np.concatenate([system.friction[list(modes.stuck)] * c_n[stuck], system.dry[held]])
    turns = [system.turns[i] for i in held]
    unit = np.concatenate([np.full(len(stuck), scales.force),
                           np.where(turns, scales.torque, scales.force)])  # fmt: skip
    slides = np.flatnonzero(modes.Xi)
    turning = np.flatnonzero(modes.sigma)
    v = out[to.y][n : 2 * n]
    _, ranges = system.measure(out[to.y][None, :n])
    return np.concatenate([
        c_n / scales.force,
        (bound - f) / unit,
        (bound + f) / unit,
        np.array(modes.Xi)[slides] * out[to.v_t][slides] / scales.speed,
        np.array(modes.sigma)[turning] * v[turning] / system.units[n + turning],
        ranges[0, list(modes.kept)] / scales.length,
    ])  # fmt: skip


def _slacks(run: Run) -> Array:
    """How far below zero each of the values counts as rounding."""
    modes = run.modes
    k, s = len(modes.kept), len(modes.stuck) + len(modes.held)
    fast = int(np.count_nonzero(modes.Xi)) + int(np.count_nonzero(modes.sigma))
    return np.repeat([ROUNDING, SPEED_ROUNDING, CLOSED], [k + 2 * s, fast, k])


def _make_floor(run: Run, s: Stepper) -> Array:
    """Values that start below zero may stay there: modes are judged a moment later."""
    slack = _slacks(run)
    return np.maximum(slack, slack - measure_values(run, s))


def _time_to_return(run: Run, s: Stepper) -> float:
    """Half the time in which the nearest pair that has just parted would close again [s]."""
    system = run.system
    gaps, _ = system.measure(run.z[None])
    touching = np.flatnonzero(~run.armed & (np.abs(gaps[0]) < CLOSED * system.scales.length))
    near = [pair for pair in touching.tolist() if pair not in run.modes.kept]
    if not near:
        return float("inf")
    rows = system.evaluate(run.z, run.v, near)
    rate = rows.A @ run.v
    bend = rows.A @ s.outputs[s.to.acceleration] + rows.bend
    back = (rate > 0) & (bend < 0)
    return float((-rate[back] / bend[back]).min(initial=np.inf))


def _stop_at_event(run: Run, s: Stepper, before: Array, floor: Array, h: float) -> bool:
    """Shorten the step just made to the first event within it; whether there is one."""
    passed: set[int] = set()
    found = False
    near = 1e-3 * SHORTEST * max(run.system.scales.time, abs(run.t))
    while True:
        values = measure_values(run, s) + floor
        closing = _find_closing(run, s, before, h, passed)
        low = np.flatnonzero(values < 0)
        if not len(low) and closing is None:
            return found
        start = _values_at(run, s, before) + floor
        shares = np.maximum(start[low], 0) / (np.maximum(start[low], 0) - values[low])
        if closing is not None and (not len(low) or closing[1] <= h * shares.min()):
            pair, left, right = closing

            level = 0.0 if run.armed[pair] else -0.5 * CLOSED * run.system.scales.length

            def gap(step: float, pair: int = pair, level: float = level) -> float:
                _step_to(s, step)
                return _gap_at(run, s.outputs, pair) - level

            high, first = gap(right), gap(left) if left > 0 else _gap_at(run, before, pair) - level
            flat = 1e-17 * run.system.scales.length
            root = find_root(gap, right, first, high, near, flat, low=left)
            _step_to(s, root)
            ranges = run.system.measure(s.outputs[s.to.y][None, : run.system.n])[1]
            passed.add(pair)
            if ranges[0, pair] < -CLOSED * run.system.scales.length:
                _step_to(s, h)
            else:
                h, found = root, True
            continue
        row = int(low[np.argmin(shares)])

        shift = float(floor[row])

        def value(step: float, row: int = row, shift: float = shift) -> float:
            _step_to(s, step)
            return float(measure_values(run, s)[row] + shift)

        h = find_root(value, h, float(start[row]), float(values[row]), near, 1e-3 * shift)
        _step_to(s, h)
        floor = np.where(np.arange(len(floor)) == row, np.inf, floor)
        found = True


def _values_at(run: Run, s: Stepper, outputs: Array) -> Array:
    """Values of an earlier end of a step."""
    now = s.outputs.copy()
    s.outputs[:] = outputs
    values = measure_values(run, s)
    s.outputs[:] = now
    return values


def _gap_at(run: Run, outputs: Array, pair: int) -> float:
    n = run.system.n
    return float(run.system.measure(outputs[None, :n])[0][0, pair])


def _step_to(s: Stepper, h: float) -> None:
    s.inputs[s.at.h] = h
    s.step()


def _find_closing(
    run: Run, s: Stepper, before: Array, h: float, passed: set[int]
) -> tuple[int, float, float] | None:
    """The first pair that closes within the step, and a bracket of when."""
    system, to, n = run.system, s.to, run.system.n
    scales = system.scales
    runs = h * np.arange(LOOKS + 1) / LOOKS
    ends = np.array([before, s.outputs])
    knots = ends[:, :n], ends[:, n : 2 * n], ends[:, to.acceleration]
    z = interpolate_quintic(np.full(LOOKS + 1, h), runs, knots, np.zeros(LOOKS + 1, dtype=int))[0]
    z[0], z[-1] = before[:n], s.outputs[:n]
    gaps, ranges = (part.T for part in system.measure(z))
    level = np.where(run.armed, 0.0, -0.5 * CLOSED * scales.length)[:, None]
    below = gaps < level
    crosses = below[:, 1:] & ~below[:, :-1]
    facing = np.maximum(ranges[:, 1:], ranges[:, :-1]) > -1e-3 * scales.length
    watched = np.ones(len(gaps), dtype=bool)
    watched[[*run.modes.kept, *passed]] = False
    rows, columns = np.nonzero(crosses & facing & watched[:, None])
    if not len(rows):
        return None
    first = np.lexsort([rows, columns])[0]
    pair, column = int(rows[first]), int(columns[first])
    return pair, float(runs[column]), float(runs[column + 1])
