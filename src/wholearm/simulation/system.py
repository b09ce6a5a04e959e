"""Equations of motion of rigid bodies with contact pairs, and compiled integration steps.

The motion is M z'' = f + S tau - B z' - friction + A^T c_n + A_t^T c_t with a constant diagonal M.
A pair of features has a gap C(z), whose gradient is its row of A, and a slip coordinate s(z), whose
gradient is its row of A_t: how far the features have slid over each other while they touch.

A `Structure` holds symbolic expressions, compiled once; a `System` adds the numbers of one scene.
`build_system` includes all pairs of features of object and hand (`elemental`), and pairs of links,
such as ``tip1-back2``: tip 1 and the far side of link 2.

The links slide on each other without friction, as no coefficient is given for them. Tolerances of
the simulator are relative to scales of the scene (`Scene.scales`).

**Steps** with given contact modes are compiled once for all bodies of a structure. P holds the
constraint rows of a mode: gaps of closed contacts, slip coordinates of sticking contacts, and
coordinates held by dry friction. G equals P, but rows of sliding contacts include their friction:

    M z'' = f + S tau - B z' - D sigma + G^T c,    P z'' + P' z' = 0,    c = [c_n; f].

Contacts that stick together, such as the vertices of a flush edge, have one friction force. Only
this sum is determined; it is divided in proportion to c_n, which does not affect the motion. A step
ends with a projection of z and z' onto the constraints, in the metric M.

Steps are explicit, of order 8: the pair 8(5,3) of Dormand and Prince, with the coefficients of
DOP853 (E. Hairer, S. P. Norsett and G. Wanner, "Solving Ordinary Differential Equations I", 2nd
edition, section II.5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Batch, bind
from ..contacts.contact_limits import FINGERS_TOUCH
from ..contacts.elemental import ContactPair, Link, place_bodies
from ..scene.model import Scales, Scene

ROUNDING_FORCE = 1e-9  # shortfall of a force, torque or friction margin due to rounding
ARRIVAL = 3e-5  # largest distance to the end of a phase that counts as arrival
REST_SPEED = 2e-4  # largest speed that counts as rest at the end of a phase
ZERO_SPEED = 1e-9  # sliding speed that counts as zero: its sign is an integration error
EVENT_DELAY = 2e-5  # largest shift of an event by rounding; modes are evaluated after this delay
REST_WINDOW = 2e-3  # longest rest before a torque break: too short for contacts to open
FIRST_STEP = 2e-2  # first trial step from rest
SHORTEST_STEP = 1e-13  # smallest step, relative to the scene's time and the elapsed time
ZERO_ACCEL = 1e-10  # largest acceleration that counts as rounding


class ContactRows(NamedTuple):
    """Constraint rows of pairs at one state: A z' = 0 if closed, A_t z' = 0 if stuck."""

    A: Array  # A, A_t (m, n):
    A_t: Array
    A_dot_v: Array  # A_dot_v, A_t_dot_v (m,): A' z' and A_t' z'
    A_t_dot_v: Array
    slip: Array  # (m,) [m]: slip coordinates


@dataclass(frozen=True, eq=False)
class Structure:
    """Symbolic coordinates and contact pairs of bodies of any size and mass."""

    z: Expression  # (n,)
    geometry: Expression  # (g,): parameters of gaps and slip coordinates
    pairs: tuple[ContactPair, ...]
    driven: tuple[int, ...]  # coordinates of the two motors; empty without motors
    angular: tuple[bool, ...]  # whether each coordinate is an angle

    def build_rows(self, indices: Sequence[int], v: Expression) -> tuple[Expression, ...]:
        """Gaps, slips, A, A_t, A' v and A_t' v of some pairs, as expressions of z and v."""
        parts: list[Expression] = []
        for values in ([self.pairs[k].gap for k in indices], [self.pairs[k].slip for k in indices]):
            column = ca.vertcat(ca.SX(0, 1), *values)
            rows = ca.jacobian(column, self.z)
            parts.append((column, rows, ca.jtimes(rows @ v, self.z, v)))
        (gap, A, A_dot_v), (slip, A_t, A_t_dot_v) = parts
        return gap, slip, A, A_t, A_dot_v, A_t_dot_v

    @cached_property
    def gaps(self) -> Batch:
        """Function (z, geometry) -> gaps and ranges of all pairs, shape (N, 2)."""
        gaps = ca.vertcat(ca.SX(0, 1), *(pair.gap for pair in self.pairs))
        range_minima = [ca.mmin(ca.vertcat(1e9, *pair.ranges)) for pair in self.pairs]
        columns = ca.cse(ca.densify(ca.horzcat(gaps, ca.vertcat(ca.SX(0, 1), *range_minima))))
        return Batch(ca.Function("gaps", [self.z, self.geometry], [columns]))


@lru_cache(maxsize=256)
def _build_rows(structure: Structure, indices: tuple[int, ...]) -> Batch:
    """A, A_t, A' v, A_t' v and slips of some pairs as columns, of z, v and the geometry."""
    v = ca.SX.sym("v", len(structure.angular))
    _, slip, *rows = structure.build_rows(indices, v)
    columns = ca.densify(ca.horzcat(*rows, slip))
    return Batch(ca.Function("rows", [structure.z, v, structure.geometry], [columns.T]))


@dataclass(frozen=True, eq=False)
class System:
    """A structure with the numbers of one scene."""

    structure: Structure
    geometry: Array  # (g,)
    mass: Array  # (n,): diagonal of M
    applied: Array  # (n,): gravity as a force on z
    # viscous, dry (n,): viscous coefficients B and largest dry friction D of the coordinates
    viscous: Array
    dry: Array
    friction: Array  # (N,): Coulomb's coefficient of each pair
    scales: Scales  # units of tolerances

    @cached_property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.mass)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all pairs."""
        return tuple(pair.name for pair in self.structure.pairs)

    @cached_property
    def units(self) -> Array:
        """Units of z, then of z', shape (2 n,)."""
        place = np.where(self.structure.angular, 1.0, self.scales.length)
        return np.concatenate([place, place / self.scales.time])

    def is_slower(self, v: Array, bound: float) -> bool:
        """Whether no component of z', shape (n,), exceeds `bound` times its unit."""
        return bool((np.abs(v) < bound * self.units[self.n :]).all())

    def evaluate(self, z: Array, v: Array, pairs: Sequence[int]) -> ContactRows:
        """Rows of some pairs at one state."""
        n, rows = self.n, np.zeros((0, 2 * self.n + 3))
        if len(pairs):
            rows = _build_rows(self.structure, tuple(pairs)).at(z, v, self.geometry)[0]
        return ContactRows(rows[:, :n], rows[:, n : 2 * n], *rows[:, 2 * n :].T)

    def measure_at(self, z: Array) -> tuple[Array, Array]:
        """As `measure`, at one configuration: shape (N,) each [m]."""
        gaps, ranges = self.structure.gaps.at(z, self.geometry)[0]
        return gaps, ranges

    def measure(self, z: Array) -> tuple[Array, Array]:
        """Gaps of all pairs and distances inside their ranges, (m, N) each [m], at z (m, n)."""
        geometry = np.broadcast_to(self.geometry, (len(z), len(self.geometry)))
        values = self.structure.gaps(z, geometry)[0]
        return values[:, :, 0], values[:, :, 1]

    def compute_energy(self, z: Array, v: Array) -> Array:
        """Mechanical energy: kinetic energy less the work of the applied force, (...) [J]."""
        return np.asarray(0.5 * (v**2) @ self.mass - z @ self.applied)

    def sum_forces(self, v: Array, tau: Array, sigma: Array) -> Array:
        """Forces on z without contact forces, (n,); dry friction opposes the directions `sigma`."""
        force = self.applied - self.viscous * v - self.dry * sigma
        driven = list(self.structure.driven)
        force[driven] += tau[: len(driven)]
        return force


