"""What phases give the planner: forces along their curves, at nodes and between them.

Forces are evaluated at the nodes and at a few places of every interval, the knots. They are smooth
there, so polynomials through the knots give them at all places where limits are checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, find_minima
from ...common.errors import InputError, JammingError
from ...common.shortfalls import Parameter
from ...geometry.curve import Curve, describe_pose
from ...mechanics.dynamics import PathForces, inverse, reduced_inertia
from ...mechanics.limits import CONE, PRESS, SPEED, TORQUE, LimitSet, make_limits
from ..robust.robust_rows import Spread, spread_limits
from .elements import Elements, Grid, Profile
from .path_motion import directions_of


class Sampling(NamedTuple):
    """Where in an interval forces are evaluated and limits looked at, its ends included."""

    knots: Array
    checks: Array


class Places(NamedTuple):
    """Forces and rates of the joints, d theta / ds with shape (n, 2), at n places of a curve.

    And what ranges change of the force limits there (`robust.rows`), with none in it if there are
    no ranges.
    """

    forces: PathForces
    rates: Array
    swings: Array

    def pick(self, rows: Any) -> Places:
        """Return the places that `rows` indexes."""
        forces = PathForces(*(part[rows] for part in self.forces))
        return Places(forces, self.rates[rows], self.swings[rows])

    def map(self, change: Callable[[Array], Array]) -> Places:
        """The same with every table changed."""
        forces = PathForces(*map(change, self.forces))
        return Places(forces, change(self.rates), change(self.swings))


class LimitTerms(NamedTuple):
    """What limits are of, constant + a s'' + b s'^2 + squeeze lambda + speed s', (n, m) each."""

    constant: Array
    a: Array
    b: Array
    squeeze: Array
    speed: Array


class PhaseData(NamedTuple):
    """What one phase, or several that are joined, gives the NLP."""

    curve: Curve  # the first one's where phases are joined
    epsilon: float  # [N]
    limits: LimitSet  # those that are rows of the NLP: of forces and torques
    speeds: LimitSet  # those of joint speeds alone, which bound b
    grid: Grid
    nodes: Places  # at the nodes
    sampling: Sampling
    knots: Places  # at the knots of every solid interval, interval by interval
    checks: Places  # at the checks of every solid interval, interval by interval
    rate_limit: Array  # (2,) [N m/s]: of torques, infinite where they may step
    spread: Spread | None = None  # what ranges make of the force limits, if there are any

    @property
    def nonempty(self) -> NDArray[np.int64]:
        """The intervals that have a length."""
        return self.grid.nonempty

    @property
    def torque_limit(self) -> Array:
        """Torque limits, shape (2,) [N m]."""
        return self.limits.high[self.limits.of(TORQUE)]

    @property
    def spans(self) -> Array:
        """What is much for each side of the limits, shape (n_sides,)."""
        return self.limits.scales[self.limits.sides[0]]

    def find_terms(self) -> LimitTerms:
        """What limits are of at the nodes."""
        of_c, of_tau, of_rates = (part.T for part in self.limits.columns)
        forces = self.nodes.forces
        return LimitTerms(
            forces.C0 @ of_c + forces.T0 @ of_tau,
            forces.Ca @ of_c + forces.Ta @ of_tau,
            forces.Cb @ of_c + forces.Tb @ of_tau,
            forces.Cl @ of_c + forces.Tl @ of_tau,
            forces.Cv @ of_c + forces.Tv @ of_tau + self.nodes.rates @ of_rates,
        )

    def evaluate(self, places: Places, profile: Profile) -> Array:
        """What the limits are of, shape (n, m) [N, N m]."""
        of_c, of_tau, of_rates = (part.T for part in self.limits.columns)
        values = places.forces.c(*profile) @ of_c + places.forces.tau(*profile) @ of_tau
        if of_rates.any():
            values += places.rates * np.sqrt(profile.b)[:, None] @ of_rates
        if self.spread is not None:
            least = self.spread.evaluate(places.forces, places.swings, profile)
            rows = self.limits.of(PRESS, CONE)
            values[:, rows] = np.repeat(least, len(rows) // least.shape[1], axis=1)
        return np.asarray(values)

    def slack(self, places: Places, profile: Profile, margin: float = 0.0) -> Array:
        """How far each side of the limits is from being missed, shape (n, n_sides) [N, N m].

        Less `margin` for normal forces.
        """
        values = self.evaluate(places, profile)
        values[:, self.limits.of(PRESS)] -= margin
        return self.limits.find_slack(values)

    def largest_b(self, places: Places, spared: Parameter | None = None) -> Array:
        """Largest b that the joints' speed limits allow, shape (n,) [m^2/s^2].

        Without the one that the parameter `spared` sets, if one is given.
        """
        largest = np.full(len(places.rates), np.inf)
        for limit in self.speeds.limits:
            if spared is None or limit.parameter.key != spared.key:
                rates = np.abs(places.rates @ limit.rows[0, -2:])
                # A joint that stands still has no limit, but dividing by zero would warn.
                rates = np.maximum(rates, np.finfo(float).tiny ** 0.25)
                largest = np.minimum(largest, (limit.high[0] / rates) ** 2)
        return largest

    def relative_rates(self, places: Places, parameter: Parameter) -> Array:
        """Rate of a joint over its speed limit, shape (n,) [s/m]; zero for another parameter."""
        rates = np.zeros(len(places.rates))
        for limit in self.speeds.limits:
            if limit.parameter.key == parameter.key:
                rates = places.rates @ limit.rows[0, -2:] / limit.high[0]
        return rates

    def interpolate(self, profile: Profile, fractions: Array) -> Profile:
        """The profile at `fractions` of every solid interval, interval by interval."""
        return Elements(self.grid, profile).at(fractions)

    def misses(self, profile: Profile, margin: float) -> tuple[Array, Array, Array]:
        """What limits miss inside each solid interval, shape (n_solid, n_sides) [N, N m].

        How far b is beyond what the speed limits allow, shape (n_solid,), relative. And how far
        limits are from being missed there.
        """
        here = self.interpolate(profile, self.sampling.checks)
        speed_slack = 1 - here.b / self.largest_b(self.checks)
        slack = np.column_stack([self.slack(self.checks, here, margin), speed_slack])
        least = find_minima(slack.reshape(len(self.nonempty), len(self.sampling.checks), -1))
        short, spare = np.maximum(-least, 0.0), np.maximum(least, 0.0)
        return short[:, :-1], short[:, -1], spare[:, :-1]

    def slack_at_neighbours(self, profile: Profile, margin: float, short: Array) -> Array:
        """The lesser slack of the two nodes of each solid interval, shape (n_solid, n_sides).

        Zero where nothing is `short` in the interval.
        """
        slack = self.slack(self.nodes, profile, margin)
        least = np.minimum(slack[self.nonempty], slack[self.nonempty + 1])
        return np.where(short > 0, np.maximum(least, 0.0), 0.0)

    def spread_to_nodes(self, inside: Array, least: float = 0.0) -> Array:
        """The larger value of the two solid intervals beside each node, shape (N + 1, ...)."""
        table = np.full((len(self.grid.s), *inside.shape[1:]), least)
        table[self.nonempty] = inside
        table[self.nonempty + 1] = np.maximum(table[self.nonempty + 1], inside)
        return table


def prepare(
    curve: Curve,
    epsilon: float,
    grid: Grid,
    phase: int,
    spread: Spread | None = None,
) -> PhaseData:
    """Evaluate a curve's forces at the nodes of a grid and between them.

    With a `spread`, force limits are those for all ranges.

    Raises
    ------
    InputError    if contacts depend on each other anywhere
    JammingError  if friction makes the reduced inertia vanish or turn negative anywhere
    """
    nonempty = grid.nonempty
    sampling = choose_sampling(len(grid.s))
    inner = sampling.knots[1:-1]
    between = (grid.s[nonempty, None] + inner * grid.steps[nonempty, None]).ravel()
    s = np.concatenate([grid.s, between])
    segment = np.concatenate([grid.segment, np.repeat(grid.segment[nonempty], len(inner))])
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
    forces = inverse(formation, *point[:3], directions, point.kinematics)
    swings = np.zeros((len(s), 0))
    if spread is not None:
        swings = spread.find_swings(formation, point, directions, forces, epsilon)
    every = Places(forces, point.z_s[:, 3:], swings)
    own = len(grid.s) + np.arange(len(between)).reshape(len(nonempty), -1)
    order = np.hstack([nonempty[:, None], own, nonempty[:, None] + 1])
    knots = every.pick(order.ravel())

    powers = np.arange(len(sampling.knots))
    # Powers on [-1, 1]: on [0, 1] thirteen knots would cost nine digits.
    checks_x, knots_x = 2 * sampling.checks - 1, 2 * sampling.knots - 1
    through = checks_x[:, None] ** powers @ np.linalg.inv(knots_x[:, None] ** powers)

    def interpolate(values: Array) -> Array:
        table = values.reshape(len(nonempty), len(sampling.knots), -1)
        count = len(nonempty) * len(sampling.checks)
        return (through @ table).reshape(count, *values.shape[1:])

    nodes, checks = every.pick(slice(None, len(grid.s))), knots.map(interpolate)
    limits = make_limits(formation, epsilon)
    if spread is not None:
        limits = spread_limits(limits)
        steps = sampling.checks * grid.steps[nonempty, None]
        inside = (grid.s[nonempty, None] + steps).ravel()
        owners = np.repeat(grid.segment[nonempty], len(sampling.checks))
        nodes = _widen(spread, nodes, grid.s, grid.segment)
        checks = _widen(spread, checks, inside, owners)
    kept = limits.without(SPEED), limits.only(SPEED)
    rates = formation.scene.torque_rate_limit
    return PhaseData(curve, epsilon, *kept, grid, nodes, sampling, knots, checks, rates, spread)


def _widen(spread: Spread, places: Places, s: Array, segment: NDArray[np.int64]) -> Places:
    """Places with forces for the limits within ranges too."""
    signs = spread.pick_signs(s, segment)
    return places._replace(forces=spread.extend(places.forces, places.swings, signs))


def join(parts: Sequence[PhaseData]) -> PhaseData:
    """Put phases one after the other, each with as many nodes and the same rows of limits.

    Where two meet, the grid has an interval of length zero, as where a direction reverses.
    """
    if len(parts) == 1:
        return parts[0]
    if any(not np.array_equal(part.limits.rows, parts[0].limits.rows) for part in parts):
        raise ValueError("phases with different rows of limits cannot be joined")
    starts = np.cumsum([0.0, *(part.grid.s[-1] for part in parts)])
    segments = np.cumsum([0, *(part.grid.segment[-1] + 1 for part in parts)])

    def chain(arrays: Iterable[NDArray[Any]], firsts: NDArray[Any]) -> Any:
        pairs = zip(arrays, firsts[:-1], strict=True)
        return np.concatenate([array + first for array, first in pairs])

    def stack(places: Sequence[Places]) -> Places:
        columns = zip(*(own.forces for own in places), strict=True)
        forces = PathForces(*(np.concatenate(column) for column in columns))
        tables = ([own.rates for own in places], [own.swings for own in places])
        return Places(forces, *map(np.concatenate, tables))

    return parts[0]._replace(
        grid=Grid(
            chain((part.grid.s for part in parts), starts),
            chain((part.grid.segment for part in parts), segments),
            (parts[0].grid.rests[0], parts[-1].grid.rests[1]),
            parts[0].grid.held,
            _join_bends([part.grid for part in parts]),
        ),
        nodes=stack([part.nodes for part in parts]),
        knots=stack([part.knots for part in parts]),
        checks=stack([part.checks for part in parts]),
    )


def _join_bends(grids: Sequence[Grid]) -> Array | None:
    """Bends of the elements of grids one after the other."""
    bends = [grid.bends for grid in grids if grid.bends is not None]
    return np.concatenate(bends) if bends else None


def cut(parts: Sequence[PhaseData], profile: Profile) -> list[Profile]:
    """Return the profile of each of several joined phases."""
    ends = np.cumsum([len(part.grid.s) for part in parts])[:-1]
    columns = (np.split(values, ends) for values in profile)
    return [Profile(*own) for own in zip(*columns, strict=True)]


def choose_sampling(nodes: int) -> Sampling:
    """Choose more knots and checks where intervals are long.

    Looks are as the cosine of evenly spaced angles: near rest the speed, and with it viscous
    friction, goes with the root of the way.
    """
    knots, checks = (5, 25) if nodes > 64 else (9, 33)
    angles = np.linspace(0.0, np.pi, checks)
    return Sampling(np.linspace(0.0, 1.0, knots), (1 - np.cos(angles)) / 2)
