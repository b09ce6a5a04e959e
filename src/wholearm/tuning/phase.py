"""The 10 % procedure on one phase.

From the quasistatic torques at its start the acting finger's torque is raised by 10 % while the
object does not slide to the end, then further for speed; when a contact is lost, or presses with
less than epsilon, it is lowered by 10 %. So that the phase ends at rest one step is added: the
acting torque falls, below the quasistatic one, when what is left of the way just stops the object.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from ..common.arrays import Array
from ..verification.verdict import REST_SPEED
from .trial import Bench, Outcome, Sight

STEP = 1.1
"""Ratio of a step."""
_MOST = 80
"""Most raises."""
_BRAKES = 12
"""Most steps below the quasistatic torque at which braking is tried."""
_HALVINGS = 40
"""Most trials for the time of a brake."""
_BAND = (0.3, 0.8)
"""Least and largest speed to be left at the end, over what passes for rest: with less the object
would stop short of it by rounding."""


@dataclass(frozen=True)
class PhaseTuning:
    """What tuning one phase has come to.

    Attributes
    ----------
    number : int
    finger : int
        The acting finger, 1 or 2.
    quasistatic : ndarray, shape (2,), [N m]
        Torques that it starts from.
    raises : int
        How often the acting torque is raised by 10 %.
    brake : int
        How often it is lowered from the quasistatic one in the end.
    steps : tuple of (float, ndarray)
        Torques, shape (2,) [N m], each from its time in the phase on [s]; empty if there are none.
    outcome : Outcome
        Of these, or of the trial that was the last.
    simulations : int
    reason : str
        Why there are none.
    free : float
        How far a simulation of these from rest that finds its contacts itself ends from theirs,
        over the scene's length and in rad; NaN where there are none.
    """

    number: int
    finger: int
    quasistatic: Array
    raises: int
    brake: int
    steps: tuple[tuple[float, Array], ...]
    outcome: Outcome
    simulations: int
    reason: str = ""
    free: float = math.nan


def tune_phase(bench: Bench, number: int, tau: Array, finger: int, share: float) -> PhaseTuning:
    """Tune a phase from quasistatic torques `tau`, shape (2,) [N m], by those of one finger.

    Parameters
    ----------
    bench : Bench
    number : int
        Of the phase.
    tau : ndarray, shape (2,), [N m]
    finger : int
        1 or 2.
    share : float
        Which of the raises between the first that reaches the end, 0, and the last that keeps every
        contact, 1, is taken.
    """

    def scale(power: int) -> Array:
        scaled = tau.copy()
        scaled[finger - 1] *= STEP**power
        return scaled

    first, last, seen = _raise(bench, scale, finger)
    if first is None:
        return PhaseTuning(
            number, finger, tau, last, 0, (), seen, bench.simulations, _explain(seen, last)
        )
    raises = first + round(share * (last - first))
    for power in (*range(raises, first - 1, -1), *range(raises + 1, last + 1)):
        found = _brake(bench, scale, power)
        if found is not None:
            brake, steps, outcome = found
            free = bench.follow_free(steps, outcome)
            count = bench.simulations
            return PhaseTuning(number, finger, tau, power, brake, steps, outcome, count, free=free)
    text = f"reaches the end with {first} raises or more, but no step of its torque stops it there"
    return PhaseTuning(number, finger, tau, first, 0, (), seen, bench.simulations, text)


Scale = Callable[[int], Array]
"""Torques with the acting one raised by 10 % so many times, shape (2,) [N m]."""


def _raise(bench: Bench, scale: Scale, finger: int) -> tuple[int | None, int, Outcome]:
    """The first and the last number of raises with which the end is reached, and the last trial.

    None for the first where there is none; the last is then that of the last trial.
    """
    epsilon, limit = bench.problem.epsilon, bench.problem.scene.torque_limit[finger - 1]
    first, last, seen = None, 0, bench.try_out([(0.0, scale(0))])
    for power in range(_MOST):
        if abs(scale(power)[finger - 1]) > limit:
            break
        tried = seen if power == 0 else bench.try_out([(0.0, scale(power))])
        holds = tried.sight is not Sight.LOSES and tried.least >= epsilon
        if not holds and first is not None:
            break
        last, seen = power, tried
        if tried.sight is Sight.REACHES and holds:
            first = power if first is None else first
        elif tried.sight is Sight.LOSES:
            break
    return first, last, seen


def _explain(seen: Outcome, raises: int) -> str:
    """Why no number of raises reaches the end."""
    after = f"after {raises} raises of 10 %"
    if seen.sight is Sight.LOSES:
        return f"{after}: {seen.text}"
    return f"{after}, at the torque limit, the object {seen.sight.value}: {seen.text}"


def _brake(
    bench: Bench, scale: Scale, raises: int
) -> tuple[int, tuple[tuple[float, Array], ...], Outcome] | None:
    """The least step below the quasistatic torque that stops the object at the end; None if none.

    The earlier it comes the shorter of the end the object stops: its time is bisected.
    """
    scene = bench.problem.scene
    least, slow = (share * REST_SPEED * scene.scales.speed for share in _BAND)
    free = bench.try_out([(0.0, scale(raises))])
    if least <= free.speed <= slow:
        return 0, ((0.0, scale(raises)),), free
    for brake in range(_BRAKES):
        low, high = 0.0, free.time
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            steps = ((0.0, scale(raises)), (middle, scale(-brake)))
            seen = bench.try_out(steps)
            if seen.sight is Sight.LOSES:
                break
            if seen.sight is not Sight.REACHES or seen.speed < least:
                low = middle
            elif seen.least < bench.problem.epsilon:
                break
            elif seen.speed > slow:
                high = middle
            else:
                return brake, steps, seen
    return None