@lru_cache(maxsize=64)
def build_system(scene: Scene) -> System:
    """The hand and the object as a system with five coordinates."""
    rounded = tuple(finger.radius > 0 for finger in scene.fingers)
    structure = _build(scene.polygon.n_vertices, rounded, scene.fingers_collide)
    links = [[*np.asarray(f.base), f.length, f.radius] for f in scene.fingers]
    parts = {"m": scene.friction.palm, "1": scene.friction.finger1, "2": scene.friction.finger2}
    names = (pair.name for pair in structure.pairs)
    friction = [0.0 if name[0] in "tj" else parts[name[-1]] for name in names]
    geometry = np.concatenate([scene.polygon.vertices.ravel(), *links])
    numbers = scene.mass_diagonal, scene.applied_force, scene.viscous, scene.dry
    return System(structure, geometry, *numbers, np.array(friction), scene.scales)


@lru_cache(maxsize=16)
def _build(count: int, rounded: tuple[bool, ...], collide: bool) -> Structure:
    """Structure of all scenes with `count` vertices, and links that are `rounded` or pointed."""
    geometry = ca.SX.sym("geometry", 2 * count + 8)
    parts = (ca.vertsplit(part) for part in ca.vertsplit(geometry[2 * count :], 4))
    links = [
        (ca.vertcat(x, y), length, radius if thick else ca.SX(0))
        for (x, y, length, radius), thick in zip(parts, rounded, strict=True)
    ]
    bodies, pairs = place_bodies(ca.reshape(geometry[: 2 * count], 2, count), links), []
    for contact, pair in bodies.pairs.items():
        if contact.surface in ("finger", "back"):
            # By convexity the whole object is on the side of the link that it touches.
            link, side = bodies.links[contact.finger or 0], 1 if contact.surface == "finger" else -1
            height = side * link.normal.T @ (bodies.z[:2] - link.base)
            pair = pair._replace(ranges=(*pair.ranges, height))
        elif contact.feature == "v" and contact.finger is not None and not rounded[contact.finger]:
            continue
        pairs.append(pair)
    if collide:
        pairs += _list_link_pairs(bodies.links, any(rounded))
    angular = (False, False, True, True, True)
    return Structure(bodies.z, geometry, tuple(pairs), (3, 4), angular)


