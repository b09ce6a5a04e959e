"""Inverse dynamics and limits along the curves of phases, at nodes and between them.

Coefficients of the limited values are evaluated at the nodes and at a few knots of every interval.
Polynomials through the knots give them where limits are checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, find_minima
from ...common.errors import InputError, JammingError, SolverError
from ...geometry.curve import Curve, describe_pose, directions_of
from ...mechanics.dynamics import apply, inverse, reduced_inertia
from ...mechanics.limits import CONE, PRESS, TORQUE, LimitSet, make_limits
from ...mechanics.path_limits import PathLimits, find_slack_rows, find_speed_cap, find_value_rows
from ...results.torque import TorqueProfile
from ..robust.robust_rows import COPIES, RobustLimits, evaluate_robust, repeat_limits, widen
from .path_motion import Elements, Grid, PathMotion, Profile

KNOTS = 13  # interpolation points where torques of a motion are not those through the knots
RATE_SAMPLES = 21  # samples of torque rates in each interval


class Sampling(NamedTuple):
    """Knots of coefficients and places of checks in an interval, from 0 to 1, with both ends."""

    knots: Array
    checks: Array


class Places(NamedTuple):
    """Coefficients of the limited values at n places of a curve."""

    values: Array  # (n, m, 5): coefficients of the limited values, of (1, s'', s'^2, s', lambda)
    rates: Array  # (n, 2): d theta / ds
    variations: Array  # (n, k, 1 + p, 5): as of `robust_rows`, or none of shape (n, 0)

    def pick(self, rows: Any) -> Places:
        """Return the places that `rows` indexes."""
        return Places(*(table[rows] for table in self))


class PhaseData(NamedTuple):
    """Limits and inverse dynamics of one phase, or several that are joined, on a grid."""

    curve: Curve  # the first one's where phases are joined
    epsilon: float  # [N]
    limits: LimitSet  # those that are rows of the NLP: of forces and torques
    speeds: LimitSet  # those of joint speeds alone, which bound b
    grid: Grid
    nodes: Places  # at the nodes
    sampling: Sampling
    checks: Places  # at the checks of every solid interval, interval by interval
    robust: RobustLimits | None = None  # robust force limits, if there are ranges

    @property
    def torque_limit(self) -> Array:
        """Torque limits, shape (2,) [N m]."""
        return self.limits.high[self.limits.of(TORQUE)]

    @property
    def of_tau(self) -> Array:
        """Coefficients of the torques at the nodes, shape (N + 1, 2, 5) [N m]."""
        return self.nodes.values[:, self.limits.of(TORQUE)]

    def find_limits(self, places: Places) -> PathLimits:
        """The limits at places, with the internal force."""
        return PathLimits(find_slack_rows(self.limits, places.values), self.largest_b(places))

    def evaluate(self, places: Places, profile: Profile) -> Array:
        """The limited values, shape (n, m) [N, N m]."""
        values = apply(places.values, *profile)
        if self.robust is not None:
            rows, worst = self.limits.of(PRESS, CONE), evaluate_robust(places.variations, profile)
            values[:, rows] = np.repeat(worst, COPIES, axis=1)
        return values

    def slack(self, places: Places, profile: Profile, margin: float = 0.0) -> Array:
        """Slack of each side, less a `margin` of normal forces, shape (n, n_sides) [N, N m]."""
        values = self.evaluate(places, profile)
        values[:, self.limits.of(PRESS)] -= margin
        return self.limits.find_slack(values)

    def largest_b(self, places: Places) -> Array:
        """Largest b by the joints' speed limits, shape (n,) [m^2/s^2]."""
        return find_speed_cap(self.speeds, places.rates)

    def interpolate(self, profile: Profile, fractions: Array) -> Profile:
        """The profile at `fractions` of every solid interval, interval by interval."""
        return Elements(self.grid, profile).at(fractions)

    def find_violations(self, profile: Profile, margin: float) -> tuple[Array, Array]:
        """Violations in each solid interval, (n_solid, n_sides) [N, N m]; of b, relatively."""
        samples = self.interpolate(profile, self.sampling.checks)
        speed_slack = 1 - samples.b / self.largest_b(self.checks)
        slack = np.column_stack([self.slack(self.checks, samples, margin), speed_slack])
        least = find_minima(slack.reshape(-1, len(self.sampling.checks), slack.shape[1]))
        violations = np.maximum(-least, 0.0)
        return violations[:, :-1], violations[:, -1]

    def move_to_nodes(self, values: Array) -> Array:
        """The larger value of the two solid intervals beside each node, shape (N + 1, ...)."""
        at_nodes, k = np.zeros((len(self.grid.s), *values.shape[1:])), self.grid.nonempty
        at_nodes[k] = values
        at_nodes[k + 1] = np.maximum(at_nodes[k + 1], values)
        return at_nodes


