"""Tables of torques over time: rows that give a profile back, and samples at a rate.

The straight lines between rows are the best in the sense of least squares, so that what they miss
has no mean and no first moment: in the motion their errors cancel, which those of lines through
points on a bent curve do not. Rows are denser where the torques bend more.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, require_number
from .torque import COLUMNS, TorqueProfile

ERROR = 1e-5  # largest error of the straight lines between rows, relative to the largest torque
STEP = 1e-6
"""Jump at a break from which on the rows keep it as a step, relative to the largest torque."""
INTERPOLATIONS = ("linear", "hold")
_PLACES = np.linspace(-1.0, 1.0, 17)  # places in each piece of torques at which it is looked at
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(6)


COMMANDS = ("command1", "command2")
"""Columns of what motors that lag are told, so that they make the torques."""


def place_rows(
    torque: TorqueProfile, error: float = ERROR, rate_limit: Array | None = None
) -> Array:
    """Rows (t, tau_1, tau_2) whose straight lines give torques back, shape (n, 3) [s, N m, N m].

    Every break of the torques has a row, and two where they step.

    Parameters
    ----------
    error                      what the lines may miss, relative to the largest torque
    rate_limit : (2,) [N m/s]  largest rates, which lines keep if the torques do
    """
    peak = np.abs(_sample(torque.coefficients)).max(axis=(0, 1))
    largest = float(peak.max())
    if largest == 0.0:
        ends = torque.breaks[[0, -1]]
        return np.column_stack([ends, np.zeros((2, 2))])
    knots = _divide(torque, error * largest)
    breaks = torque.breaks
    alternate = (-1.0) ** np.arange(torque.coefficients.shape[2])
    jump = torque.coefficients[1:] @ alternate - torque.coefficients[:-1].sum(axis=2)
    steps = breaks[1:-1][np.abs(jump).max(axis=1) > STEP * largest]
    ends = np.concatenate([breaks[:1], steps, breaks[-1:]])
    at = np.searchsorted(knots, ends)
    stretches = [knots[i : j + 1] for i, j in pairwise(at)]
    rows = np.concatenate(
        [np.column_stack([stretch, _fit_lines(torque, stretch)]) for stretch in stretches]
    )
    # Lines through a bend miss it on both sides; no limit is to be missed for that.
    peak = np.maximum(peak, np.abs(torque.at(knots)).max(axis=0))
    rows[:, 1:] = np.clip(rows[:, 1:], -peak, peak)
    if rate_limit is not None:
        _slow_down(rows, torque, rate_limit)
    return rows


def sample_rows(torque: TorqueProfile, rate: float, interpolation: str) -> Array:
    """Rows with samples of torques at a rate, shape (n, 3) [s, N m, N m].

    Samples are those of the instants k / `rate`, at a step the later ones, until the torques have
    ended. With the interpolation ``"linear"`` they are joined by straight lines; with ``"hold"``
    each is held until the next one, and its row is there twice, at both ends of its period.

    Raises
    ------
    InputError  if the rate is not a positive number or gives fewer than two samples, or the
                interpolation is another one
    """
    rate = require_sampling(rate, interpolation)
    start, count = torque.breaks[0], torque.duration * rate
    if not 1 <= count <= 1e7:
        needed = f"{1 / torque.duration:.4g} to {1e7 / torque.duration:.4g} Hz"
        raise InputError("", "sample_rate", f"{rate:g} Hz given; allowed are {needed}")
    t = start + np.arange(int(np.ceil(count - 1e-9)) + 1) / rate
    # A sample within rounding before a step is one after it.
    tau = torque.at(t * (1 + 1e-15))
    if interpolation == "linear":
        return np.column_stack([t, tau])
    held = np.repeat(tau[:-1], 2, axis=0)
    return np.column_stack([np.repeat(t, 2)[1:-1], held])


def require_sampling(rate: object, interpolation: str) -> float:
    """The rate [Hz] as a number, if it and the interpolation are allowed.

    Raises
    ------
    InputError  if they are not
    """
    if interpolation not in INTERPOLATIONS:
        allowed = " and ".join(INTERPOLATIONS)
        raise InputError("", "interpolation", f"{interpolation!r} given; allowed are {allowed}")
    return require_number(rate, "sample_rate", positive=True)


def format_rows(rows: Array, commands: Array | None = None) -> str:
    """The rows as CSV with the columns t, tau1 and tau2, and those of commands, shape (n, 2)."""
    columns, notes = list(COLUMNS), list[str]()
    if commands is not None:
        columns, rows = [*COLUMNS, *COMMANDS], np.column_stack([rows, commands])
        notes.append(f"# {' and '.join(COMMANDS)}: tau + actuator_lag d tau / dt, in N m")
    lines = [*notes, ",".join(columns), *(",".join(map(repr, row)) for row in rows.tolist())]
    return "\n".join(lines) + "\n"


def read_rows(rows: Array) -> TorqueProfile:
    """The torques that rows say."""
    return TorqueProfile.join_rows(rows[:, 0], rows[:, 1:])


def _divide(torque: TorqueProfile, error: float) -> Array:
    """Breaks of the torques, and places between them where a line would miss more than `error`."""
    breaks, h, x = torque.breaks, np.diff(torque.breaks), _PLACES
    bends = _sample(np.asarray(np.polynomial.polynomial.polyder(torque.coefficients, 2, axis=2)))
    # A line over a part of length p misses p^2 / 8 times the second derivative.
    density = np.sqrt(np.abs(bends).max(axis=2) / (8 * error))
    inner = (density[:, 1:] + density[:, :-1]) / 2 * np.diff(x)
    total = np.concatenate([np.zeros((len(h), 1)), np.cumsum(inner, axis=1)], axis=1)
    counts = np.maximum(1, np.ceil(total[:, -1])).astype(int)
    parts = []
    for k, count in enumerate(counts):
        inside = np.interp(np.linspace(0.0, total[k, -1], count + 1)[1:-1], total[k], x)
        parts += [breaks[[k]], breaks[k] + h[k] * (inside + 1) / 2]
    return np.append(np.concatenate(parts), breaks[-1])


def _slow_down(rows: Array, torque: TorqueProfile, rate_limit: Array) -> None:
    """Give lines that are too steep the torques at their ends, in place.

    Near a kink the nearest lines swing about the torques. Lines through points of these are no
    steeper than they are.
    """
    t, h = rows[:, 0], np.diff(rows[:, 0])[:, None]
    # At a step the earlier row has the torques before it.
    before = np.append(h[:, 0] == 0, False)
    exact = torque.at(np.where(before, np.nextafter(t, -np.inf), t))
    while True:
        steep = (h > 0) & (np.abs(np.diff(rows[:, 1:], axis=0)) > rate_limit * h)
        wrong = np.zeros(exact.shape, dtype=bool)
        wrong[:-1] |= steep
        wrong[1:] |= steep
        wrong &= rows[:, 1:] != exact
        if not wrong.any():
            return
        rows[:, 1:][wrong] = exact[wrong]


def _sample(coefficients: Array) -> Array:
    """Values of polynomials, shape (k, 2, d + 1), at some places in each: shape (k, n, 2)."""
    powers = _PLACES[:, None] ** np.arange(coefficients.shape[2])
    return np.asarray(np.einsum("kjd,nd->knj", coefficients, powers))


def _fit_lines(torque: TorqueProfile, knots: Array) -> Array:
    """Values at knots, shape (n, 2), of the continuous straight lines nearest to the torques."""
    h = np.diff(knots)
    t = knots[:-1, None] + h[:, None] * (_POINTS + 1) / 2
    tau = torque.at(t.ravel()).reshape(*t.shape, 2) * (_WEIGHTS * h[:, None] / 2)[..., None]
    later = (_POINTS + 1) / 2
    right = np.zeros((len(knots), 2))
    right[:-1] += np.einsum("knj,n->kj", tau, 1 - later)
    right[1:] += np.einsum("knj,n->kj", tau, later)
    diagonal = (np.append(h, 0.0) + np.append(0.0, h)) / 3
    return _solve_tridiagonal(diagonal, h / 6, right)


def _solve_tridiagonal(diagonal: Array, beside: Array, right: Array) -> Array:
    """Solve a symmetric, diagonally dominant system: shapes (n,), (n - 1,) and (n, 2)."""
    pivot, rows = diagonal.tolist(), right.tolist()
    off = beside.tolist()
    for k in range(1, len(pivot)):
        share = off[k - 1] / pivot[k - 1]
        pivot[k] -= share * off[k - 1]
        rows[k] = [own - share * before for own, before in zip(rows[k], rows[k - 1], strict=True)]
    rows[-1] = [own / pivot[-1] for own in rows[-1]]
    for k in range(len(pivot) - 2, -1, -1):
        rows[k] = [
            (own - off[k] * after) / pivot[k]
            for own, after in zip(rows[k], rows[k + 1], strict=True)
        ]
    return np.array(rows)