def _list_link_pairs(links: Sequence[Link], rounded: bool) -> list[ContactPair]:
    """Pairs of tips and joints of each link with the other link."""
    pairs, zero = list[ContactPair](), ca.SX(0)
    radii = links[0].radius + links[1].radius
    for finger, other in ((0, 1), (1, 0)):
        link, other_link = links[finger], links[other]
        for name, point, far_end in (("tip", link.tip, link.base), ("joint", link.base, link.tip)):
            far_height = other_link.normal.T @ (far_end - other_link.base)
            offset = other_link.axis.T @ (point - other_link.base)
            height = other_link.normal.T @ (point - other_link.base)
            for side, sign in (("finger", 1.0), ("back", -1.0)):
                label = f"{name}{finger + 1}-{side}{other + 1}"
                ranges = (offset, other_link.length - offset, sign * far_height)
                pairs.append(ContactPair(label, sign * height - radii, zero, ranges, FINGERS_TOUCH))
    if not rounded:
        return pairs
    ends = [("tip", link.tip, link.axis) for link in links]
    joints = [("joint", link.base, -link.axis) for link in links]
    for first, second in ((ends[0], ends[1]), (ends[0], joints[1]), (joints[0], ends[1])):
        offset = second[1] - first[1]
        gap = ca.sqrt(ca.sumsqr(offset)) - radii
        distances = (first[2].T @ offset, -(second[2].T @ offset))
        name = f"{first[0]}1-{second[0]}2"
        pairs.append(ContactPair(name, gap, zero, distances, FINGERS_TOUCH))
    return pairs


N_LOSSES = 4  # number of integrals: work, losses to viscous, dry and sliding friction
ORDER = 8  # of the steps

