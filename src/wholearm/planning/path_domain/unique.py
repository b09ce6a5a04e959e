"""Whether contact forces along a curve are the only ones that are possible."""

from __future__ import annotations

import numpy as np

from ...common.errors import AmbiguityError
from ...geometry.curve import Curve, describe_pose
from ...mechanics.dynamics import Directions, reduced_inertia
from ...mechanics.uniqueness import describe_uniqueness, find_minors

LOOKS = 17
"""Places of a stretch without reversals at which contact forces are looked at."""


def require_unique(curve: Curve, least: float, phase: int) -> None:
    """Require contact forces to be the only ones along a curve.

    Parameters
    ----------
    curve : Curve
    least : float
        Least uniqueness margin (`mechanics.uniqueness`).
    phase : int
        Its number, for messages.

    Raises
    ------
    AmbiguityError
        If one is less. Where friction jams the curve this is left to `data.prepare`.
    """
    formation, segments = curve.formation, curve.segments
    if not formation.friction.any():
        return
    s = np.concatenate([np.linspace(own.start, own.stop, LOOKS) for own in segments])
    point = curve.evaluate(s)
    Xi = np.repeat([own.Xi for own in segments], LOOKS, axis=0)
    still = (formation.sliding_friction > 0) & (Xi == 0).all(axis=0)
    sticking = tuple(np.flatnonzero(still).tolist())
    ratio, names, row = find_minors(formation, point.kinematics, Xi, sticking).find_least()
    if ratio >= least:
        return
    sigma = np.repeat([own.sigma for own in segments], LOOKS, axis=0)
    if reduced_inertia(formation, point.kinematics, Directions(Xi, sigma)).min() > 0:
        text = describe_uniqueness(ratio, names, describe_pose(point.z[row]), least)
        raise AmbiguityError(f"phase {phase}: {text}")
