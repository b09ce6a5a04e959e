"""Rigid bodies with pairs of features that may touch, and steps of their motion.

The motion is M z'' = f + S tau - B z' - friction + A^T c_n + A_t^T c_t with a constant diagonal M.
A pair of features has a gap C(z), whose gradient is its row of A, and a slip coordinate s(z), whose
gradient is its row of A_t: how far the features have slid over each other while they touch.

What is compiled is a `Structure`, which knows of no numbers; a `System` has those of one scene.
That of a scene (`build_system`) has all pairs of features of object and hand (`elemental`), and of
links, such as ``tip1-back2``: tip 1 and the far side of link 2.

The links slide on each other without friction, as no coefficient is given for them. Tolerances of
the simulator are relative to scales of the scene (`Scene.scales`).

**Steps** of a motion with given contact modes are compiled once for all bodies of a kind.
With the rows P of what a mode keeps at rest (gaps of contacts that press, slip coordinates of those
that stick, coordinates that dry friction holds) and G, whose rows of sliding contacts bring their
friction with them,

    M z'' = f + S tau - B z' - D sigma + G^T c,    P z'' + P' z' = 0,    c = [c_n; f].

Contacts that stick as one, as the vertices of a flush edge do, have one force of friction. Only
this sum is determined; it is shared in proportion to c_n, which does not affect the motion. A step
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

ROUNDING_FORCE = 1e-9  # shortfall of a force, torque or friction margin that is rounding
REACHED = 3e-5  # distance to the end of a phase that counts as there, at rest: the next overlaps
SLOW = 2e-4  # speed that counts as rest at the end of a phase
STANDING = 1e-9  # speed that counts as none in friction: either sign by integration error
SETTLING = 2e-5  # longest time by which rounding moves an event; modes are judged as late
REST_WINDOW = 2e-3  # time of rest before a torque break: too short for contacts to part
FIRST_STEP = 2e-2  # length of the first step tried from rest
SHORTEST_STEP = 1e-13  # underflow of a step, over the scene's time and the elapsed time
STILL = 1e-10  # acceleration that counts as rounding


class ContactRows(NamedTuple):
    """Pairs at one state: A z' = 0 and A_t z' = 0 keep them closed and stuck."""

    A: Array  # A, A_t (m, n):
    A_t: Array
    bend: Array  # bend, bend_t (m,): A' z' and A_t' z'
    bend_t: Array
    slip: Array  # (m,) [m]: slip coordinates


@dataclass(frozen=True, eq=False)
class Structure:
    """Coordinates and features of bodies of any size and weight."""

    z: Expression  # (n,)
    geometry: Expression  # (g,): numbers that gaps and slip coordinates depend on besides
    pairs: tuple[ContactPair, ...]
    driven: tuple[int, ...]  # coordinates that the two torques act on; empty where there are none
    turns: tuple[bool, ...]  # which coordinates are angles

    def build_rows(self, chosen: Sequence[int], v: Expression) -> tuple[Expression, ...]:
        """Gaps, slips, A, A_t, A' v and A_t' v of some pairs, as expressions of z and v."""
        parts: list[Expression] = []
        for values in ([self.pairs[k].gap for k in chosen], [self.pairs[k].slip for k in chosen]):
            column = ca.vertcat(ca.SX(0, 1), *values)
            rows = ca.jacobian(column, self.z)
            parts.append((column, rows, ca.jtimes(rows @ v, self.z, v)))
        (gap, A, bend), (slip, A_t, bend_t) = parts
        return gap, slip, A, A_t, bend, bend_t

    @cached_property
    def gaps(self) -> Batch:
        """Function (z, geometry) -> gaps and ranges of all pairs, shape (N, 2)."""
        gaps = ca.vertcat(ca.SX(0, 1), *(pair.gap for pair in self.pairs))
        least = [ca.mmin(ca.vertcat(1e9, *pair.ranges)) for pair in self.pairs]
        both = ca.cse(ca.densify(ca.horzcat(gaps, ca.vertcat(ca.SX(0, 1), *least))))
        return Batch(ca.Function("gaps", [self.z, self.geometry], [both]))


@lru_cache(maxsize=256)
def _build_rows(structure: Structure, chosen: tuple[int, ...]) -> Batch:
    """A, A_t, A' v, A_t' v and slips of some pairs as columns, of z, v and the geometry."""
    v = ca.SX.sym("v", len(structure.turns))
    _, slip, *rows = structure.build_rows(chosen, v)
    both = ca.densify(ca.horzcat(*rows, slip))
    return Batch(ca.Function("rows", [structure.z, v, structure.geometry], [both.T]))


@dataclass(frozen=True, eq=False)
class System:
    """A structure with its numbers."""

    structure: Structure
    geometry: Array  # (g,)
    mass: Array  # (n,): diagonal of M
    applied: Array  # (n,): gravity as a force on z
    # viscous, dry (n,): friction of the coordinates themselves: B, and the largest dry one
    viscous: Array
    dry: Array
    friction: Array  # (N,): Coulomb's coefficient of each pair
    scales: Scales  # units that tolerances count in

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
        place = np.where(self.structure.turns, 1.0, self.scales.length)
        return np.concatenate([place, place / self.scales.time])

    def is_slower(self, v: Array, bound: float) -> bool:
        """Whether no component of z', shape (n,), exceeds `bound` times its unit."""
        return bool((np.abs(v) < bound * self.units[self.n :]).all())

    def evaluate(self, z: Array, v: Array, chosen: Sequence[int]) -> ContactRows:
        """Rows of some pairs at one state."""
        n, rows = self.n, np.zeros((0, 2 * self.n + 3))
        if len(chosen):
            rows = _build_rows(self.structure, tuple(chosen)).at(z, v, self.geometry)[0]
        return ContactRows(rows[:, :n], rows[:, n : 2 * n], *rows[:, 2 * n :].T)

    def look(self, z: Array) -> tuple[Array, Array]:
        """As `measure`, at one place: shape (N,) each [m]."""
        gaps, ranges = self.structure.gaps.at(z, self.geometry)[0]
        return gaps, ranges

    def measure(self, z: Array) -> tuple[Array, Array]:
        """Gaps of all pairs and distances inside their ranges, (m, N) each [m], at z (m, n)."""
        geometry = np.broadcast_to(self.geometry, (len(z), len(self.geometry)))
        both = self.structure.gaps(z, geometry)[0]
        return both[:, :, 0], both[:, :, 1]

    def stored(self, z: Array, v: Array) -> Array:
        """Kinetic energy less the work of the applied force, shape (...) [J]."""
        return np.asarray(0.5 * (v**2) @ self.mass - z @ self.applied)

    def push(self, v: Array, tau: Array, sigma: Array) -> Array:
        """Forces on z but those of contacts, with dry friction in the directions `sigma`, (n,)."""
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
    """The structure of all scenes with as many vertices, and links with or without a radius."""
    geometry = ca.SX.sym("geometry", 2 * count + 8)
    parts = (ca.vertsplit(part) for part in ca.vertsplit(geometry[2 * count :], 4))
    links = [
        (ca.vertcat(x, y), length, radius if thick else ca.SX(0))
        for (x, y, length, radius), thick in zip(parts, rounded, strict=True)
    ]
    bodies, pairs = place_bodies(ca.reshape(geometry[: 2 * count], 2, count), links), []
    for contact, pair in bodies.pairs.items():
        if contact.surface in ("finger", "back"):
            # By convexity the whole object is on the side that it touches between its ends.
            link, way = bodies.links[contact.finger or 0], 1 if contact.surface == "finger" else -1
            middle = way * link.normal.T @ (bodies.z[:2] - link.base)
            pair = pair._replace(ranges=(*pair.ranges, middle))
        elif contact.feature == "v" and contact.finger is not None and not rounded[contact.finger]:
            continue
        pairs.append(pair)
    if collide:
        pairs += _list_link_pairs(bodies.links, any(rounded))
    turns = (False, False, True, True, True)
    return Structure(bodies.z, geometry, tuple(pairs), (3, 4), turns)