# fmt: off
STAGE_WEIGHTS: tuple[dict[int, float], ...] = (
    {},
    {0: 0.05260015195876773},
    {0: 0.0197250569845379, 1: 0.0591751709536137},
    {0: 0.02958758547680685, 2: 0.08876275643042054},
    {0: 0.2413651341592667, 2: -0.8845494793282861, 3: 0.924834003261792},
    {0: 0.037037037037037035, 3: 0.17082860872947386, 4: 0.12546768756682242},
    {0: 0.037109375, 3: 0.17025221101954405, 4: 0.06021653898045596, 5: -0.017578125},
    {0: 0.03709200011850479, 3: 0.17038392571223998, 4: 0.10726203044637328,
     5: -0.015319437748624402, 6: 0.008273789163814023},
    {0: 0.6241109587160757, 3: -3.3608926294469414, 4: -0.868219346841726,
     5: 27.59209969944671, 6: 20.154067550477894, 7: -43.48988418106996},
    {0: 0.47766253643826434, 3: -2.4881146199716677, 4: -0.590290826836843,
     5: 21.230051448181193, 6: 15.279233632882423, 7: -33.28821096898486,
     8: -0.020331201708508627},
    {0: -0.9371424300859873, 3: 5.186372428844064, 4: 1.0914373489967295,
     5: -8.149787010746927, 6: -18.52006565999696, 7: 22.739487099350505,
     8: 2.4936055526796523, 9: -3.0467644718982196},
    {0: 2.273310147516538, 3: -10.53449546673725, 4: -2.0008720582248625, 5: -17.9589318631188,
     6: 27.94888452941996, 7: -2.8589982771350235, 8: -8.87285693353063, 9: 12.360567175794303,
     10: 0.6433927460157636},
)
"""Runge-Kutta coefficients a_ij of each stage i, by stage j."""
STAGE_TIMES = tuple(sum(row.values()) for row in STAGE_WEIGHTS)
"""Times of the stages, as fractions of a step."""
INNER_STAGES = (3, 5, 9, 10)  # stages spread over the step with accurate states
WEIGHTS_8 = {
    0: 0.054293734116568765, 5: 4.450312892752409, 6: 1.8915178993145003, 7: -5.801203960010585,
    8: 0.3111643669578199, 9: -0.1521609496625161, 10: 0.20136540080403034, 11: 0.04471061572777259,
}
"""Weights of order 8 by stage."""
ERROR_5 = {
    0: 0.01312004499419488, 5: -1.2251564463762044, 6: -0.4957589496572502, 7: 1.6643771824549864,
    8: -0.35032884874997366, 9: 0.3341791187130175, 10: 0.08192320648511571,
    11: -0.022355307863886294,
}
"""Differences of the weights of order 8 from those of order 5."""
_WEIGHTS_3 = {0: 0.2440944881889764, 8: 0.7338466882816118, 11: 0.022058823529411766}
ERROR_3 = {j: w - _WEIGHTS_3.get(j, 0.0) for j, w in WEIGHTS_8.items()}
"""Differences of the weights of order 8 from those of order 3."""
# fmt: on


class Modes(NamedTuple):
    """Contact modes of a smooth motion."""

    kept: tuple[int, ...] = ()  # pairs with contact forces
    # rows held by each friction force, in rising order: of kept pairs that stick together, then
    # of a coordinate
    holders: tuple[tuple[int, ...], ...] = ()
    Xi: tuple[float, ...] = ()  # sliding directions of the kept pairs, zero where they stick
    # directions of coordinates with dry friction, zero for those that are held
    sigma: tuple[float, ...] = ()


class Inputs(NamedTuple):
    """Inputs of a step, as arrays or symbols.

    From `geometry` on they are numbers of the system and its units.
    """

    y: Expression  # z, z' and the integrals, (2 n + LOSSES,)
    t: Expression  # t, h (1,) [s]:
    h: Expression
    tolerance: Expression  # (1,): largest error of z and z' over the step, in units of the scene
    Xi: Expression  # Xi, sigma: directions of sliding (k,) and of coordinates (n,), zero where held
    sigma: Expression
    anchors: Expression  # slip coordinates of sticking contacts [m], then held coordinates
    piece: Expression  # start and end of the torque's piece [s]
    torque: Expression  # its coefficients, joint by joint, as in `TorqueProfile`
    geometry: Expression
    applied: Expression
    viscous: Expression
    dry: Expression
    units: Expression  # of z and z'
    friction_units: Expression  # of the friction of coordinates
    inverse_mass: Expression  # diagonal of M^-1
    mu: Expression  # of the kept pairs
    scales: Expression  # units of force and speed