def prepare(
    curve: Curve, epsilon: float, grid: Grid, phase: int, robust: RobustLimits | None = None
) -> PhaseData:
    """Evaluate inverse dynamics and limits, with `robust` also robust ones, along a curve.

    Raises
    ------
    InputError    if contacts are linearly dependent anywhere
    JammingError  if friction makes the reduced inertia vanish or negative anywhere
    """
    nonempty = grid.nonempty
    sampling = choose_sampling(len(grid.s))
    inner_knots = sampling.knots[1:-1]
    s_knots = (grid.s[nonempty, None] + inner_knots * grid.steps[nonempty, None]).ravel()
    s = np.concatenate([grid.s, s_knots])
    segment = np.concatenate([grid.segment, np.repeat(grid.segment[nonempty], len(inner_knots))])
    point = curve.evaluate(s)
    formation, directions = curve.formation, directions_of(curve, segment)
    inertia = reduced_inertia(formation, point.kinematics, directions)
    if not np.isfinite(inertia).all():
        place = describe_pose(point.z[int(np.isfinite(inertia).argmin())])
        text = f"{' '.join(formation.names)} depend on each other at {place}"
        raise InputError("", f"phases[{phase}].contacts", text)
    if inertia.min() <= 0:
        worst = int(inertia.argmin())
        raise JammingError(
            f"phase {phase}: {' '.join(formation.names)} jams at {describe_pose(point.z[worst])}: "
            f"friction makes the reduced inertia {inertia[worst]:.3g} of its frictionless value"
        )
    forces, rates = inverse(formation, point, directions), point.z_s[:, 3:]
    limits, speeds = make_limits(formation, epsilon).split(2)
    variations = np.zeros((len(s), 0))
    if robust is not None:
        variations = robust.find_variations(formation, point, directions, forces, epsilon)
    all_places = Places(find_value_rows(limits, forces, rates), rates, variations)
    knot_rows = len(grid.s) + np.arange(len(s_knots)).reshape(len(nonempty), -1)
    rows = np.hstack([nonempty[:, None], knot_rows, nonempty[:, None] + 1]).ravel()

    # Powers on [-1, 1]: on [0, 1] thirteen knots would cost nine digits.
    to_checks, to_knots = (
        (2 * places[:, None] - 1) ** np.arange(len(sampling.knots))
        for places in (sampling.checks, sampling.knots)
    )
    matrix = to_checks @ np.linalg.inv(to_knots)

    def interpolate(values: Array) -> Array:
        table = values.reshape(len(nonempty), len(sampling.knots), -1)
        return (matrix @ table).reshape(len(nonempty) * len(sampling.checks), *values.shape[1:])

    nodes = all_places.pick(slice(None, len(grid.s)))
    checks = Places(*map(interpolate, all_places.pick(rows)))
    if robust is not None:
        owners = np.repeat(grid.segment[nonempty], len(sampling.checks))
        positions = (grid.s, grid.segment), (interpolate(s[rows]), owners)
        nodes, checks = (
            places._replace(
                values=widen(limits, places.values, places.variations, robust.pick_signs(*where))
            )
            for places, where in zip((nodes, checks), positions, strict=True)
        )
        limits = repeat_limits(limits)
    return PhaseData(curve, epsilon, limits, speeds, grid, nodes, sampling, checks, robust)


