"""Joint torques over time: polynomials between breaks, with a step allowed at every break."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TextIO

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, name_file, require_array, require_number
from ..common.fields import choice

ERROR = 1e-5  # largest error of the straight lines between rows, relative to the largest torque

_PLACES = np.linspace(-1.0, 1.0, 17)  # places in each piece at which torques are evaluated
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(6)
COMMANDS = ("command1", "command2")
"""Columns of the commands with which motors with lags produce the torques."""
COLUMNS = ("t", "tau1", "tau2")
MAX_NUMBER = 1e30
"""Largest number in a file of torques or of a trajectory: its square and cube are still numbers."""


@dataclass(frozen=True, eq=False)
class TorqueProfile:
    """Piecewise-polynomial joint torques."""

    breaks: Array  # (k + 1,) [s]: strictly increasing; torques are smooth between them
    # (k, 2, d + 1) [N m]: ascending powers of x = (2 t - t_k - t_k+1) / (t_k+1 - t_k) on piece k
    coefficients: Array

    def __post_init__(self) -> None:
        breaks = require_array(self.breaks, "breaks", -1)
        coefficients = require_array(self.coefficients, "coefficients", len(breaks) - 1, 2, -1)
        object.__setattr__(self, "breaks", breaks)
        object.__setattr__(self, "coefficients", coefficients)

    def check(self) -> TorqueProfile:
        """The torques; an `InputError` if breaks do not increase, or a number is not finite."""
        if len(self.breaks) < 2 or not (np.diff(self.breaks) > 0).all():
            raise InputError("", "breaks", "must be two or more, and increase")
        for name in ("breaks", "coefficients"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError("", name, "holds numbers that are not finite")
        return self

    def __repr__(self) -> str:
        return f"TorqueProfile({len(self.coefficients)} pieces, {self.duration:.6g} s)"

    @property
    def duration(self) -> float:
        """Time from the first break to the last [s]."""
        return float(self.breaks[-1] - self.breaks[0])

    def at(self, t: Array) -> Array:
        """Torques at times `t`, shape (n,), as (n, 2) [N m]; at a break, those just after it.

        Before the first break and after the last one torques are constant.
        """
        t = np.clip(t, self.breaks[0], self.breaks[-1])
        piece = np.searchsorted(self.breaks[1:-1], t, side="right")
        start, stop = self.breaks[piece], self.breaks[piece + 1]
        x = (2 * t - start - stop) / (stop - start)
        powers = x[:, None] ** np.arange(self.coefficients.shape[2])
        return np.asarray(np.einsum("njd,nd->nj", self.coefficients[piece], powers))

    def at_places(self, x: Array) -> Array:
        """Torques at places `x`, shape (n,) in [-1, 1], of every piece, as (k, 2, n) [N m]."""
        powers = x[:, None] ** np.arange(self.coefficients.shape[2])
        return np.asarray(self.coefficients @ powers.T)

    @property
    def peaks(self) -> Array:
        """The largest absolute torques in each piece, at 17 places of it, (k, 2) [N m]."""
        return np.asarray(np.abs(self.at_places(_PLACES)).max(axis=2))

    @property
    def jumps(self) -> Array:
        """Steps of the torques at the inner breaks, shape (k - 1, 2) [N m]."""
        signs = (-1.0) ** np.arange(self.coefficients.shape[2])
        return np.asarray(self.coefficients[1:] @ signs - self.coefficients[:-1].sum(axis=2))

    @property
    def held_steps(self) -> Array:
        """Breaks between two pieces with constant torques, shape (n,) [s]."""
        constant = np.asarray((self.coefficients[..., 1:] == 0).all(axis=(1, 2)))
        return np.asarray(self.breaks[1:-1][constant[1:] & constant[:-1]])

    @property
    def slopes(self) -> TorqueProfile:
        """Time derivative of the torques within the pieces [N m/s]."""
        slopes = np.zeros_like(self.coefficients)
        slopes[..., :-1] = self.coefficients[..., 1:] * np.arange(1, slopes.shape[2])
        return TorqueProfile(self.breaks, slopes * (2 / np.diff(self.breaks))[:, None, None])

    def integrate_squares(self) -> float:
        """Integral of tau^T tau over all pieces [(N m)^2 s]."""
        degree = self.coefficients.shape[2]
        total = np.arange(degree)[:, None] + np.arange(degree)
        moments = np.where(total % 2 == 0, 2 / (total + 1), 0.0)
        squares = np.einsum("kjd,de,kje->k", self.coefficients, moments, self.coefficients)
        return float(squares @ np.diff(self.breaks) / 2)

    def cut(self, start: float, stop: float) -> TorqueProfile:
        """The torques from `start` to `stop` [s], constant beyond the present ends."""
        tolerance = 1e-12 * max(abs(start), abs(stop))
        inside = self.breaks[(self.breaks > start + tolerance) & (self.breaks < stop - tolerance)]
        breaks, degree = np.array([start, *inside, stop]), self.coefficients.shape[2] - 1
        return TorqueProfile.fit(breaks, self.at, degree)

    @staticmethod
    def fit(breaks: Array, function: Callable[[Array], Array], degree: int) -> TorqueProfile:
        """Interpolate `function`, t -> (n, 2) [N m], at Chebyshev nodes of each piece.

        The nodes are inside the pieces, so a step at a break is never sampled.
        """
        x = np.cos(np.pi * (2 * np.arange(degree + 1) + 1) / (2 * degree + 2))
        middle, half = (breaks[1:] + breaks[:-1]) / 2, np.diff(breaks) / 2
        values = function((middle[:, None] + half[:, None] * x).ravel())
        values = values.reshape(len(middle), degree + 1, 2)
        invert = np.linalg.inv(np.vander(x, increasing=True))
        return TorqueProfile(breaks, np.einsum("dm,kmj->kjd", invert, values))

    @staticmethod
    def chain(profiles: Sequence[TorqueProfile]) -> TorqueProfile:
        """Concatenation of profiles that each start at 0."""
        breaks, start = [np.zeros(1)], 0.0
        for profile in profiles:
            breaks.append(start + profile.breaks[1:])
            start = float(breaks[-1][-1])
        blocks = [profile.coefficients for profile in profiles]
        size = max(block.shape[2] for block in blocks)
        padded = [np.pad(block, ((0, 0), (0, 0), (0, size - block.shape[2]))) for block in blocks]
        return TorqueProfile(np.concatenate(breaks), np.concatenate(padded))

    @staticmethod
    def join_rows(rows: Array) -> TorqueProfile:
        """Linear torques between rows t, tau1, tau2, shape (n, 3) [s, N m, N m].

        Two rows at one time are a step there. InputError if times decrease, or never increase, or
        a number is not finite.
        """
        rows = require_array(rows, "rows", -1, 3)
        t, tau = rows[:, 0], rows[:, 1:]
        pieces = np.flatnonzero(np.diff(t))
        middle, half = (tau[pieces] + tau[pieces + 1]) / 2, (tau[pieces + 1] - tau[pieces]) / 2
        breaks = np.append(t[pieces], t[-1])
        return TorqueProfile(breaks, np.stack([middle, half], axis=2)).check()


def read_torque_csv(path: str | Path) -> TorqueProfile:
    """Read torques from a CSV file with the columns ``t,tau1,tau2`` (s, N m, N m).

    Torques are linear between rows; a repeated time is a step. Lines that begin with ``#`` are
    comments; see `read_notes`.

    InputError if the file cannot be read, a column is missing or repeated, a row has more values
    than columns, one is not a finite number, or the times do not start at 0 and increase.
    """
    path = str(path)
    with _open(path) as stream:
        reader = csv.reader(stream)
        numbered = [
            (reader.line_num, row)
            for row in reader
            if any(map(str.strip, row)) and not row[0].lstrip().startswith("#")
        ]
    header = [cell.strip() for cell in numbered[0][1]] if numbered else []
    for column in COLUMNS:
        if header.count(column) != 1:
            names = ",".join(header) or "an empty file"
            problem = "is there twice" if column in header else "is missing"
            text = f"column {problem}; {names} given, {','.join(COLUMNS)} needed"
            raise InputError(str(path), column, text)
    indices = {column: header.index(column) for column in COLUMNS}
    for line, row in numbered[1:]:
        if any(map(str.strip, row[len(header) :])):
            text = f"{len(row)} values on line {line} given; the columns are {','.join(header)}"
            raise InputError(str(path), "", text)
    values = np.array([_read_row(path, line, row, indices) for line, row in numbered[1:]])
    if len(values) < 2:
        raise InputError(str(path), "t", f"{len(values)} rows given; two or more are needed")
    t = values[:, 0]
    if t[0] != 0.0:
        raise InputError(str(path), "t", f"the first time is {t[0]:g}; it must be 0")
    steps = np.diff(t)
    if (steps < 0).any():
        k = int(np.argmax(steps < 0)) + 1
        raise InputError(str(path), "t", f"time goes back from {t[k - 1]:g} to {t[k]:g} s")
    if (repeated := (steps[1:] == 0) & (steps[:-1] == 0)).any():
        k = int(repeated.argmax()) + 2
        text = f"{t[k]:g} s is given three times, again on line {numbered[k + 1][0]}"
        raise InputError(str(path), "t", f"{text}; twice makes a step")
    if t[-1] == 0.0:
        raise InputError(str(path), "t", "every time is 0; the torques must last")
    return TorqueProfile.join_rows(values)


def read_notes(path: str) -> dict[str, str]:
    """Comments ``# key = value`` of a CSV file; an `InputError` if it cannot be read."""
    with _open(path) as stream:
        comments = [line[1:].split("=", 1) for line in stream if line.startswith("#")]
    return {pair[0].strip(): pair[1].strip() for pair in comments if len(pair) == 2}