def _list_link_pairs(links: Sequence[Link], rounded: bool) -> list[ContactPair]:
    """Tips and joints of either link against the other link."""
    pairs, none = list[ContactPair](), ca.SX(0)
    thick = links[0].radius + links[1].radius
    for finger, other in ((0, 1), (1, 0)):
        mine, theirs = links[finger], links[other]
        for name, point, rest in (("tip", mine.tip, mine.base), ("joint", mine.base, mine.tip)):
            behind = theirs.normal.T @ (rest - theirs.base)
            run = theirs.axis.T @ (point - theirs.base)
            level = theirs.normal.T @ (point - theirs.base)
            for side, way in (("finger", 1.0), ("back", -1.0)):
                title = f"{name}{finger + 1}-{side}{other + 1}"
                ranges = (run, theirs.length - run, way * behind)
                pairs.append(ContactPair(title, way * level - thick, none, ranges, FINGERS_TOUCH))
    if not rounded:
        return pairs
    ends = [("tip", link.tip, link.axis) for link in links]
    joints = [("joint", link.base, -link.axis) for link in links]
    for first, second in ((ends[0], ends[1]), (ends[0], joints[1]), (joints[0], ends[1])):
        run = second[1] - first[1]
        gap = ca.sqrt(ca.sumsqr(run)) - thick
        beyond = (first[2].T @ run, -(second[2].T @ run))
        name = f"{first[0]}1-{second[0]}2"
        pairs.append(ContactPair(name, gap, none, beyond, FINGERS_TOUCH))
    return pairs