def join(parts: Sequence[PhaseData]) -> PhaseData:
    """Phases one after the other, each with as many nodes and the same rows of limits.

    Where two meet, as at a reversal, the grid has an interval of length zero.
    """
    grids, start, segment = list[Grid](), 0.0, 0
    for grid in (part.grid for part in parts):
        grids.append(Grid(start + grid.s, segment + grid.segment, grid.maps))
        start, segment = grids[-1].s[-1], grids[-1].segment[-1] + 1

    def stack(tables: Iterable[Sequence[NDArray[Any]]]) -> list[NDArray[Any]]:
        return [*map(np.concatenate, zip(*tables, strict=True))]

    return parts[0]._replace(
        grid=Grid(*stack(grids)),
        nodes=Places(*stack(part.nodes for part in parts)),
        checks=Places(*stack(part.checks for part in parts)),
    )


def choose_sampling(nodes: int) -> Sampling:
    """More knots and checks where intervals are long.

    Checks are at cosines of even angles: near rest the speed is proportional to the root of s.
    """
    knots, checks = (5, 25) if nodes > 64 else (9, 33)
    angles = np.linspace(0.0, np.pi, checks)
    return Sampling(np.linspace(0.0, 1.0, knots), (1 - np.cos(angles)) / 2)


def fit_torque(data: PhaseData, motion: PathMotion) -> TorqueProfile:
    """Torque of a motion, one polynomial in time per interval.

    Through as many checks as there are knots, or through Chebyshev points in time if that misses
    the torque at the other checks. SolverError if the motion all but stops in an interval.
    """
    spans, count = motion.durations(data.sampling.checks), len(data.sampling.knots)
    if motion.stalls or not (np.diff(spans, axis=1) > 0).all():
        raise SolverError("the motion all but stops between two nodes; plan with more intervals")
    torque, misfit = _fit(data, motion.profile, spans, count)
    if np.abs(misfit / data.torque_limit).max() > 5e-7:  # largest relative error
        torque = TorqueProfile.fit(torque.breaks, lambda t: motion.evaluate(t).tau, KNOTS - 1)
    return torque


def find_torques(
    data: PhaseData, profile: Profile, motions: Sequence[PathMotion]
) -> tuple[Array, Array]:
    """Torques and their rates, (n_solid, 2, LOOKS) [N m, N m/s], at evenly spaced times."""
    spans = np.concatenate([motion.durations(data.sampling.checks) for motion in motions])
    torque, _ = _fit(data, profile, spans, KNOTS)
    samples = np.linspace(-1, 1, RATE_SAMPLES)
    return torque.at_places(samples), torque.slopes.at_places(samples)


def _fit(
    data: PhaseData, profile: Profile, spans: Array, min_count: int
) -> tuple[TorqueProfile, Array]:
    """Polynomials in time through torques at `min_count` checks or more; all errors, (n, m, 2).

    The checks of each interval are `spans` after its start, (n, m) [s].
    """
    of_tau = data.checks.values[:, data.limits.of(TORQUE)]
    tau = apply(of_tau, *data.interpolate(profile, data.sampling.checks))
    tau, step = tau.reshape(*spans.shape, 2), (spans.shape[1] - 1) // (min_count - 1)
    x = 2 * spans / spans[:, -1:] - 1
    powers = x[..., None] ** np.arange(len(x[0, ::step]))
    coefficients = np.linalg.solve(powers[:, ::step], tau[:, ::step])
    breaks = np.append(0.0, np.cumsum(spans[:, -1]))
    torque = TorqueProfile(breaks, np.ascontiguousarray(coefficients.transpose(0, 2, 1)))
    return torque, powers @ coefficients - tau