@contextmanager
def _open(path: str) -> Iterator[TextIO]:
    """Open a CSV file; its errors become an `InputError`."""
    try:
        with name_file(path), open(path, newline="", encoding="utf-8-sig") as stream:
            yield stream
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(str(path), "", f"is not CSV: {error}") from None


def _read_row(path: str, line: int, row: list[str], indices: Mapping[str, int]) -> list[float]:
    values = []
    for column, index in indices.items():
        text, value = row[index].strip() if index < len(row) else "", math.nan
        with suppress(ValueError):
            # Python reads 0_6 as 6, which is not CSV.
            value = math.nan if "_" in text else float(text)
        if not math.isfinite(value):
            raise InputError(str(path), column, f"{text!r} on line {line} is not a finite number")
        if abs(value) > MAX_NUMBER:
            allowed = f"allowed are -{MAX_NUMBER:g} to {MAX_NUMBER:g}"
            raise InputError(str(path), column, f"{text} on line {line} given; {allowed}")
        values.append(value)
    return values


def place_rows(
    torque: TorqueProfile, error: float = ERROR, rate_limit: Array | None = None
) -> Array:
    """Rows (t, tau_1, tau_2) whose linear interpolation is torques, shape (n, 3) [s, N m, N m].

    Every break of the torques has a row, and two at steps of 1e-6 of the largest or more. `error`
    is the tolerance of the interpolation, relative to the largest torque. It keeps a rate limit,
    (2,) [N m/s], if the torques do.
    """
    peak, breaks = torque.peaks.max(axis=0), torque.breaks
    largest = float(peak.max())
    if largest == 0.0:
        return np.column_stack([breaks[[0, -1]], np.zeros((2, 2))])
    knots = _divide(torque, error * largest)
    steps = breaks[1:-1][np.abs(torque.jumps).max(axis=1) > 1e-6 * largest]
    indices = np.searchsorted(knots, [breaks[0], *steps, breaks[-1]])
    stretches = [knots[i : j + 1] for i, j in pairwise(indices)]
    rows = np.concatenate([np.column_stack([k, _fit_lines(torque, k)]) for k in stretches])
    # Lines near a bend may exceed it: torques are clipped to their own largest values.
    peak = np.maximum(peak, np.abs(torque.at(knots)).max(axis=0))
    rows[:, 1:] = np.clip(rows[:, 1:], -peak, peak)
    if rate_limit is not None:
        _slow_down(rows, torque, rate_limit)
    return rows