class Outputs(NamedTuple):
    """Outputs of a step, at its end except for `error` and `stages`."""

    y: Array
    acceleration: Array
    tau: Array  # [N m]
    c_n: Array  # c_n, c_t [N]: forces of the kept pairs
    c_t: Array
    ratio: Array  # (1,): reduced inertia over that without friction
    # event values, positive until an event, in units of the scene: see `EventRows`
    values: Array
    error: Array  # (1,): estimated error over the tolerance; accept at 1 and below
    stages: Array  # margins at the start and the stages of `INNER_STAGES`, one after the other


class EventRows(NamedTuple):
    """Rows of `Outputs.values` by kind of event value."""

    force: slice  # c_n
    # friction margins where friction holds: bound - f of each force f, then bound + f
    cone: slice
    slide: slice  # slide, turn: sliding velocities times Xi, rates of coordinates times sigma
    turn: slice


@dataclass(frozen=True, eq=False)
class ModeStepper:
    """Compiled steps of one set of modes; the functions read `inputs` and write `outputs`."""

    modes: Modes  # without signs
    inputs: Inputs
    outputs: Outputs
    rows: EventRows
    step: Any  # step, evaluate_state: a step of length h; the same outputs at the initial state
    evaluate_state: Any

    def load(self, system: System, tolerance: float, z: Array) -> None:
        """Set the constant inputs of a motion; contacts stick at their slip coordinates at z."""
        inputs = self.inputs
        for name in ("geometry", "applied", "viscous", "dry", "units"):
            getattr(inputs, name)[:] = getattr(system, name)
        inputs.tolerance[:], inputs.inverse_mass[:] = tolerance, 1 / system.mass
        inputs.mu[:], scales = system.friction[list(self.modes.kept)], system.scales
        inputs.friction_units[:] = np.where(system.structure.angular, scales.torque, scales.force)
        inputs.scales[:] = scales.force, scales.speed
        anchors = np.append(system.evaluate(z, z, self.modes.kept).slip, z)
        inputs.anchors[:] = anchors[[rows[0] for rows in self.modes.holders]]


@lru_cache(maxsize=256)
def build_stepper(structure: Structure, modes: Modes, degree: int) -> ModeStepper:
    """Steps of a set of modes without its signs, for torques of a polynomial degree."""
    n, k, s = len(structure.angular), len(modes.kept), len(modes.holders)
    numbers = structure.geometry.shape[0], n, n, n, 2 * n, n, n, k, 2
    sizes = 2 * n + N_LOSSES, 1, 1, 1, k, n, s, 2, 2 * degree + 2, *numbers
    bounds = np.cumsum([0, *sizes]).tolist()
    symbols = Inputs(*map(ca.SX.sym, Inputs._fields, sizes))._replace(geometry=structure.geometry)
    rows = EventRows(*(slice(*pair) for pair in pairwise(np.cumsum([0, k, 2 * s, k, n]).tolist())))
    stage, report, project = _build_motion(structure, modes, symbols)
    # One vector takes less time than many.
    packed = ca.MX.sym("inputs", bounds[-1])
    x, stages = Inputs(*ca.vertsplit(packed, bounds)), list[Expression]()

    def rate(state: Expression, time: Expression) -> Expression:
        rates, margins = stage(state, time, packed)
        stages.append(margins)
        return rates

    end, fifth, third = build_step(rate, x.y, x.t, x.h, 2 * n)
    error = build_error(fifth, third, x.y[: 2 * n], x.units, x.tolerance)
    sampled_margins = ca.vertcat(stages[0], *(stages[row] for row in INNER_STAGES))
    end = ca.vertcat(project(x, end[: 2 * n]), end[2 * n :])
    inputs, functions = np.zeros(bounds[-1]), []
    for state, time, extra in (
        (end, x.t + x.h, (error, sampled_margins)),
        (x.y, x.t, (0, ca.DM.zeros(sampled_margins.shape[0]))),
    ):
        results = [state, *report(state[: 2 * n], time, packed), *map(ca.MX, extra)]
        functions.append(ca.Function("step", [packed], [ca.densify(ca.vertcat(*results))]))
    offsets = np.cumsum([part.shape[0] for part in results])
    outputs = np.zeros(offsets[-1])
    step, evaluate_state = (bind(function, [inputs], [outputs]) for function in functions)
    views = Inputs(*np.split(inputs, bounds[1:-1])), Outputs(*np.split(outputs, offsets[:-1]))
    return ModeStepper(modes, *views, rows, step, evaluate_state)


