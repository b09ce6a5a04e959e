"""Initial guesses along curves (b a parabola in s, internal force amid its range), and units."""

from __future__ import annotations

import numpy as np

from ...common.arrays import Array
from ...mechanics.dynamics import A, V
from .elements import Profile
from .path_data import PhaseData
from .path_nlp import Units
from .rate_terms import exceeds_rates

_SLOW = -12  # height of the slowest guess over that of a fall, as a power of two
_QUICK = 30.0  # largest b of a guess, over that which the torque limits alone allow
_FIRM = 40.0  # largest range of lambda in a guess, over the scene's force or its least value
_LIGHT = 0.5  # least unit of force, over the scene's


def guess(data: PhaseData, time_weight: float = 0.0) -> tuple[Profile, Units]:
    """A guess with b as high as limits allow, by bisection.

    Where limits forbid even the slowest one, it is as quick as a fall: in units of a slow one the
    regularization would weigh too much.
    """
    b_max = data.largest_b(data.nodes)
    fall = _fall(data)

    def possible(height: float) -> bool:
        low, high = find_internal_force_range(data, height)
        a, b = _parabola(data, height)
        kept = bool(((low <= high) & (low < np.inf)).all() and (b <= b_max).all())
        return kept and not exceeds_rates(data, Profile(a, b, find_middle(data, low, high)[1]))

    # Bisection over heights from 2^-12 to 2^8 times that of a fall over this length.
    low_power, high_power = float(_SLOW), 8.0
    for _ in range(7):
        power = (low_power + high_power) / 2
        if possible(fall * 2**power):
            low_power = power
        else:
            high_power = power
    none = low_power == _SLOW
    return _guess_at(data, 0.7 * fall * (1.0 if none else 2**low_power), time_weight)


def guess_slowly(data: PhaseData) -> tuple[Profile, Units]:
    """A slow guess, whatever the limits."""
    return _guess_at(data, 0.7 * _fall(data) * 2.0**_SLOW)


def _fall(data: PhaseData) -> float:
    """The b of a fall over the length of the curve, or of what joints may do [m^2/s^2]."""
    length, forces = float(data.grid.s[-1]), data.nodes.forces
    fall = 2 * data.curve.formation.scene.scales.acceleration * length

    def usual(coefficients: Array) -> float:
        """Value at which this coefficient alone takes a joint to its torque limit."""
        return 1 / max(float((np.abs(coefficients) / data.torque_limit).max(axis=1).mean()), 1e-100)

    # The upper median; NumPy's takes 10 ms to import what it needs.
    b_max, middle = data.largest_b(data.nodes), len(data.grid.s) // 2
    median = float(np.partition(b_max, middle)[middle])
    inertia, drag = 2 * length * usual(forces.of_tau[..., A]), usual(forces.of_tau[..., V]) ** 2
    return min(fall, _QUICK * min(inertia, drag, median))


def _parabola(data: PhaseData, height: float) -> tuple[Array, Array]:
    """The a and b of a parabola in s of this height; its power 4/3 where a starts at zero."""
    length = data.grid.s[-1]
    x = data.grid.s / length
    if data.grid.held:
        arch = np.maximum(4 * x * (1 - x), 0.0)
        slope = 8 / 3 * (1 - 2 * x) / length
        return height * slope * np.cbrt(arch), height * arch * np.cbrt(arch)
    return height * 2 * (1 - 2 * x) / length, height * 4 * x * (1 - x)


def find_internal_force_range(data: PhaseData, height: float) -> tuple[Array, Array]:
    """Least and largest internal force that limits allow at each node."""
    return data.find_limits(data.nodes).find_internal_force_range(*_parabola(data, height))


def find_middle(data: PhaseData, low: Array, high: Array) -> tuple[Array, Array]:
    """The internal force amid its range, and amid at most `_FIRM` of it; zero without a range."""
    finite, force = np.isfinite(low + high) & (low <= high), data.curve.formation.scene.scales.force
    near = np.minimum(high, low + _FIRM * np.maximum(force, np.abs(low)))
    whole, part = (np.where(finite, (low + end) / 2, 0.0) for end in (high, near))
    return whole, part


def _guess_at(data: PhaseData, height: float, time_weight: float = 0.0) -> tuple[Profile, Units]:
    whole, middle = find_middle(data, *find_internal_force_range(data, height))
    length, weight = float(data.grid.s[-1]), data.curve.formation.scene.scales.force
    duration = np.pi / 2 * length / np.sqrt(height)
    force = max(_LIGHT * weight, data.epsilon, float(np.abs(middle).mean()))
    profile, torque = Profile(*_parabola(data, height), middle), data.torque_limit
    squares = np.minimum(np.abs(data.nodes.forces.tau(*profile)), torque) ** 2
    power = time_weight + float(squares.sum(axis=1).mean())
    most = max(force, float(np.abs(whole).mean()))
    return profile, Units(length, 0.6 * duration, force, torque, power, most)
