"""Slip coordinates: how far an object has slid on palm or link, which rolling contacts keep."""

from __future__ import annotations

import casadi as ca

from ..common.arrays import Expression
from ..scene.model import Scene
from .elemental import Contact, build_features


def build_slip(contact: Contact, scene: Scene) -> Expression:
    """Return the slip coordinate of `contact` [m], an expression of the features' symbol z.

    Its time derivative is v_t for as long as the contact touches: how far the object has slid along
    t on the palm or the link. What a contact has to keep when it rolls is a constant, therefore:

    * vertex on the palm: x of the vertex;
    * vertex on the side of a link: how far along the link it is, positive towards the tip for
      finger 1, whose tangent is the link's axis, and towards the joint for finger 2;
    * tip on an edge: less how far along the edge the tip is, less the arc on which it has rolled;
    * vertex on the arc of a tip: less the arc from the link's axis to the vertex.
    """
    features = build_features(scene)
    if contact.finger is None:
        return features.vertices[0, contact.index]
    i, link, z = contact.index, features.links[contact.finger], features.z
    radius = scene.fingers[contact.finger].radius
    side = 1.0 if contact.finger == 0 else -1.0
    if contact.surface == "finger":
        return side * link.vertex_run[i]
    if contact.feature == "e":
        return -link.edge_run[i] - radius * (z[2] - z[3 + contact.finger])
    across = side * (link.vertex_gap[i] + radius)
    return -radius * ca.atan2(across, link.arc_run[i])