LOSSES = 4  # integrals along the motion: work, losses to viscous, dry and sliding friction
ORDER = 8

# fmt: off
ROWS: tuple[dict[int, float], ...] = (
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
"""Weights of the stages before, for each stage."""
NODES = tuple(sum(row.values()) for row in ROWS)
"""Times of the stages, as shares of a step."""
INNER_STAGES = (3, 5, 9, 10)  # stages spread over the step that approximate the state well
WEIGHTS = {
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
_THIRD = {0: 0.2440944881889764, 8: 0.7338466882816118, 11: 0.022058823529411766}
ERROR_3 = {j: w - _THIRD.get(j, 0.0) for j, w in WEIGHTS.items()}
"""Differences of the weights of order 8 from those of order 3."""
# fmt: on


class Modes(NamedTuple):
    """What keeps which contacts while a motion is smooth."""

    kept: tuple[int, ...] = ()  # pairs that press
    # what each force of friction holds, in rising order: rows of the kept pairs that stick as one,
    # and below these, of a coordinate
    holders: tuple[tuple[int, ...], ...] = ()
    Xi: tuple[float, ...] = ()  # sliding directions of the kept pairs, zero where they stick
    # directions of coordinates with dry friction, zero for those that are held
    sigma: tuple[float, ...] = ()


class Inputs(NamedTuple):
    """What a step reads, as arrays or as symbols of their sizes.

    Those from `geometry` on are numbers of the system and its units.
    """

    y: Expression  # z, z' and the integrals, (2 n + LOSSES,)
    t: Expression  # t, h (1,) [s]:
    h: Expression
    tolerance: Expression  # (1,): largest error of z and z' over the step, in units of the scene
    Xi: Expression  # Xi, sigma: directions of sliding (k,) and of coordinates (n,), zero where held
    sigma: Expression
    stay: Expression  # slip coordinates of what sticks [m], then held coordinates
    piece: Expression  # start and end of the torque's piece [s]
    torque: Expression  # its coefficients, joint by joint, as in `TorqueProfile`
    geometry: Expression
    applied: Expression
    viscous: Expression
    dry: Expression
    units: Expression  # of z and z'
    friction_units: Expression  # of the friction of coordinates
    lift: Expression  # diagonal of M^-1
    mu: Expression  # of the kept pairs
    scales: Expression  # units of force and speed


class Outputs(NamedTuple):
    """What a step gives; all but `error` and `stages` holds at its end."""

    y: Array
    acceleration: Array
    tau: Array  # [N m]
    c_n: Array  # c_n, c_t [N]: forces of the kept pairs
    c_t: Array
    ratio: Array  # (1,): reduced inertia over that without friction
    # positive until something happens, in units of the scene: see `EventRows`
    values: Array
    error: Array  # (1,): estimated error over the tolerance; accept at 1 and below
    stages: Array  # margins at the start and the stages of `INNER_STAGES`, one after the other


class EventRows(NamedTuple):
    """Where each kind of event value is among `Outputs.values`."""

    force: slice  # c_n
    # what friction still has to give where it holds: bound - f of each force f, then bound + f
    cone: slice
    slide: slice  # slide, turn: sliding velocities times Xi, rates of coordinates times sigma
    turn: slice


@dataclass(frozen=True, eq=False)
class ModeStepper:
    """Compiled steps of one set of modes; calling `step` or `look` reads `inputs`."""

    modes: Modes  # without signs
    inputs: Inputs
    outputs: Outputs
    rows: EventRows
    step: Any  # step, look: a step of length h; the same outputs at the state given, without a step
    look: Any

    def load(self, system: System, tolerance: float, z: Array) -> None:
        """Set the inputs that do not change along a motion, which keeps what sticks as at z."""
        inputs = self.inputs
        for name in ("geometry", "applied", "viscous", "dry", "units"):
            getattr(inputs, name)[:] = getattr(system, name)
        inputs.tolerance[:], inputs.lift[:] = tolerance, 1 / system.mass
        inputs.mu[:], scales = system.friction[list(self.modes.kept)], system.scales
        inputs.friction_units[:] = np.where(system.structure.turns, scales.torque, scales.force)
        inputs.scales[:] = scales.force, scales.speed
        places = np.append(system.evaluate(z, z, self.modes.kept).slip, z)
        inputs.stay[:] = places[[rows[0] for rows in self.modes.holders]]


@lru_cache(maxsize=256)
def build_stepper(structure: Structure, modes: Modes, degree: int) -> ModeStepper:
    """Steps of a set of modes without its signs, for torques of a polynomial degree."""
    n, k, s = len(structure.turns), len(modes.kept), len(modes.holders)
    numbers = structure.geometry.shape[0], n, n, n, 2 * n, n, n, k, 2
    sizes = 2 * n + LOSSES, 1, 1, 1, k, n, s, 2, 2 * degree + 2, *numbers
    ends = np.cumsum([0, *sizes]).tolist()
    x = Inputs(*map(ca.SX.sym, Inputs._fields, sizes))._replace(geometry=structure.geometry)
    rows = EventRows(*(slice(*pair) for pair in pairwise(np.cumsum([0, k, 2 * s, k, n]).tolist())))
    stage, report, project = _build_motion(structure, modes, x)
    # One vector takes less time than many.
    packed = ca.MX.sym("inputs", ends[-1])
    at, stages = Inputs(*ca.vertsplit(packed, ends)), list[Expression]()

    def rate(state: Expression, time: Expression) -> Expression:
        rates, margins = stage(state, time, packed)
        stages.append(margins)
        return rates

    end, fifth, third = build_step(rate, at.y, at.t, at.h, 2 * n)
    error = build_error(fifth, third, at.y[: 2 * n], at.units, at.tolerance)
    seen = ca.vertcat(stages[0], *(stages[row] for row in INNER_STAGES))
    end = ca.vertcat(project(at, end[: 2 * n]), end[2 * n :])
    inputs, functions = np.zeros(ends[-1]), []
    for state, time, extra in (
        (end, at.t + at.h, (error, seen)),
        (at.y, at.t, (0, ca.DM.zeros(seen.shape[0]))),
    ):
        every = [state, *report(state[: 2 * n], time, packed), *map(ca.MX, extra)]
        functions.append(ca.Function("step", [packed], [ca.densify(ca.vertcat(*every))]))
    stops = np.cumsum([part.shape[0] for part in every])
    outputs = np.zeros(stops[-1])
    step, look = (bind(function, [inputs], [outputs]) for function in functions)
    views = Inputs(*np.split(inputs, ends[1:-1])), Outputs(*np.split(outputs, stops[:-1]))
    return ModeStepper(modes, *views, rows, step, look)


def _build_motion(
    structure: Structure, modes: Modes, x: Inputs
) -> tuple[Expression, Expression, Callable[[Inputs, Expression], Expression]]:
    """Equations of motion with inputs x.

    Two CasADi functions of z and z', the time and the inputs in one column: rates of the state and
    margins, then the outputs from the acceleration to the event values. A function of the inputs
    and (z, z'): its projection on the constraints, in the metric M.
    """
    n, k, z = len(structure.turns), len(modes.kept), structure.z
    v, time, mu, lift = ca.SX.sym("v", n), ca.SX.sym("time"), x.mu, x.lift
    gap, slip, A, A_t, bend, bend_t = structure.build_rows(modes.kept, v)
    first = [rows[0] for rows in modes.holders]
    groups = [list(rows) for rows in modes.holders if rows[0] < k]
    slides = np.ones(k)
    slides[[row for rows in groups for row in rows]] = 0.0
    rub = mu * x.Xi * ca.DM(slides)
    hold = ca.vertcat(A_t, ca.DM(np.eye(n)))[first, :]
    P, G = (ca.vertcat(part, hold) for part in (A, A - ca.repmat(rub, 1, n) * A_t))
    curve = ca.vertcat(bend, ca.vertcat(bend_t, ca.DM.zeros(n))[first])
    tau = _build_torque(time, x.piece, x.torque)
    viscous, dry = x.viscous * v, x.dry * x.sigma
    drive = ca.SX(n, 1)
    for row, coordinate in enumerate(structure.driven):
        drive[coordinate] = tau[row]
    force, c, ratio = x.applied + drive - viscous - dry, ca.SX(0, 1), ca.SX(1)
    if P.shape[0]:
        c, ratio = _build_solution(*P.shape)(P, G, lift, force, curve)
        force = force + G.T @ c
    acceleration, v_t, (c_n, f) = lift * force, A_t @ v, ca.vertsplit(c, [0, k, c.shape[0]])
    losses = [ca.dot(part, v) for part in (drive, viscous, dry)]
    losses.append(ca.dot(rub * c_n, v_t))
    bounds = [ca.dot(mu[rows], c_n[rows]) for rows in groups]
    bound = ca.vertcat(ca.SX(0, 1), *bounds, x.dry[[row - k for row in first[len(groups) :]]])
    unit = ca.vertcat(ca.repmat(x.scales[0], k, 1), x.friction_units)[first]
    margins = ca.vertcat(c_n / x.scales[0], (bound - f) / unit, (bound + f) / unit)
    speeds = x.Xi * v_t / x.scales[1], x.sigma * v / x.units[n:]
    c_t = -rub * c_n
    for rows, friction in zip(groups, ca.vertsplit(f)[: len(groups)], strict=True):
        share = c_n[rows] / ca.fmax(ca.sum1(c_n[rows]), 1e-300) if len(rows) > 1 else 1
        c_t[rows] = friction * share
    results = (
        [ca.vertcat(v, acceleration, *losses), margins],
        [acceleration, tau, c_n, c_t, ratio, ca.vertcat(margins, *speeds)],
    )
    inputs = [ca.vertcat(z, v), time, ca.vertcat(*x)]
    stage, report = (ca.Function("of_state", inputs, list(map(ca.densify, r))) for r in results)
    off = ca.vertcat(gap, ca.vertcat(slip, z)[first] - x.stay)
    constraints = ca.Function("rows", [z, x.stay, x.geometry], [ca.densify(P), ca.densify(off)])

    def project(at: Inputs, state: Expression) -> Expression:
        if not P.shape[0]:
            return state
        # A step leaves gaps of the size of its error, so one Newton iteration closes them.
        correct, speed = _build_correction(*P.shape), state[n:]
        rows, off = constraints(state[:n], at.stay, at.geometry)
        place = state[:n] - correct(rows, off, at.lift)
        rows, _ = constraints(place, at.stay, at.geometry)
        return ca.vertcat(place, speed - correct(rows, rows @ speed, at.lift))

    return stage, report, project


@lru_cache(maxsize=16)
def _build_solution(count: int, n: int) -> Expression:
    """CasADi function (P, G, diagonal of M^-1, force, P' z') -> c, and the ratio of inertias."""
    P, G, lift = ca.SX.sym("P", count, n), ca.SX.sym("G", count, n), ca.SX.sym("lift", n)
    force, curve = ca.SX.sym("force", n), ca.SX.sym("curve", count)
    lifted = P * ca.repmat(lift.T, count, 1)
    K = lifted @ G.T
    c, ratio = ca.solve(K, -curve - lifted @ force), ca.det(K) / ca.det(lifted @ P.T)
    return ca.Function("solution", [P, G, lift, force, curve], [c, ratio])


@lru_cache(maxsize=16)
def _build_correction(count: int, n: int) -> Expression:
    """CasADi function (P, r, diagonal of M^-1) -> the shortest x in the metric M with P x = r."""
    P, r, lift = ca.SX.sym("P", count, n), ca.SX.sym("r", count), ca.SX.sym("lift", n)
    lifted = ca.repmat(lift, 1, count) * P.T
    return ca.Function("correct", [P, r, lift], [ca.densify(lifted @ ca.solve(P @ lifted, r))])


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
    moving: int,
) -> tuple[Expression, Expression, Expression]:
    """Step of y' = rate(y[:moving], t) of length h: the end, and errors of order 5 and 3.

    Components of y (n,) from `moving` on are integrals along the motion; errors do not cover them.
    """
    rates: list[Expression] = []

    def combine(start: Expression, weights: dict[int, float], count: int = moving) -> Expression:
        function = _build_combination(y.shape[0], count, tuple(weights.values()))
        return function(start, h, *(rates[stage] for stage in weights))

    for time, row in zip(ca.vertsplit(t + h * ca.DM(NODES)), ROWS, strict=True):
        rates.append(rate(combine(y, row), time))
    return combine(y, WEIGHTS, y.shape[0]), combine(0, ERROR_5), combine(0, ERROR_3)


@lru_cache(maxsize=128)
def _build_combination(n: int, count: int, weights: tuple[float, ...]) -> Expression:
    """CasADi function of a start (n,), h and rates (n,) each -> the start + h (weighted rates).

    Of its components the first `count` are computed.
    """
    start, h = ca.SX.sym("start", n), ca.SX.sym("h")
    rates = [ca.SX.sym("rate", n) for _ in weights]
    end = start + h * (ca.horzcat(ca.SX(n, 0), *rates) @ ca.DM(weights))
    return ca.Function("combine", [start, h, *rates], [end[:count]])


def build_error(
    fifth: Expression, third: Expression, y: Expression, units: Expression, tolerance: Expression
) -> Expression:
    """Error over the tolerance in `units` or y, if larger, combined as in DOP853 (like h^8)."""
    scale = tolerance * (units + ca.fabs(y))
    high, low = ca.sumsqr(fifth / scale), ca.sumsqr(third / scale)
    return high / ca.sqrt(y.shape[0] * ca.fmax(high + 0.01 * low, 1e-300))
