"""A scene as a system: every feature of object, palm and links that may touch another.

==============  ====================================================  ========================
name            touching                                              gap
==============  ====================================================  ========================
``v3-palm``     vertex 3 and the palm                                 height of the vertex
``v3-finger1``  vertex 3 and the touching side of link 1              n . (p - base) - radius
``v3-back1``    vertex 3 and the far side of link 1                   -n . (p - base) - radius
``v3-tip1``     vertex 3 and the arc of tip 1                         abs(p - tip) - radius
``v3-joint1``   vertex 3 and the circle about joint 1                 abs(p - base) - radius
``e2-tip1``     edge 2 and tip 1                                      m . (tip - p_2) - radius
``e2-joint1``   edge 2 and the circle about joint 1                   m . (base - p_2) - radius
``tip1-back2``  tip 1 and a side of link 2, or its tip or joint; the  likewise, with both radii
                same with other numbers
==============  ====================================================  ========================

The links slide on each other without friction, as no coefficient is given for them.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.sharing import Store, exclusive
from ..contacts.elemental import build_features, rotate_quarter
from ..contacts.links import build_finger_gap
from ..contacts.obstacles import build_apart
from ..scene.model import Scene
from .system import Pair, System


def build_system(scene: Scene) -> System:
    """The hand and the object as a system with five coordinates, the same for equal scenes."""
    return _SYSTEMS(scene)


@exclusive
def measure_gaps(scene: Scene, z: Array) -> Array:
    """Least gaps of the bodies at n configurations, shape (n, 4) [m], negative where they overlap.

    Object and palm, object and links 1 and 2, link and link (infinite where they pass each other).
    They come by another way than those of the pairs: the largest separation in any direction.

    Parameters
    ----------
    z : ndarray, shape (n, 5)
    """
    features = build_features(scene)
    gaps = [ca.mmin(features.vertices[1, :]), *(build_apart(scene, k) for k in range(2))]
    gaps.append(build_finger_gap(scene) if scene.fingers_collide else ca.inf)
    function = ca.Function("gaps", [features.z], [ca.densify(ca.vertcat(*gaps))])
    return np.asarray(function(z.T).full().T)


def _build(scene: Scene) -> System:
    pairs = _list_palm(scene)
    for finger in range(2):
        pairs += _list_sides(scene, finger) + _list_ends(scene, finger)
    if scene.fingers_collide:
        pairs += _list_link_pairs(scene)
    return System(
        build_features(scene).z,
        scene.mass_diagonal,
        scene.applied_force,
        scene.viscous,
        scene.dry,
        (3, 4),
        tuple(pairs),
        (False, False, True, True, True),
        scene.scales,
    )


_SYSTEMS = Store(_build, lambda scene: (*scene.equations, scene.scales))


def _list_palm(scene: Scene) -> list[Pair]:
    p, mu = build_features(scene).vertices, scene.friction.palm
    return [
        Pair(f"v{i}-palm", p[1, i], p[0, i], mu, text=f"v{i} touches the palm")
        for i in range(p.shape[1])
    ]


def _list_sides(scene: Scene, finger: int) -> list[Pair]:
    """Vertices against both sides of a link."""
    link, part = build_features(scene).links[finger], scene.fingers[finger]
    mu, k = scene.friction.of(finger), finger + 1
    side = 1.0 if finger == 0 else -1.0
    # What touches a side between its ends has the whole object on that side, by convexity.
    middle = link.normal.T @ (build_features(scene).z[:2] - link.base)
    pairs = []
    for i in range(scene.polygon.n_vertices):
        run = link.vertex_run[i]
        for name, way, text in (("finger", 1.0, ""), ("back", -1.0, "the far side of ")):
            gap = way * (link.vertex_gap[i] + part.radius) - part.radius
            ranges = (run, part.length - run, way * middle)
            text = f"v{i} touches {text}finger {k}"
            pairs.append(Pair(f"v{i}-{name}{k}", gap, way * side * run, mu, ranges, text))
    return pairs


def _list_ends(scene: Scene, finger: int) -> list[Pair]:
    """Vertices and edges against the tip of a link and the circle about its joint."""
    features, part = build_features(scene), scene.fingers[finger]
    link, z, mu, k = features.links[finger], features.z, scene.friction.of(finger), finger + 1
    axis = (link.tip - link.base) / part.length
    along = ca.vertcat(features.edge_normals[1, :], -features.edge_normals[0, :])
    count, pairs = scene.polygon.n_vertices, []
    for name, centre, out in (("tip", link.tip, axis), ("joint", link.base, -axis)):
        far = ca.repmat(centre, 1, count) - features.vertices
        runs = ca.sum1(along * far)
        gaps = -ca.sum1(features.edge_normals * far) - part.radius
        for i in range(count):
            length = float(features.edge_lengths[i])
            slip = -runs[i] - part.radius * (z[2] - z[3 + finger])
            text = f"e{i} touches the {name} of finger {k}"
            ranges: tuple[Expression, ...] = (runs[i], length - runs[i])
            pairs.append(Pair(f"e{i}-{name}{k}", gaps[i], slip, mu, ranges, text))
            if part.radius == 0:
                continue
            away = -far[:, i]
            ahead, across = out.T @ away, rotate_quarter(out).T @ away
            before = (i - 1) % count
            beyond = runs[before] - float(features.edge_lengths[before])
            slip = -part.radius * ca.atan2(across, ahead)
            gap = ca.sqrt(ca.sumsqr(away)) - part.radius
            text = f"v{i} touches the {name} of finger {k}"
            ranges = (ahead, beyond, -runs[i])
            pairs.append(Pair(f"v{i}-{name}{k}", gap, slip, mu, ranges, text))
    return pairs


def _list_link_pairs(scene: Scene) -> list[Pair]:
    """Tips and joints of either link against the other link."""
    links = build_features(scene).links
    thick = sum(part.radius for part in scene.fingers)
    pairs = []
    for own, other in ((0, 1), (1, 0)):
        mine, theirs, part = links[own], links[other], scene.fingers[other]
        axis = (theirs.tip - theirs.base) / part.length
        for name, point, rest in (("tip", mine.tip, mine.base), ("joint", mine.base, mine.tip)):
            behind = theirs.normal.T @ (rest - theirs.base)
            run, level = axis.T @ (point - theirs.base), theirs.normal.T @ (point - theirs.base)
            for side, way in (("finger", 1.0), ("back", -1.0)):
                title = f"{name}{own + 1}-{side}{other + 1}"
                ranges = (run, part.length - run, way * behind)
                pairs.append(_slide(title, way * level - thick, ranges))
    if thick == 0:
        return pairs
    outs = [link.tip - link.base for link in links]
    ends = [("tip", link.tip, out) for link, out in zip(links, outs, strict=True)]
    joints = [("joint", link.base, -out) for link, out in zip(links, outs, strict=True)]
    for first, second in ((ends[0], ends[1]), (ends[0], joints[1]), (joints[0], ends[1])):
        run = second[1] - first[1]
        gap = ca.sqrt(ca.sumsqr(run)) - thick
        beyond = (first[2].T @ run, -(second[2].T @ run))
        pairs.append(_slide(f"{first[0]}1-{second[0]}2", gap, beyond))
    return pairs


def _slide(name: str, gap: Expression, ranges: tuple[Expression, ...]) -> Pair:
    return Pair(name, gap, ca.SX(0), 0.0, ranges, "finger 1 touches finger 2")
