"""Curve of a phase as an ordinary differential equation with events, apart from the planner.

It knows neither C-functions nor limits of formations: contacts are those of
`verification.newton_euler`, distances are by separating axes. The motion ends where a contact
leaves the feature that it slides on, where two bodies run into each other, or at the phase's
`until`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from ...common.arrays import Array
from ...problem.definition import Phase
from ...scene.model import Scene
from ...verification.newton_euler import dot, link_axis, locate, norm, place_object

OVERLAP = 1e-6
"""Overlap over the radius of gyration from which on two bodies count as running into each other."""


class Trace(NamedTuple):
    """A curve of configurations that keep a phase's contacts closed."""

    place: Callable[[Array], Array]  # configurations, shape (5, n), at arc lengths
    length: float  # [m]
    end: Array  # (5,)
    tangents: Callable[[Array], Array]  # unit tangents along the way, shape (n, 5), from (n, 5)
    ending: str  # what ends it
    reached: bool  # whether that is the phase's `until`


def follow(scene: Scene, phase: Phase, z: Array) -> tuple[Trace, Trace]:
    """Follow a phase's contacts from `z`, shape (5,), both ways."""

    def equations(z: Array) -> tuple[Array, Array]:
        gaps, rows = constrain(scene, phase, z[None])
        return gaps[0], rows[0, : gaps.shape[1]]

    closed = project(scene, z, equations)
    z = z if closed is None else closed
    return _march(scene, phase, z, 1.0), _march(scene, phase, z, -1.0)


def weights(scene: Scene) -> Array:
    """Diagonal of the metric, shape (5,): an angle counts as it moves the object's rim [1, m^2]."""
    return np.array([1.0, 1.0, *[scene.scales.length**2] * 3])


def project(
    scene: Scene, z: Array, equations: Callable[[Array], tuple[Array, Array]]
) -> Array | None:
    """Nearest zero of equations to `z`, by Newton's method; None if none.

    Parameters
    ----------
    equations  their values, shape (m,), and rows of their Jacobian, (m, 5)
    """
    scale, size = np.sqrt(weights(scene)), scene.scales.length
    for _ in range(20):
        miss, rows = equations(z)
        step = -np.linalg.pinv(rows / scale, rcond=1e-10) @ miss / scale
        z = z + step
        if np.abs(step * scale).max() < 1e-13 * size:
            break
    return z if np.abs(equations(z)[0]).max() < 1e-9 * size else None


def constrain(scene: Scene, phase: Phase, z: Array) -> tuple[Array, Array]:
    """Gaps, shape (n, n_c), and rows of the constraints, (n, n_c + R, 5), at configurations."""
    touches = [locate(scene, name, z) for name in phase.formation.names]
    rows = [t.normal for t in touches] + [touches[k].tangent for k in phase.formation.rolling_rows]
    return np.stack([touch.gap for touch in touches], axis=1), np.stack(rows, axis=1)


def _march(scene: Scene, phase: Phase, z: Array, way: float) -> Trace:
    """Integrate the unit tangent up to the first event."""
    size, until, scale = scene.scales.length, phase.until, np.sqrt(weights(scene))

    def tangents(z: Array) -> Array:
        # Cofactors of the four rows: unlike null vectors of an SVD they keep their sense.
        rows = constrain(scene, phase, z)[1] / scale
        minors = [way * (-1) ** k * np.linalg.det(np.delete(rows, k, axis=2)) for k in range(5)]
        found = np.stack(minors, axis=1)
        size = np.maximum(np.linalg.norm(found, axis=1), 1e-300)[:, None]
        return np.asarray(found / size / scale)

    def find_room(z: Array) -> dict[str, float]:
        touches = {f"{n} leaves": locate(scene, n, z[None]) for n in phase.formation.names}
        room = {name: float(gap[0]) for name, gap in clearances(scene, z[None]).items()}
        return room | {name: float(min(t.low[0], t.high[0])) for name, t in touches.items()}

    def overlap(_: float, z: Array) -> float:
        return min(find_room(z).values()) + OVERLAP * size

    def end(_: float, z: Array) -> float:
        if until.contact is not None or until.value is None:
            return 1.0
        return float(z[0 if until.coordinate == "x" else 2] - until.value)

    overlap.terminal, overlap.direction, end.terminal = True, -1.0, True  # type: ignore[attr-defined]
    run: Any = solve_ivp(
        lambda _, z: tangents(z[None])[0],
        (0.0, 60.0 * size),  # several turns of the object
        z,
        rtol=1e-9,
        atol=1e-10 * size / scale,
        max_step=0.02 * size,
        dense_output=True,
        events=(overlap, end),
    )
    last = run.y[:, -1]
    text = "nothing happens" if run.status == 0 else "the contacts become dependent"
    met = run.status == 1 and len(run.t_events[1]) > 0
    if run.status == 1 and not met:
        text = ", ".join(k for k, room in find_room(last).items() if room < -OVERLAP * size / 2)
        if until.contact is not None:
            touch, near = locate(scene, until.contact.name, last[None]), 1e-5 * size
            met = bool(max(abs(touch.gap[0]), -touch.low[0], -touch.high[0]) <= near)
    return Trace(run.sol, float(run.t[-1]), last, tangents, str(until) if met else text, met)


