"""Joint torques over time: polynomials between breaks, with a step allowed at every break."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError

COLUMNS = ("t", "tau1", "tau2")
MOST = 1e30
"""Largest number in a file of torques or of a trajectory: its square and cube are still numbers."""


@dataclass(frozen=True, eq=False)
class TorqueProfile:
    """Piecewise-polynomial joint torques."""

    # (k + 1,) [s]: strictly increasing. The torque may step at a break and is smooth between two.
    breaks: Array
    # (k, 2, d + 1) [N m]: ascending powers of x in [-1, 1], x = (2 t - t_k - t_k+1) / (t_k+1 - t_k)
    # on piece k
    coefficients: Array

    def __repr__(self) -> str:
        return f"TorqueProfile({len(self.coefficients)} pieces, {self.duration:.6g} s)"

    @property
    def duration(self) -> float:
        """From the first break to the last [s]."""
        return float(self.breaks[-1] - self.breaks[0])

    def at(self, t: Array) -> Array:
        """Torques at times `t`, shape (n,), as (n, 2) [N m]: at a break, those just after it.

        Before the first break and after the last one the torque of that end holds.
        """
        t = np.clip(t, self.breaks[0], self.breaks[-1])
        piece = np.searchsorted(self.breaks, t, side="right") - 1
        piece = np.minimum(piece, len(self.coefficients) - 1)
        start, stop = self.breaks[piece], self.breaks[piece + 1]
        x = (2 * t - start - stop) / (stop - start)
        powers = x[:, None] ** np.arange(self.coefficients.shape[2])
        return np.asarray(np.einsum("njd,nd->nj", self.coefficients[piece], powers))

    def at_places(self, x: Array) -> Array:
        """Torques at places `x`, shape (n,) in [-1, 1], of every piece, as (k, 2, n) [N m]."""
        powers = x[:, None] ** np.arange(self.coefficients.shape[2])
        return np.asarray(self.coefficients @ powers.T)

    def integrate_squares(self) -> float:
        """Integral of tau^T tau over all pieces [(N m)^2 s]."""
        degree = self.coefficients.shape[2]
        total = np.arange(degree)[:, None] + np.arange(degree)
        moments = np.where(total % 2 == 0, 2 / (total + 1), 0.0)
        squares = np.einsum("kjd,de,kje->k", self.coefficients, moments, self.coefficients)
        return float(squares @ np.diff(self.breaks) / 2)

    def cut(self, start: float, stop: float) -> TorqueProfile:
        """The same torques from `start` to `stop` [s], those of the ends held beyond them."""
        near = 1e-12 * max(abs(start), abs(stop))
        inner = self.breaks[(self.breaks > start + near) & (self.breaks < stop - near)]
        new = np.array([start, *inner, stop])
        pieces = np.zeros((len(new) - 1, *self.coefficients.shape[1:]))
        for piece, (a, b) in zip(pieces, pairwise(new.tolist()), strict=True):
            middle = (a + b) / 2
            if not self.breaks[0] < middle < self.breaks[-1]:
                piece[:, 0] = self.at(np.array([middle]))[0]
                continue
            k = int(np.searchsorted(self.breaks, middle, side="right")) - 1
            first, last = self.breaks[k : k + 2].tolist()
            piece[:] = _restrict(self.coefficients[k], first, last, a, b)
        return TorqueProfile(new, pieces)

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
        """Profiles that each start at 0, one after the other."""
        breaks, start = [np.zeros(1)], 0.0
        for profile in profiles:
            breaks.append(start + profile.breaks[1:])
            start = float(breaks[-1][-1])
        blocks = [profile.coefficients for profile in profiles]
        longest = max(block.shape[2] for block in blocks)
        wide = [np.pad(block, ((0, 0), (0, 0), (0, longest - block.shape[2]))) for block in blocks]
        return TorqueProfile(np.concatenate(breaks), np.concatenate(wide))

    @staticmethod
    def join_rows(t: Array, tau: Array) -> TorqueProfile:
        """Linear torques between rows; two rows at one time are a step there.

        Parameters
        ----------
        t : (n,) [s]        never decreasing, and increasing somewhere
        tau : (n, 2) [N m]
        """
        pieces = np.flatnonzero(np.diff(t) > 0)
        middle, half = (tau[pieces] + tau[pieces + 1]) / 2, (tau[pieces + 1] - tau[pieces]) / 2
        breaks = np.append(t[pieces], t[-1])
        return TorqueProfile(breaks, np.stack([middle, half], axis=2))


def _restrict(coefficients: Array, start: float, stop: float, a: float, b: float) -> Array:
    """The same polynomials over a part [a, b] of [start, stop]."""
    if a == start and b == stop:
        return coefficients
    # x = shift + scale u, where u runs from -1 to 1 over the part.
    scale, shift = (b - a) / (stop - start), (a + b - start - stop) / (stop - start)
    result = np.zeros_like(coefficients)
    power = np.zeros(coefficients.shape[1])
    power[0] = 1.0
    for k in range(coefficients.shape[1]):
        result += coefficients[:, k : k + 1] * power
        power = shift * power + scale * np.append(0.0, power[:-1])
    return result


def read_torque_csv(path: str) -> TorqueProfile:
    """Read torques from a CSV file with the columns ``t,tau1,tau2`` (s, N m, N m).

    Torques are linear between rows; a repeated time is a step. Lines that begin with ``#`` are
    comments; see `read_notes`.

    Raises
    ------
    InputError  if the file cannot be read, a column is missing, a value is not a finite number, or
                the times do not start at 0 and increase
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            numbered = [
                (reader.line_num, row)
                for row in reader
                if any(map(str.strip, row)) and not row[0].lstrip().startswith("#")
            ]
    except OSError as error:
        raise InputError(str(path), "", f"cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(str(path), "", f"is not CSV: {error}") from None
    header = [cell.strip() for cell in numbered[0][1]] if numbered else []
    for column in COLUMNS:
        if column not in header:
            given = ",".join(header) or "an empty file"
            raise InputError(
                str(path), column, f"column is missing; {given} given, {','.join(COLUMNS)} needed"
            )
    where = [header.index(column) for column in COLUMNS]
    values = np.array([_read_row(path, line, row, where) for line, row in numbered[1:]])
    if len(values) < 2:
        raise InputError(str(path), "t", f"{len(values)} rows given; two or more are needed")
    t = values[:, 0]
    if t[0] != 0.0:
        raise InputError(str(path), "t", f"the first time is {t[0]:g}; it must be 0")
    steps = np.diff(t)
    if (steps < 0).any():
        at = int(np.argmax(steps < 0)) + 1
        raise InputError(str(path), "t", f"time goes back from {t[at - 1]:g} to {t[at]:g} s")
    if ((steps[1:] == 0) & (steps[:-1] == 0)).any():
        raise InputError(str(path), "t", "a time is given three times; twice makes a step")
    if t[-1] == 0.0:
        raise InputError(str(path), "t", "every time is 0; the torques must last")
    return TorqueProfile.join_rows(t, values[:, 1:])


def read_notes(path: str) -> dict[str, str]:
    """What comments ``# key = value`` of a CSV file say, by their keys.

    Raises
    ------
    InputError  if the file cannot be read
    """
    try:
        with open(path, encoding="utf-8-sig") as stream:
            comments = [line[1:].split("=", 1) for line in stream if line.startswith("#")]
    except OSError as error:
        raise InputError(str(path), "", f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(str(path), "", f"is not CSV: {error}") from None
    return {pair[0].strip(): pair[1].strip() for pair in comments if len(pair) == 2}


def _read_row(path: str, line: int, row: list[str], where: list[int]) -> list[float]:
    values = []
    for column, index in zip(COLUMNS, where, strict=True):
        text = row[index].strip() if index < len(row) else ""
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(str(path), column, f"{text!r} on line {line} is not a finite number")
        if abs(value) > MOST:
            problem = f"{text} on line {line} given; allowed are -{MOST:g} to {MOST:g}"
            raise InputError(str(path), column, problem)
        values.append(value)
    return values