def sample_rows(torque: TorqueProfile, rate: float, interpolation: str) -> Array:
    """Rows with samples of torques at a rate, shape (n, 3) [s, N m, N m].

    Samples are at the instants k / `rate`, at a step just after it, until the torques end. With the
    interpolation ``"linear"`` they are joined by straight lines; with ``"hold"`` each is constant
    until the next one, with two rows, at both ends of its period.

    InputError if the rate is not a positive number or gives fewer than two samples, or the
    interpolation is another one.
    """
    choice("linear", "hold").read(interpolation, "interpolation")
    rate = require_number(rate, "sample_rate", positive=True)
    start, count = torque.breaks[0], torque.duration * rate
    if not 1 <= count <= 1e7:
        allowed = f"{1 / torque.duration:.4g} to {1e7 / torque.duration:.4g} Hz"
        raise InputError("", "sample_rate", f"{rate:g} Hz given; allowed are {allowed}")
    t = start + np.arange(int(np.ceil(count - 1e-9)) + 1) / rate
    # A sample at a step, but for rounding, is one after it.
    tau = torque.at(t * (1 + 1e-15))
    if interpolation == "linear":
        return np.column_stack([t, tau])
    values = np.repeat(tau[:-1], 2, axis=0)
    return np.column_stack([np.repeat(t, 2)[1:-1], values])