def _build_motion(
    structure: Structure, modes: Modes, x: Inputs
) -> tuple[Expression, Expression, Callable[[Inputs, Expression], Expression]]:
    """Equations of motion with inputs x.

    Returns two CasADi functions of (z, z'), time and the inputs in one column: rates of the state
    and margins; and the outputs from the acceleration to the event values. Returns a function that
    projects (z, z') onto the constraints, in the metric M.
    """
    n, k, z = len(structure.angular), len(modes.kept), structure.z
    v, time, mu, inverse_mass = ca.SX.sym("v", n), ca.SX.sym("time"), x.mu, x.inverse_mass
    gap, slip, A, A_t, A_dot_v, A_t_dot_v = structure.build_rows(modes.kept, v)
    first_rows = [rows[0] for rows in modes.holders]
    groups = [list(rows) for rows in modes.holders if rows[0] < k]
    is_sliding = np.ones(k)
    is_sliding[[row for rows in groups for row in rows]] = 0.0
    friction_ratio = mu * x.Xi * ca.DM(is_sliding)
    A_held = ca.vertcat(A_t, ca.DM(np.eye(n)))[first_rows, :]
    P, G = (ca.vertcat(part, A_held) for part in (A, A - ca.repmat(friction_ratio, 1, n) * A_t))
    P_dot_v = ca.vertcat(A_dot_v, ca.vertcat(A_t_dot_v, ca.DM.zeros(n))[first_rows])
    tau = _build_torque(time, x.piece, x.torque)
    viscous, dry = x.viscous * v, x.dry * x.sigma
    motor_force = ca.SX(n, 1)
    for row, coordinate in enumerate(structure.driven):
        motor_force[coordinate] = tau[row]
    force, c, ratio = x.applied + motor_force - viscous - dry, ca.SX(0, 1), ca.SX(1)
    if P.shape[0]:
        c, ratio = _build_solution(*P.shape)(P, G, inverse_mass, force, P_dot_v)
        force = force + G.T @ c
    acceleration, v_t, (c_n, f) = inverse_mass * force, A_t @ v, ca.vertsplit(c, [0, k, c.shape[0]])
    losses = [ca.dot(part, v) for part in (motor_force, viscous, dry)]
    losses.append(ca.dot(friction_ratio * c_n, v_t))
    bounds = [ca.dot(mu[rows], c_n[rows]) for rows in groups]
    bound = ca.vertcat(ca.SX(0, 1), *bounds, x.dry[[row - k for row in first_rows[len(groups) :]]])
    unit = ca.vertcat(ca.repmat(x.scales[0], k, 1), x.friction_units)[first_rows]
    margins = ca.vertcat(c_n / x.scales[0], (bound - f) / unit, (bound + f) / unit)
    speeds = x.Xi * v_t / x.scales[1], x.sigma * v / x.units[n:]
    c_t = -friction_ratio * c_n
    for rows, friction in zip(groups, ca.vertsplit(f)[: len(groups)], strict=True):
        fraction = c_n[rows] / ca.fmax(ca.sum1(c_n[rows]), 1e-300) if len(rows) > 1 else 1
        c_t[rows] = friction * fraction
    results = (
        [ca.vertcat(v, acceleration, *losses), margins],
        [acceleration, tau, c_n, c_t, ratio, ca.vertcat(margins, *speeds)],
    )
    inputs = [ca.vertcat(z, v), time, ca.vertcat(*x)]
    stage, report = (ca.Function("of_state", inputs, list(map(ca.densify, r))) for r in results)
    r = ca.vertcat(gap, ca.vertcat(slip, z)[first_rows] - x.anchors)
    constraints = ca.Function("rows", [z, x.anchors, x.geometry], [ca.densify(P), ca.densify(r)])

    def project(data: Inputs, state: Expression) -> Expression:
        if not P.shape[0]:
            return state
        # A step leaves gaps of the size of its error, so one Newton iteration closes them.
        correct, speed = _build_correction(*P.shape), state[n:]
        rows, r = constraints(state[:n], data.anchors, data.geometry)
        place = state[:n] - correct(rows, r, data.inverse_mass)
        rows, _ = constraints(place, data.anchors, data.geometry)
        return ca.vertcat(place, speed - correct(rows, rows @ speed, data.inverse_mass))

    return stage, report, project