def resample(scene: Scene, phase: Phase, trace: Trace, count: int) -> tuple[Array, Array, Array]:
    """The curve at even places, and also where a contact or a joint turns.

    Returns
    -------
    s : (n,) [m]     arc length
    z, z_s : (n, 5)  configurations, and unit tangents along the way
    """

    def slide(s: Array) -> Array:
        z = trace.place(s).T
        return slides(scene, phase, z, trace.tangents(z))

    s = np.linspace(0.0, trace.length, count)
    rates = slide(s)
    rates[np.abs(rates) < 1e-9 * np.abs(rates).max()] = 0.0
    turns = [
        brentq(lambda x, row=row: slide(np.array([x]))[0, row], s[k], s[k + 1])
        for k, row in zip(*np.nonzero(rates[1:] * rates[:-1] < 0), strict=True)
    ]
    s = np.unique([*s, *turns])
    s = s[np.append(True, np.diff(s) > 1e-9 * scene.scales.length)]
    z = trace.place(s).T
    return s, z, trace.tangents(z)


def slides(scene: Scene, phase: Phase, z: Array, z_s: Array) -> Array:
    """Rates of sliding of the contacts and of the joints along z_s, shape (n, n_c + 2)."""
    rows = [(locate(scene, n, z).tangent * z_s).sum(axis=1) for n in phase.formation.names]
    return np.column_stack([*rows, z_s[:, 3:]])


def clearances(scene: Scene, z: Array) -> dict[str, Array]:
    """Signed distances [m] of every solid pair at n configurations, each of shape (n,).

    Exact where a pair overlaps by a little or faces flat to vertex; elsewhere a lower bound of the
    distance, with the right sign. The palm does not stop a link.
    """
    corners, bones = place_object(scene, z), list[Array]()
    apart = {"object and palm": corners[..., 1].min(axis=1)}
    for finger, link in enumerate(scene.fingers):
        base = np.broadcast_to(np.asarray(link.base), (len(z), 2))
        bones.append(np.stack([base, base + link.length * link_axis(scene, z, finger)], axis=1))
        gap = separate(corners, bones[finger]) - link.radius
        apart[f"object and finger {finger + 1}"] = gap
    if scene.fingers_collide:
        thick = sum(link.radius for link in scene.fingers)
        apart["finger 1 and finger 2"] = separate(*bones) - thick
    return apart


def separate(first: Array, second: Array) -> Array:
    """Signed distance of convex polygons or segments, shape (n, k, 2) and (n, m, 2), as (n,).

    Positive: the distance. Negative: minus the depth of the overlap.
    """
    depth = np.maximum(_reach(first, second), _reach(second, first))
    distance = np.minimum(_nearest(first, second), _nearest(second, first))
    return np.where(depth > 0, distance, depth)


def _reach(first: Array, second: Array) -> Array:
    """Largest gap along the normals of the first body's edges, both ways for a segment."""
    along = np.roll(first, -1, axis=1) - first
    along = along / np.maximum(norm(along), 1e-300)[..., None]
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    other = np.einsum("nkd,nmd->nkm", outward, second).min(axis=2)
    return np.asarray((other - dot(outward, first)).max(axis=1))


def _nearest(points: Array, body: Array) -> Array:
    """Least distance of the points of one body to the edges of another, shape (n,)."""
    along = np.roll(body, -1, axis=1) - body
    apart = points[:, :, None] - body[:, None]
    square = np.maximum(dot(along, along), 1e-300)
    share = np.clip(dot(apart, along[:, None]) / square[:, None], 0.0, 1.0)
    return np.asarray(norm(apart - share[..., None] * along[:, None]).min(axis=(1, 2)))