def format_rows(rows: Array, commands: Array | None = None) -> str:
    """The rows as CSV with the columns t, tau1 and tau2, and those of commands, shape (n, 2)."""
    columns, notes = list(COLUMNS), list[str]()
    if commands is not None:
        columns, rows = [*COLUMNS, *COMMANDS], np.column_stack([rows, commands])
        notes.append(f"# {' and '.join(COMMANDS)}: tau + actuator_lag d tau / dt, in N m")
    lines = [*notes, ",".join(columns), *(",".join(map(repr, row)) for row in rows.tolist())]
    return "\n".join(lines) + "\n"


def _divide(torque: TorqueProfile, error: float) -> Array:
    """Breaks of the torques, and places between them for linear interpolation within `error`."""
    breaks, h, x = torque.breaks, np.diff(torque.breaks), _PLACES
    second = np.polynomial.polynomial.polyder(torque.coefficients, 2, axis=2)
    curvature = TorqueProfile(breaks, np.asarray(second)).at_places(_PLACES)
    # The error of a line over a length p is p^2 / 8 times the second derivative.
    density = np.sqrt(np.abs(curvature).max(axis=1) / (8 * error))
    weights = (density[:, 1:] + density[:, :-1]) / 2 * np.diff(x)
    total = np.concatenate([np.zeros((len(h), 1)), np.cumsum(weights, axis=1)], axis=1)
    counts = np.maximum(1, np.ceil(total[:, -1])).astype(int)
    parts = []
    for k, count in enumerate(counts):
        places = np.interp(np.linspace(0.0, total[k, -1], count + 1)[1:-1], total[k], x)
        parts += [breaks[[k]], breaks[k] + h[k] * (places + 1) / 2]
    return np.append(np.concatenate(parts), breaks[-1])


def _slow_down(rows: Array, torque: TorqueProfile, rate_limit: Array) -> None:
    """Replace ends of lines that exceed the rate limit by exact torques, in place.

    Near a kink the best lines oscillate about the torques. Lines through exact torques are not
    steeper than the torques.
    """
    t, h = rows[:, 0], np.diff(rows[:, 0])[:, None]
    allowed = rate_limit * np.where(h > 0, h, np.inf)
    # At a step the earlier row has the torques before it.
    before = np.append(h[:, 0] == 0, False)
    exact, wrong = torque.at(np.where(before, np.nextafter(t, -np.inf), t)), np.ones(1, dtype=bool)
    while wrong.any():
        steep = np.abs(np.diff(rows[:, 1:], axis=0)) > allowed
        steep = np.pad(steep, ((1, 1), (0, 0)))
        wrong = (steep[1:] | steep[:-1]) & (rows[:, 1:] != exact)
        np.copyto(rows[:, 1:], exact, where=wrong)


def _fit_lines(torque: TorqueProfile, knots: Array) -> Array:
    """Values at knots, shape (n, 2), of the piecewise linear least-squares fit of the torques."""
    from scipy.linalg import solveh_banded

    h = np.diff(knots)
    t = knots[:-1, None] + h[:, None] * (_POINTS + 1) / 2
    tau = torque.at(t.ravel()).reshape(*t.shape, 2) * (_WEIGHTS * h[:, None] / 2)[..., None]
    fraction = (_POINTS + 1) / 2
    moments = np.zeros((len(knots), 2))
    moments[:-1] += np.einsum("knj,n->kj", tau, 1 - fraction)
    moments[1:] += np.einsum("knj,n->kj", tau, fraction)
    diagonal = (np.append(h, 0.0) + np.append(0.0, h)) / 3
    # The first entry of the upper diagonal is not used.
    return np.asarray(solveh_banded([np.append(0.0, h / 6), diagonal], moments))
