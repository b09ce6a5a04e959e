"""A motion as what is drawn of it: outlines, and where contacts are and push at each instant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.elemental import build_features, build_geometry, parse_contact
from ..figures.data import find_steps
from ..figures.style import FINGERS, choose_styles
from ..problem.definition import Problem
from ..results.trajectory import Trajectory
from ..scene.model import Scene

_DIGITS = 6
"""Significant digits of numbers in a page: more than a screen shows."""


class Pushes(NamedTuple):
    """Where contacts are, and what they do to the object.

    Attributes
    ----------
    points : ndarray, shape (n, m, 2), [m]
    normals : ndarray, shape (n, m, 2)
        Into the object.
    forces : ndarray, shape (n, m, 2), [N]
        c_n n + c_t t; NaN where a contact is not in the formation, or no force is known.
    """

    points: Array
    normals: Array
    forces: Array


@exclusive
def place_pushes(scene: Scene, trajectory: Trajectory) -> Pushes:
    """Contacts and their forces at the samples of a trajectory."""
    places = [build_geometry(parse_contact(name, scene), scene) for name in trajectory.contacts]
    rows = [ca.vertcat(own.point, own.normal) for own in places]
    evaluate = ca.Function("places", [build_features(scene).z], [ca.vertcat(*rows)])
    values = evaluate(trajectory.z.T).full().T.reshape(len(trajectory.t), -1, 4)
    points, normals = values[..., :2], values[..., 2:]
    tangents = np.stack([normals[..., 1], -normals[..., 0]], axis=-1)
    forces = trajectory.c_n[..., None] * normals + trajectory.c_t[..., None] * tangents
    return Pushes(points, normals, forces)


def describe_motion(
    trajectory: Trajectory, problem: Problem, ghost: Trajectory | None = None
) -> dict[str, Any]:
    """Everything that a page needs to play a motion, as plain values.

    Parameters
    ----------
    trajectory : Trajectory
    problem : Problem
        Its scene and epsilon.
    ghost : Trajectory, optional
        Another motion of the same hand, drawn behind: a replay.
    """
    scene, pushes = problem.scene, place_pushes(problem.scene, trajectory)
    styles = choose_styles(trajectory.contacts)
    contacts = [
        {
            "name": name,
            "colour": styles[name].colour,
            "dashes": _list_dashes(styles[name].line),
            "friction": scene.friction.of(parse_contact(name, scene).finger),
            "point": _round(pushes.points[:, index]),
            "normal": _round(pushes.normals[:, index]),
            "force": _round(pushes.forces[:, index]),
            "c_n": _round(trajectory.c_n[:, index]),
        }
        for index, name in enumerate(trajectory.contacts)
    ]
    return describe_hand(scene) | {
        "epsilon": problem.epsilon,
        "t": _round(trajectory.t),
        "z": _round(trajectory.z),
        "tau": _round(trajectory.tau),
        "phase": trajectory.phase.tolist(),
        "starts": _round(trajectory.phase_starts),
        "steps": find_steps(trajectory).tolist(),
        "contacts": contacts,
        "ghost": None if ghost is None else {"t": _round(ghost.t), "z": _round(ghost.z)},
    }


def describe_hand(scene: Scene) -> dict[str, Any]:
    """The object and the fingers, as plain values."""
    return {
        "vertices": scene.polygon.vertices.tolist(),
        "fingers": [
            {
                "base": np.asarray(finger.base).tolist(),
                "length": finger.length,
                "radius": finger.radius,
                "limit": finger.torque_limit,
                "colours": colours,
            }
            for finger, colours in zip(scene.fingers, FINGERS, strict=True)
        ],
    }


def _list_dashes(line: Any) -> Sequence[float]:
    """Lengths of dashes and gaps of one of Matplotlib's line styles; none where it is solid."""
    return [] if isinstance(line, str) else list(line[1])


def _round(values: Array) -> Any:
    """Nested lists of numbers that are short as text, None where there is no number."""
    flat: list[Any] = [
        None if v != v else float(f"{v:.{_DIGITS}g}") for v in values.ravel().tolist()
    ]
    for size in values.shape[:0:-1]:
        flat = [flat[k : k + size] for k in range(0, len(flat), size)]
    return flat
