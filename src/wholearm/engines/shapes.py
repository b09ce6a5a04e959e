"""A scene as the primitives that physics engines collide with, and the pairs that may touch.

Engines know no points and no lines, only balls and capsules of some radius. Those of the object get
a radius of `ROUNDING`, and what they touch is that much thinner, so that gaps are the C-functions:

============  ==========================  ===================  =====================================
shape         of                          radius               touches
============  ==========================  ===================  =====================================
``v3``        vertex 3                    r                    palm, both links
``e2``        edge 2                      r                    tips, circles about the joints
``finger1``   link 1, a capsule           radius - r           vertices, the other link
``tip1``      the tip's circle            radius - r           edges
``joint1``    the circle about the joint  radius - r           edges
``palm``      the half plane y <= -r                           vertices
============  ==========================  ===================  =====================================

Pairs have the friction of palm or finger. A tip that passes a vertex touches that and the ends of
both edges at one place. The links press each other without friction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..scene.model import Scene

ROUNDING = 1e-7  # Radius of vertices and edges, over the object's radius of gyration
OBJECT = "object"
LINKS = ("link1", "link2")  # Bodies that move
PALM = "palm"


@dataclass(frozen=True, eq=False)
class Shape:
    """A ball or a capsule on a body."""

    name: str
    body: str
    # (1, 2) or (2, 2) [m]: centre, or both ends of the axis; of the object relative to its centroid
    # at phi = 0, of a link relative to its joint at theta = 0
    points: Array
    radius: float  # [m]


@dataclass(frozen=True)
class Pair:
    """Two shapes, or a shape and the palm, that may touch; it has the name of their contact."""

    first: str
    second: str
    friction: float

    @property
    def name(self) -> str:
        """First and second, as contacts are named."""
        return f"{self.first}-{self.second}"


def find_rounding(scene: Scene) -> float:
    """Radius of vertices and edges [m]; the palm is that much lower."""
    return ROUNDING * scene.scales.length


def list_shapes(scene: Scene) -> list[Shape]:
    """Every shape of object and links.

    InputError if a link has no thickness: what sinks into it would come out on the other side.
    """
    r, corners = find_rounding(scene), scene.polygon.vertices
    after = np.roll(corners, -1, axis=0)
    shapes = [Shape(f"v{i}", OBJECT, corner[None], r) for i, corner in enumerate(corners)]
    shapes += [
        Shape(f"e{j}", OBJECT, np.array(ends), r)
        for j, ends in enumerate(zip(corners, after, strict=True))
    ]
    for number, (link, body) in enumerate(zip(scene.fingers, LINKS, strict=True), 1):
        if link.radius == 0:
            text = "0 given; engines need links of some thickness, 1e-4 of the length or more"
            raise InputError("", f"{link.name}.radius", text)
        axis = np.array([[0.0, 0.0], [link.length, 0.0]])
        shapes.append(Shape(f"finger{number}", body, axis, link.radius - r))
        shapes.append(Shape(f"tip{number}", body, axis[1:], link.radius - r))
        shapes.append(Shape(f"joint{number}", body, axis[:1], link.radius - r))
    return shapes


def list_pairs(scene: Scene) -> list[Pair]:
    """Every pair of shapes that may touch."""
    count = range(scene.polygon.n_vertices)
    pairs = [Pair(f"v{i}", PALM, scene.friction.palm) for i in count]
    for number, friction in enumerate((scene.friction.finger1, scene.friction.finger2), 1):
        pairs += [Pair(f"v{i}", f"finger{number}", friction) for i in count]
        pairs += [Pair(f"e{j}", f"tip{number}", friction) for j in count]
        pairs += [Pair(f"e{j}", f"joint{number}", friction) for j in count]
    if scene.fingers_collide:
        pairs.append(Pair("finger1", "finger2", 0.0))
    return pairs


def find_pairs(contact: str, corners: int) -> tuple[str, ...]:
    """Pairs of shapes of a contact; of a vertex on a tip's arc also both edges."""
    corner, part = contact.split("-")
    if corner[0] == "e" or not part.startswith("tip"):
        return (contact,)
    index, finger = int(corner[1:]), part[3:]
    edges = [f"e{k % corners}-tip{finger}" for k in (index - 1, index)]
    return (f"{corner}-finger{finger}", *edges)