@lru_cache(maxsize=16)
def _build_solution(count: int, n: int) -> Expression:
    """CasADi function (P, G, diagonal of M^-1, force, P' z') -> c, ratio of reduced inertias."""
    P, G, inverse_mass = ca.SX.sym("P", count, n), ca.SX.sym("G", count, n), ca.SX.sym("lift", n)
    force, P_dot_v = ca.SX.sym("force", n), ca.SX.sym("curve", count)
    PM = P * ca.repmat(inverse_mass.T, count, 1)
    K = PM @ G.T
    c, ratio = ca.solve(K, -P_dot_v - PM @ force), ca.det(K) / ca.det(PM @ P.T)
    return ca.Function("solution", [P, G, inverse_mass, force, P_dot_v], [c, ratio])


@lru_cache(maxsize=16)
def _build_correction(count: int, n: int) -> Expression:
    """CasADi function (P, r, diagonal of M^-1) -> x of least norm in the metric M, P x = r."""
    P, r, inverse_mass = ca.SX.sym("P", count, n), ca.SX.sym("r", count), ca.SX.sym("lift", n)
    PM = ca.repmat(inverse_mass, 1, count) * P.T
    return ca.Function("correct", [P, r, inverse_mass], [ca.densify(PM @ ca.solve(P @ PM, r))])


def _build_torque(time: Expression, piece: Expression, coefficients: Expression) -> Expression:
    """Torques on a polynomial piece with ends `piece` [s], shape (2,) [N m], by Horner's rule."""
    start, stop = piece[0], piece[1]
    x = (2 * time - start - stop) / (stop - start)
    coefficients = ca.reshape(coefficients, -1, 2)
    return ca.vertcat(*(ca.polyval(part[::-1], x) for part in ca.horzsplit(coefficients)))


def build_step(
    rate: Callable[[Expression, Expression], Expression],
    y: Expression,
    t: Expression,
    h: Expression,
    n_moving: int,
) -> tuple[Expression, Expression, Expression]:
    """Step of y' = rate(y[:n_moving], t) of length h: its end, and errors of order 5 and 3.

    Components of y (n,) from `n_moving` on are integrals; error estimates exclude them.
    """
    rates: list[Expression] = []

    def combine(start: Expression, weights: dict[int, float], count: int = n_moving) -> Expression:
        function = _build_combination(y.shape[0], count, tuple(weights.values()))
        return function(start, h, *(rates[stage] for stage in weights))

    for time, row in zip(ca.vertsplit(t + h * ca.DM(STAGE_TIMES)), STAGE_WEIGHTS, strict=True):
        rates.append(rate(combine(y, row), time))
    return combine(y, WEIGHTS_8, y.shape[0]), combine(0, ERROR_5), combine(0, ERROR_3)


@lru_cache(maxsize=128)
def _build_combination(n: int, count: int, weights: tuple[float, ...]) -> Expression:
    """CasADi function (start (n,), h, rates (n,) each) -> start + h (weighted sum of rates).

    Only the first `count` components are computed.
    """
    start, h = ca.SX.sym("start", n), ca.SX.sym("h")
    rates = [ca.SX.sym("rate", n) for _ in weights]
    end = start + h * (ca.horzcat(ca.SX(n, 0), *rates) @ ca.DM(weights))
    return ca.Function("combine", [start, h, *rates], [end[:count]])


def build_error(
    fifth: Expression, third: Expression, y: Expression, units: Expression, tolerance: Expression
) -> Expression:
    """Error over the tolerance, relative to max(`units`, |y|), as in DOP853 (order h^8)."""
    scale = tolerance * (units + ca.fabs(y))
    high, low = ca.sumsqr(fifth / scale), ca.sumsqr(third / scale)
    return high / ca.sqrt(y.shape[0] * ca.fmax(high + 0.01 * low, 1e-300))
