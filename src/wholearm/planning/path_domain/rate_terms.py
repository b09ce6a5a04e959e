"""Rows of the planning NLP for torque rate limits and actuator lag.

With the local variable y of an element (`elements`), d tau / dt = (d tau / dy) (dy / dt). At the
nodes d tau / dy is that of the polynomial through the torques there. Torques are continuous where
two elements meet; there, and where a direction reverses, s'' and the internal force may step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ...mechanics.dynamics import LAMBDA, ONE
from ...scene.model import Scene
from .elements import (
    DEGREE,
    FROM_HOLD,
    FROM_REST,
    INSIDE,
    SIGNS,
    TO_HOLD,
    TO_REST,
    Elements,
    Grid,
    Profile,
    find_basis,
    follow,
)
from .path_data import PhaseData
from .path_mesh import Switch
from .path_motion import PLACES, PathMotion

if TYPE_CHECKING:
    from ..columns import Symbols


_LONGER = 1.05  # factor on the least time of ramps, so that they are inside the limits
_STEP = 1e-2  # least step of a torque that gets a ramp, over its limit
_LAGS = 3.0  # time of a step by the torque limit, over the lag
_BRIEF = 0.3  # largest share of all ramps in the duration
_RAMP_REACH = 0.3  # least distance of a break from a ramp, over the ramp's length
_RAMPED = 0.5  # rate, over the largest one, above which a torque is in a ramp
_FLAT = 0.1  # rate, over the largest one, up to which it is not
_KINK = 2.0  # least step of a rate that counts, times the duration, over the torque limit
_NEAR = 0.06  # least time between switches, over that of a ramp by the torque limit
_APART = 4e-3  # the same over the duration, where that is less
_LATE = 0.4  # least length of a first or last element, over that of the ramp there
_MOST = 24  # most switches of a phase
_LOOKS = 21  # samples of the rates in each interval
_NODES = DEGREE + 1


class MotorShape(NamedTuple):
    """Joints with a torque rate limit, and those whose torques lag behind a command."""

    rates: tuple[int, ...] = ()
    commands: tuple[int, ...] = ()

    @staticmethod
    def of(scene: Scene) -> MotorShape:
        """The shape of a scene's motors."""
        if not scene.has_slow_motors:
            return UNLIMITED
        limited, lags = np.isfinite(scene.torque_rate_limit), scene.actuator_lag > 0
        return MotorShape(*(tuple(np.flatnonzero(mask).tolist()) for mask in (limited, lags)))

    @property
    def slow(self) -> tuple[int, ...]:
        """Joints whose torques may not step."""
        return tuple(sorted({*self.rates, *self.commands}))

    def list_sizes(self, intervals: int) -> dict[str, int]:
        """Numbers of rows of each kind."""
        n, joints = intervals + 1, len(self.slow)
        return {
            "rates": n * len(self.rates),
            "commands": n * len(self.commands),
            "joins": (n // _NODES - 1) * joints,
            "begins": 2 * bool(joints),
        }


UNLIMITED = MotorShape()  # motors whose torques may step


def list_kinds(count: int, held: bool) -> list[int]:
    """Kinds of `count` elements from rest to rest."""
    start, stop = (FROM_HOLD, TO_HOLD) if held else (FROM_REST, TO_REST)
    return [start, *[INSIDE] * (count - 2), stop]


def find_first_slopes(a: Expression) -> tuple[Expression, Expression]:
    """Slopes of s'' over y at the start, and at the end backwards."""
    basis = find_basis()
    start = ca.DM(basis.to_powers[FROM_HOLD][1]).T @ a[:_NODES]
    return start, ca.DM(basis.to_powers[TO_HOLD][1]).T @ a[-_NODES:]


def write_motor_rows(
    shape: MotorShape,
    symbols: Symbols,
    torques: Expression,
    a: Expression,
    paces: Expression,
    lengths: Expression,
) -> dict[str, Expression]:
    """Rows of each kind of `MotorShape.list_sizes`.

    Parameters
    ----------
    symbols                              parameters `quick`, 1 / rate limit, and `lags`
    torques, a : (n, 2), (n,)
    paces, lengths : (p + 1, E), (1, E)  dy/dt times the element's length, and that
    """
    if not shape.slow:
        return dict.fromkeys(shape.list_sizes(0), ca.SX(0, 1))
    rates = {joint: _differentiate(torques[:, joint], paces, lengths) for joint in shape.slow}
    rows = [symbols.quick[k] * rates[joint] for k, joint in enumerate(shape.rates)]
    lagged = [
        torques[:, joint] + symbols.lags[k] * rates[joint] for k, joint in enumerate(shape.commands)
    ]
    joins = [torques[_NODES::_NODES, j] - torques[DEGREE:-1:_NODES, j] for j in shape.slow]
    return {
        "rates": ca.vertcat(ca.SX(0, 1), *rows),
        "commands": ca.vertcat(ca.SX(0, 1), *lagged),
        "joins": ca.vertcat(*joins),
        "begins": ca.vertcat(*find_first_slopes(a)),
    }


def _differentiate(values: Expression, paces: Expression, lengths: Expression) -> Expression:
    """Time derivative at the nodes of what has these values there, shape (n,)."""
    table, count = ca.reshape(values, _NODES, -1), lengths.numel()
    slopes = [ca.DM(slope) for slope in list_slopes()]
    columns = [slopes[kind] @ table[:, e] for e, kind in enumerate(list_kinds(count, True))]
    return ca.vec(ca.horzcat(*columns) * paces / ca.repmat(lengths, _NODES, 1))


def list_slopes() -> list[Array]:
    """Differentiation matrices at the nodes of each kind of element, over y in forward time."""
    basis, powers = find_basis(), np.arange(_NODES)
    return [
        sign * (powers * y[:, None] ** np.maximum(powers - 1, 0)) @ to_powers
        for sign, y, to_powers in zip(SIGNS, basis.y, basis.to_powers, strict=True)
    ]


def find_torques(
    data: PhaseData, profile: Profile, motions: Sequence[PathMotion]
) -> tuple[Array, Array]:
    """Torques and their rates, (n_solid, _LOOKS, 2) [N m, N m/s], at evenly spaced times.

    By Chebyshev interpolation in time through torques within each interval.
    """
    checks = data.sampling.checks
    every = (len(checks) - 1) // (PLACES - 1)
    picked = np.arange(len(checks)) % every == 0
    fractions, count = checks[picked], len(data.nonempty)
    places = data.checks.pick(np.tile(picked, count))
    values = places.forces.tau(*data.interpolate(profile, fractions)).reshape(count, -1, 2)
    spans = np.concatenate([motion.durations(fractions) for motion in motions])
    degree, lasts = len(fractions) - 1, np.maximum(spans[:, -1], np.finfo(float).tiny)
    through = chebyshev.chebvander(2 * spans / lasts[:, None] - 1, degree)
    # Where two places fall on one instant no polynomial goes through both.
    modes = np.linalg.solve(through + 1e-300, values)
    looks = np.linspace(-1, 1, _LOOKS)
    slopes = chebyshev.chebder(np.eye(degree + 1), axis=0)
    torques = chebyshev.chebvander(looks, degree) @ modes
    rates = chebyshev.chebvander(looks, degree - 1) @ slopes @ modes
    return np.asarray(torques), np.asarray(rates * (2 / lasts)[:, None, None])


def find_hurry(data: PhaseData, profile: Profile, motions: Sequence[PathMotion]) -> Array:
    """Relative violations of rates and commands of each joint in each interval, (n_solid, 2, 2)."""
    if not data.grid.held:
        return np.zeros((len(data.nonempty), 2, 2))
    torques, rates = find_torques(data, profile, motions)
    rate = np.abs(rates).max(axis=1) / data.rate_limit
    lags = data.curve.formation.scene.actuator_lag
    command = np.abs(torques + lags * rates).max(axis=1) / data.torque_limit
    return np.asarray(np.maximum(np.stack([rate, command * (lags > 0)], axis=1) - 1, 0.0))


def exceeds_rates(data: PhaseData, profile: Profile) -> bool:
    """Whether torque rates or commands are beyond their limits at the nodes of a motion."""
    grid, lags = data.grid, data.curve.formation.scene.actuator_lag
    if not grid.held:
        return False
    speed = np.sqrt(profile.b).reshape(-1, _NODES)
    y_t = speed / np.maximum(Elements(grid, profile).stretch, 1e-6) / np.diff(grid.edges)
    tau = data.nodes.forces.tau(*profile).reshape(-1, _NODES, 2)
    rates = np.stack(list_slopes())[grid.kinds] @ tau * y_t[..., None]
    command = np.abs(tau + lags * rates) * (lags > 0)
    return bool((np.abs(rates) > data.rate_limit).any() or (command > data.torque_limit).any())


def find_rate_switches(part: PhaseData, profile: Profile) -> list[Switch]:
    """Places along a phase's curve where torque rates step."""
    motion = PathMotion(part.curve, part.grid, profile)
    if motion.stalls:
        return []
    torques, rates = find_torques(part, profile, [motion])
    first, last = motion.times[part.nonempty], motion.times[part.nonempty + 1]
    looks = np.linspace(0.0, 1.0, rates.shape[1])
    t = (first[:, None] + looks * (last - first)[:, None]).ravel()
    most = np.maximum(np.abs(rates).max(axis=(0, 1)), part.torque_limit / motion.duration)
    largest = np.where(np.isfinite(part.rate_limit), part.rate_limit, most)
    shares = (rates / largest).reshape(-1, 2)
    owner = np.repeat(part.nonempty // (DEGREE + 1), len(looks))
    columns = zip(torques.reshape(-1, 2).T, shares.T, largest, strict=True)
    steps = [_find_ramps(t, owner, *column) for column in columns]
    ends = np.arange(len(looks) - 1, len(t) - 1, len(looks))
    jumps = np.abs(rates.reshape(-1, 2)[ends + 1] - rates.reshape(-1, 2)[ends])
    kinks = t[ends[(jumps * motion.duration > _KINK * part.torque_limit).any(axis=1)]]
    quickest = float((part.torque_limit / largest).min())
    apart = min(_NEAR * quickest, _APART * motion.duration)
    every = _clear_ends(np.concatenate([*steps, kinks]), motion.duration, quickest)
    times = _thin_out(every, motion.duration, apart)[:_MOST]
    return [Switch(float(s), True) for s in _locate(part, motion, times)] if len(times) else []


def _find_ramps(
    t: Array, owner: NDArray[np.int64], tau: Array, shares: Array, largest: float
) -> Array:
    """Times at which ramps of a torque start and end.

    Parameters
    ----------
    t, owner, tau, shares : (n,)  samples: time, element, torque, and rate over the `largest`
    """
    level = np.where(np.abs(shares) > _RAMPED, np.sign(shares), 0.0)
    ends = np.flatnonzero(np.diff(np.concatenate([[0.0], level, [0.0]])))
    starts, stops = ends[:-1], ends[1:] - 1
    ramps = level[starts] != 0
    starts, stops, switches = starts[ramps], stops[ramps], list[float]()
    borders = np.concatenate([[0], starts, stops, [len(t) - 1]])
    for first, last in zip(starts.tolist(), stops.tolist(), strict=True):
        k = first + int(np.abs(shares[first : last + 1]).argmax())
        slope, middle = float(np.clip(shares[k], -1.0, 1.0)), (t[first] + t[last]) / 2
        level = np.interp(middle, t, tau)
        for end, step in ((first, -1), (last, 1)):
            beyond = borders[(borders - end) * step > 0]
            if not len(beyond):
                continue
            looks = np.arange(end, beyond[np.abs(beyond - end).argmin()] + step, step)
            rate = np.abs(shares[looks])
            # The polynomial of an element with a switch oscillates: others are preferred.
            flat = rate < _FLAT
            steady = flat & ~np.isin(owner[looks], owner[looks][~flat])
            flat = steady if steady.any() else flat
            neighbour = looks[int(np.argmax(flat) if flat.any() else rate.argmin())]
            rise = tau[neighbour] - level - slope * largest * (t[neighbour] - middle)
            change = (slope - shares[neighbour]) * largest
            if change:
                switches.append(float(t[neighbour] + rise / change))
    return np.array(switches)


def _locate(part: PhaseData, motion: PathMotion, t: Array) -> Array:
    """Places at some times within a motion [m]; ends of elements without rounding."""
    places, edges = motion.locate(t)[0], part.grid.edges[1:, 0]
    ends = motion.times.reshape(len(edges) + 1, -1)[1:, 0]
    near = np.abs(t[:, None] - ends).argmin(axis=1)
    same = np.abs(t - ends[near]) < 1e-9 * motion.duration
    return np.where(same, edges[near], places)


def _clear_ends(t: Array, duration: float, quickest: float) -> Array:
    """Times without those early in the ramps at both ends of a motion."""
    for left in (t, duration - t):
        longest = left[left < min(quickest, duration / 2)].max(initial=0.0)
        t = np.where(left < _LATE * longest, np.nan, t)
    return t[np.isfinite(t)]


def _thin_out(times: Array, duration: float, apart: float) -> Array:
    """Times within a motion, increasing, none of which is near another one."""
    kept = list[float]()
    for t in times.tolist():
        if min(abs(t - other) for other in [0.0, duration, *kept]) > apart:
            kept.append(t)
    return np.sort(kept)


class Ramped(NamedTuple):
    """Ramps in place of the torque steps of a plan without rate limits."""

    spans: Array  # (r, 2) [m]: where ramps start and end, along all curves
    holds: Array  # (2,) [N]: the internal force before and after the motion

    def find_breaks(self, breaks: Array) -> list[Switch]:
        """Breaks at the ends of ramps, and the former ones that are not near a ramp [m]."""
        reach = _RAMP_REACH * np.diff(self.spans)
        near = (breaks > self.spans[:, :1] - reach) & (breaks < self.spans[:, 1:] + reach)
        places = np.concatenate([self.spans.ravel()[1:-1], breaks[~near.any(axis=0)]])
        return [Switch(float(place), True) for place in np.sort(places)]

    def guess(self, old: Grid, profile: Profile, new: Grid) -> Profile:
        """A `profile` on a grid, with ramps, on another grid."""
        a, _, lam = Elements(old, profile).move(new)
        ramped, holds = (a.copy(), lam.copy()), ((0.0, 0.0), self.holds.tolist())
        middles = np.repeat(new.edges.mean(axis=1), DEGREE + 1)
        for k, (start, stop) in enumerate(self.spans.tolist()):
            inside = np.flatnonzero((middles > start) & (middles < stop))
            if not len(inside):
                continue
            neighbour = np.clip([inside[0] - 1, inside[-1] + 1], 0, len(a) - 1)
            share = (new.s[inside] - start) / (stop - start)
            end = 0 if k == 0 else 1 if k == len(self.spans) - 1 else None
            if end is not None:
                share = 1 - np.cbrt(1 - share) if end else np.cbrt(share)
            for column, hold in zip(ramped, holds, strict=True):
                values = column[neighbour]
                if end is not None:
                    values[end] = hold[end]
                column[inside] = values[0] + share * (values[1] - values[0])
        return follow(new, *ramped)


def ramp_up(
    data: PhaseData,
    profile: Profile,
    duration: float,
    pins: tuple[float | None, float | None],
) -> Ramped | None:
    """Ramps in place of the torque steps of a `profile`; None if they would take too long.

    Parameters
    ----------
    duration : [s]  of the profile
    pins : [N]      prescribed internal forces before and after the motion, if any
    """
    lag = _LAGS * data.curve.formation.scene.actuator_lag / data.torque_limit
    slowness = _LONGER * np.maximum(1 / data.rate_limit, lag)  # (2,) [s/(N m)]: least, of a step
    tau = data.nodes.forces.tau(*profile).reshape(-1, DEGREE + 1, 2)
    holds = [_hold(data, tau[place, place], slowness, place, pins[place]) for place in (0, -1)]
    first = np.vstack([holds[0][1][None], tau[:, -1]])
    last = np.vstack([tau[:, 0], holds[1][1][None]])
    steps = np.abs(last - first)
    times = (steps * slowness).max(axis=1)
    large = (steps / data.torque_limit).max(axis=1) > _STEP
    if times[large].sum() > _BRIEF * duration:
        return None
    inner = np.flatnonzero(large[1:-1])
    s, speed = data.grid.edges[1:, 0], np.sqrt(profile.b.reshape(-1, DEGREE + 1)[1:, 0])
    half = speed[inner] * times[1:-1][inner] / 2
    ways = np.abs(profile.a[[0, -1]]) * np.maximum(times[[0, -1]], 1e-4 * duration) ** 2 / 6
    length = data.grid.s[-1]
    inside = np.stack([s[inner] - half, s[inner] + half], axis=1).tolist()
    spans = [[0.0, ways[0]]]
    for start, stop in [*inside, [length - ways[1], length]]:
        if start < spans[-1][1]:
            spans[-1][1] = max(stop, spans[-1][1])
        else:
            spans.append([start, stop])
    if len(spans) < 2 or spans[0][1] > ways[0] or spans[-1][0] < length - ways[1]:
        return None
    return Ramped(np.array(spans), np.array([hold[0] for hold in holds]))


def _hold(
    data: PhaseData, tau: Array, slowness: Array, place: int, pin: float | None
) -> tuple[float, Array]:
    """The internal force that holds the object at an end with torques near `tau`, and those."""
    forces = data.nodes.forces
    level, press = forces.of_tau[place, :, ONE], forces.of_tau[place, :, LAMBDA]
    if pin is None:
        weighted = press * slowness
        size = max(float(weighted @ weighted), 1e-300)
        pin = float(weighted @ ((tau - level) * slowness)) / size
    return pin, np.asarray(level + pin * press)
