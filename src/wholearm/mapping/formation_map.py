"""The contact-formation map: the (x, phi) plane as cells, borders and crossings.

With palm and both fingers touching, a configuration is a function of (x, phi). Three contacts touch
inside a cell (two degrees of freedom), four on its borders (one), five at crossings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import Array, Flags, Numbers, interpolate
from ..common.document import Drawn
from ..common.errors import InputError
from ..common.sharing import exclusive
from ..contacts.closing import close_fingers, contact_table, evaluate_each, find_reach, group_labels
from ..contacts.elemental import Contact
from ..contacts.formation import CurvePoint, Kinematics
from ..geometry.curve import solve_tangent
from ..mechanics import UNIQUENESS
from ..mechanics.dynamics import Directions, force_rows, inverse, metric_weights, reduced_inertia
from ..mechanics.limits import make_limits
from ..mechanics.path_limits import InternalForceLimits, PathLimits
from ..mechanics.speed_sweep import make_cosine_grid, speed_sweep
from ..mechanics.uniqueness import UNIQUENESS_MARGIN, find_minors
from ..planning.lower_bound import RELAXATION
from ..problem.definition import ROWS, Problem
from ..scene.model import Scene
from .borders import NOWHERE, Piece, Window, cut, label_inside, list_tracks, name_contacts
from .formation_list import trace_problem

DIRECTIONS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])  # inside a cell: x, phi
REGULAR = 1e-9  # least ratio of singular values, and least determinant, of independent contacts
Flush = tuple[int | None, int]  # a finger (None for the palm) and an edge that lies flush on it
CROSSED = -5  # cell of places at which the closed fingers overlap
NODES = 24  # intervals of a border


@dataclass(frozen=True, eq=False)
class Border:
    """A part of a cell border with one contact formation."""

    contacts: tuple[Contact, ...]  # four
    # None if a contact passes from the side of a link to its tip or along the tip: two of the names
    # are one contact, which does not constrain the motion to the border
    flush: Flush | None
    along: str  # {"x", "phi"}: the coordinate that increases along the border
    points: Array  # (n, 2) [m, rad]: x and phi
    z: Array  # (n, 5): configurations there
    forth: Flags  # (n,): whether a quasistatic motion with increasing coordinate is feasible
    back: Flags  # (n,): with decreasing coordinate; both False if nothing is flush
    ambiguous: Flags  # (n,): feasible in some direction, but contact forces are not unique


@dataclass(frozen=True, eq=False)
class Crossing:
    """A place where borders meet and five or more contacts touch."""

    point: Array  # (2,) [m, rad]: x and phi
    z: Array  # (5,)
    contacts: tuple[Contact, ...]
    # flush edges of the borders that meet; if there is only one, a contact changes its name
    flush: tuple[Flush, ...]


@dataclass(frozen=True, eq=False, repr=False)
class FormationMap(Drawn):
    """The cells, borders and crossings of a window of the (x, phi) plane."""

    drawing_function = "map_figure", "draw_map"

    problem: Problem
    x: Array  # x, phi (n_x,) and (n_phi,) [m] and [rad]: grid
    phi: Array
    # (n_phi, n_x): index into `formations`; -1 and -2 if finger 1 and 2 is too short, -3 and -4 if
    # the joint of finger 1 and 2 is in the object, `CROSSED` if the fingers would overlap
    cell: Numbers
    formations: tuple[tuple[Contact, ...], ...]  # the three contacts of each cell
    borders: tuple[Border, ...]
    crossings: tuple[Crossing, ...]
    places: Array  # (m, 2) [m, rad]: at which directions inside cells were checked
    possible: Flags  # (m, 4): whether quasistatic motions in the `DIRECTIONS` are feasible
    ambiguous: Flags  # (m,): one more would be, but contact forces are not unique

    @property
    def headline(self) -> str:
        """Numbers of formations, borders and crossings, in a line."""
        return (
            f"{self.problem.name!r}, {len(self.formations)} formations, {len(self.borders)} "
            f"borders, {len(self.crossings)} crossings"
        )


@exclusive
def build_map(
    problem: Problem,
    resolution: int = 200,
    window: Window | None = None,
    progress: Callable[[str], None] | None = None,
    uniqueness_margin: float = UNIQUENESS_MARGIN,
) -> FormationMap:
    """Build the contact-formation map of a problem's scene.

    Parameters
    ----------
    problem            its phases determine the default window
    resolution         grid points in each direction, at least 10; borders do not depend on it
    window             by default that of `choose_window`
    uniqueness_margin  least uniqueness margin of contact forces (`mechanics.uniqueness`)

    Raises
    ------
    InputError  if a number is out of its range or nothing in the window can be reached
    """
    if resolution < 10:
        raise InputError("", "resolution", f"{resolution!r} given; allowed is 10 or more")
    limit = UNIQUENESS.read(uniqueness_margin, UNIQUENESS.name)
    scene, report = problem.scene, progress or (lambda text: None)
    report("map: cells")
    window = window or choose_window(problem)
    x, phi = np.linspace(*window.x, resolution), np.linspace(*window.phi, resolution)
    labels, obstacle = label_grid(scene, x, phi)
    rows, cell = np.unique(labels[..., [0, 2, 4]][obstacle == 0], axis=0, return_inverse=True)
    if not len(rows):
        raise InputError(problem.source, "", "the fingers reach the object nowhere in the window")
    cells = -obstacle
    cells[obstacle == 0] = cell.ravel()
    report("map: borders")
    samples = round(100 * max(1.0, window.phi[1] - window.phi[0]))
    tracks = list(list_tracks(scene, window, samples))
    borders = _build_borders(problem, cut(scene, tracks, window), limit)
    report("map: crossings and directions")
    # Directions are checked at a lattice of places inside cells.
    ends = np.linspace(*window.x, 25), np.linspace(*window.phi, 25)
    centres = np.meshgrid(*((values[1:] + values[:-1]) / 2 for values in ends))
    places = np.column_stack([part.ravel() for part in centres])
    closed = close_fingers(scene, *places.T)
    inside = label_inside(scene, closed)
    free = inside[:, 0] != NOWHERE
    places, inside, z = places[free], inside[free], closed.z[free]
    labels, pose = inside[:, [0, 2, 4]], np.broadcast_to(np.eye(5)[[0, 2]], (len(z), 2, 5))
    kinematics = evaluate_each(scene, labels, z)
    matrix = np.concatenate([kinematics.A, pose], axis=1)
    regular = np.abs(np.linalg.det(matrix)) > REGULAR * scene.scales.length**2
    tangents = np.zeros((len(z), len(DIRECTIONS), 5))
    tangents[regular] = (np.linalg.inv(matrix[regular])[..., 3:] @ DIRECTIONS.T).swapaxes(1, 2)
    directions = _check_motions(problem, labels, z, kinematics, tangents, limit)
    formations = tuple(name_contacts(contact_table(scene), row) for row in rows)
    parts = cells, formations, tuple(borders), _find_crossings(scene, borders)
    return FormationMap(problem, x, phi, *parts, places, *directions)


def _build_borders(problem: Problem, pieces: Sequence[Piece], limit: float) -> list[Border]:
    """Borders of pieces, evaluated together (vectorized)."""
    if not pieces:
        return []
    scene = problem.scene
    points = np.concatenate([np.column_stack(p.track.pose(p.places)) for p in pieces])
    z = close_fingers(scene, *points.T).z
    owner = np.repeat(np.arange(len(pieces)), [len(piece.places) for piece in pieces])
    # At an end, rounding may keep a finger from closing.
    closed = np.isfinite(z).all(axis=1)
    points, z, owner = points[closed], z[closed], owner[closed]
    labels = np.array([piece.label for piece in pieces])[owner]
    flush = np.array([piece.track.flush is not None for piece in pieces])[owner]
    on_palm = [piece.track.flush is not None and piece.track.flush[0] is None for piece in pieces]
    along = ["x" if palm else "phi" for palm in on_palm]
    flags = np.zeros((3, len(z)), dtype=bool)
    if flush.any():
        rows = np.array([ROWS[name] for name in along])[owner[flush]]
        four_labels = labels[flush][labels[flush] != NOWHERE].reshape(-1, 4)
        kinematics = evaluate_each(scene, four_labels, z[flush])
        weights = np.sqrt(metric_weights(scene))
        _, sizes, right_vectors = np.linalg.svd(kinematics.A / weights)
        z_s = right_vectors[:, -1] / weights
        z_s *= np.where(z_s[np.arange(len(rows)), rows] < 0, -1.0, 1.0)[:, None]
        z_s[~(sizes[:, -1] > REGULAR * sizes[:, 0])] = 0.0
        tangents = np.stack([z_s, -z_s], axis=1)
        checked = _check_motions(problem, four_labels, z[flush], kinematics, tangents, limit)
        possible, flags[2, flush] = checked
        flags[:2, flush] = possible.T
    table, borders = contact_table(scene), []
    for index, piece in enumerate(pieces):
        selected = owner == index
        contacts = name_contacts(table, piece.label[piece.label != NOWHERE])
        curve = along[index], points[selected], z[selected]
        borders.append(Border(contacts, piece.track.flush, *curve, *flags[:, selected]))
    return borders


def _find_crossings(scene: Scene, borders: list[Border]) -> tuple[Crossing, ...]:
    """Places where ends of borders meet with five or more contacts in all."""
    ends = [(border, k) for border in borders for k in (0, -1)]
    points = np.array([border.points[k] for border, k in ends]).reshape(-1, 2)
    size = 3e-5 * np.array([scene.scales.length, 1.0])
    table = contact_table(scene)
    crossings, unassigned = [], np.ones(len(points), dtype=bool)
    for k in range(len(points)):
        if not unassigned[k]:
            continue
        same = unassigned & (np.abs(points - points[k]) < size).all(axis=1)
        unassigned &= ~same
        meeting_borders = [ends[i][0] for i in np.flatnonzero(same)]
        all_contacts = {contact for border in meeting_borders for contact in border.contacts}
        if len(all_contacts) < 5:
            continue
        border, end = ends[k]
        z = border.z[end]
        # If the first contact of a finger jumps across its joint, not all contacts touch at once.
        label = sorted(table.index(contact) for contact in all_contacts)
        gaps = np.abs(evaluate_each(scene, np.array([label]), z[None]).C[0])
        contacts = tuple(table[k] for k in np.array(label)[gaps < scene.touching])
        if len(contacts) >= 5:
            edges = tuple(dict.fromkeys(b.flush for b in meeting_borders if b.flush is not None))
            crossings.append(Crossing(points[k], z, contacts, edges))
    return tuple(crossings)


def _check_motions(
    problem: Problem, labels: Numbers, z: Array, kinematics: Kinematics, paths: Array, limit: float
) -> tuple[Flags, Flags]:
    """Whether quasistatic motions on `paths`, tangents (n, k, 5), are feasible, (n, k).

    And whether another one would be, (n,), if its contact forces were unique: their uniqueness
    margin is below the `limit`. Zero tangents are skipped.
    """
    scene, regular = problem.scene, paths.any(axis=(1, 2))
    balanced, unique = np.zeros((2, *paths.shape[:2]), dtype=bool)
    for k, z_s in enumerate(paths.swapaxes(0, 1)):
        points, signs_all = CurvePoint(z, z_s, 0 * z, kinematics), Directions.of(kinematics, z_s)
        for formation, selected in group_labels(scene, labels):
            rows = np.flatnonzero(selected & regular)
            if formation.n_constraints == 3:
                wrench = force_rows(formation, kinematics, signs_all)[rows, :, :3]
                rows = rows[np.abs(np.linalg.det(wrench)) > REGULAR * scene.scales.length]
            point, directions = points.pick(rows), Directions(*(signs[rows] for signs in signs_all))
            forces = inverse(formation, point, directions)
            limits = InternalForceLimits.of(formation, forces, point.z_s[:, 3:])
            zeros = np.zeros(len(rows))
            low, high = limits.find_span(zeros, zeros, problem.epsilon)
            balanced[rows, k] = low <= high
            minors = find_minors(formation, point.kinematics, directions.Xi)
            unique[rows, k] = minors.ratios >= limit
    return balanced & unique, np.any(balanced & ~unique, axis=1)


@exclusive
def choose_window(problem: Problem, phi_deg: tuple[float, float] | None = None) -> Window:
    """Window of all x within reach, and of phi up to the flush angles around the phases.

    With `phi_deg`, phi is in this range [deg]. InputError if both fingers reach the object nowhere.
    """
    scene = problem.scene
    if phi_deg is not None:
        low, high = np.radians(phi_deg).tolist()
    else:
        angles = [float(problem.start[2])]
        angles += [float(phi) for path in trace_problem(problem) for phi in path[[0, -1], 1]]
        angles += [v for p in problem.phases for row, v in p.until.poses if row == ROWS["phi"]]
        angles += [goal.find_angle(scene, angles[-1]) for goal in problem.goals]
        low, high = min(angles), max(angles)
        flush_angles = Window((0.0, 0.0), (low - 2 * np.pi, high + 2 * np.pi)).flush_angles(scene)
        flush = np.array([angle for angle, _ in flush_angles])
        # An edge that is flush at an end of the plan does not count.
        before, after = flush[flush < low - 1e-6].max(), flush[flush > high + 1e-6].min()
        # The margin excludes further flush angles.
        margin = min(math.radians(6.0), float(after - before) / 8)
        low, high = float(before) - margin, float(after) + margin
    left, right = find_reach(scene)
    grid = np.linspace(left, max(left, right), 60)
    _, obstacle = label_grid(scene, grid, np.linspace(low, high, 60))
    feasible = grid[(obstacle == 0).any(axis=0)]
    if not len(feasible):
        raise InputError(problem.source, "fingers", "nowhere do both reach the object")
    step = grid[1] - grid[0]
    return Window((float(feasible[0] - step), float(feasible[-1] + step)), (low, high))


def label_grid(scene: Scene, x: Array, phi: Array) -> tuple[Numbers, Numbers]:
    """Labels (n_phi, n_x, 6) and obstacles (n_phi, n_x), 0 or as in `FormationMap.cell`."""
    shape, places = (len(phi), len(x)), [part.ravel() for part in np.meshgrid(x, phi)]
    closed = close_fingers(scene, *places)
    codes = np.where(closed.obstacle > 0, 2 * closed.obstacle - 1 + np.array([0, 1]), 0)
    obstacle = np.where(codes[:, 0] > 0, codes[:, 0], codes[:, 1])
    return label_inside(scene, closed).reshape(*shape, 6), obstacle.reshape(shape)


def time_borders(problem: Problem, borders: Sequence[Border]) -> Array:
    """Estimated least times along n borders with a flush edge, end to end, (n, 2) [s].

    In both directions: with the coordinate `along` increasing, and decreasing. Infinite if no
    motion keeps the limits, friction jams or contact forces are not unique. Limits are enforced at
    one place of each interval, with any internal force.
    """
    if not borders:
        return np.zeros((0, 2))
    scene, weights = problem.scene, metric_weights(problem.scene)
    (steps, places, fractions), table = make_cosine_grid(NODES), contact_table(scene)
    samples = []
    for points in (path for border in borders for path in (border.z, border.z[::-1])):
        chords = np.diff(points, axis=0)
        arcs = np.append(0.0, np.cumsum(np.sqrt(chords**2 @ weights)))
        s = places * arcs[-1]
        z = interpolate(s, arcs, points)
        samples.append((z, chords[np.searchsorted(arcs, s) - 1], np.full((len(s), 1), arcs[-1])))
    z, chord, length = (np.concatenate(column) for column in zip(*samples, strict=True))
    indices = [[table.index(contact) for contact in border.contacts] for border in borders]
    labels = np.repeat(np.array(indices), 2 * NODES, axis=0)
    # One Newton step closes the contacts of interpolated configurations.
    at = evaluate_each(scene, labels, z)
    z -= (np.linalg.pinv(at.P) @ at.C[..., None])[..., 0]
    tangent = chord / np.sqrt(chord**2 @ weights)[:, None]
    at = evaluate_each(scene, labels, z, tangent)
    z_s, z_ss = solve_tangent(at.P, at.P_dot_v, tangent, weights)
    # The path parameter is s over the length.
    curve, durations = CurvePoint(z, length * z_s, length**2 * z_ss, at), np.empty(2 * len(borders))
    for formation, selected in group_labels(scene, labels):
        point = curve.pick(selected)
        directions = Directions.of(point.kinematics, point.z_s)
        forces = inverse(formation, point, directions)
        limits = make_limits(formation, problem.epsilon)
        rows, cap = PathLimits.of(limits, forces, point.z_s[:, 3:], RELAXATION).eliminate()
        inertia = reduced_inertia(formation, point.kinematics, directions)
        ratios = find_minors(formation, point.kinematics, directions.Xi).ratios
        # b <= 0: no motion.
        infeasible = ~(inertia > 0) | (ratios < UNIQUENESS_MARGIN)
        rows[infeasible], cap[infeasible] = 0.0, 0.0
        path_limits = PathLimits(rows.reshape(-1, NODES, *rows.shape[1:]), cap.reshape(-1, NODES))
        motion = speed_sweep(path_limits, steps, fractions, sweeps=2)
        durations[selected[::NODES]] = motion.find_durations(steps)
    return durations.reshape(-1, 2)
