"""HTML pages in one file that need no network: text, tables, pictures, players of motions."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from html import escape
from importlib import resources
from typing import Any

import numpy as np

from ..common.arrays import Array, Numbers, find_runs
from ..common.document import to_plain
from ..figures.style import FINGERS, choose_styles
from ..problem.definition import Problem
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from ..verification.newton_euler import locate


def build_page(title: str, parts: Iterable[str]) -> str:
    """A page of HTML of `parts`, from other functions of this module, with style and script."""
    folder = resources.files(__package__)
    style, script = (folder.joinpath(f"viewer.{kind}").read_text("utf-8") for kind in ("css", "js"))
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    head += f"<title>{escape(title)}</title><style>{style}</style>"
    body = "\n".join([f"<h1>{escape(title)}</h1>", *parts, f"<script>{script}</script>"])
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n'


def fold(content: str, title: str) -> str:
    """HTML that is collapsed under a title."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def write_player(motion: dict[str, Any]) -> str:
    """HTML of a player of a motion; see `describe_motion`."""
    return f'<div class="motion">{_embed(motion)}</div>'


def write_map(drawing: str, places: dict[str, Any]) -> str:
    """HTML of a map with places that can be clicked; see `report_page.describe_map`."""
    hint = "Click a cell, a border or a crossing to see what touches there."
    details = f'<div class="choice"><p>{hint}</p><div class="pose"></div></div>'
    map_box = f'<div class="scroll"><div class="map">{drawing}</div></div>'
    return f'<div class="chart">{map_box}{details}{_embed(places)}</div>'


def _embed(value: dict[str, Any]) -> str:
    """Values for a script as JSON, in which tags are escaped."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json">{text}</script>'


def describe_motion(
    trajectory: Trajectory, problem: Problem, ghost: Trajectory | None = None, most: int = 4000
) -> dict[str, Any]:
    """Data of a player for a motion of about `most` samples, with a replay in the background."""
    scene, styles = problem.scene, choose_styles(trajectory.contacts)
    steps = trajectory.find_steps()
    rows = _choose_rows(trajectory, steps, most)
    contacts = list[dict[str, Any]]()
    for index, name in enumerate(trajectory.contacts):
        touch = locate(scene, name, trajectory.z[rows])
        c = np.column_stack([trajectory.c_n[rows, index], trajectory.c_t[rows, index]])
        # When the contact presses: the first row, and from there on places, normals and forces.
        spans = [
            {
                "first": run.start,
                "point": round_z(touch.point[run], scene),
                "normal": round_z(touch.normal[run, :2], scene),
                "c": _round(c[run]),
            }
            for run in find_runs(np.isfinite(c).all(axis=1), min_length=2)
        ]
        dashes = [] if styles[name].line == "-" else list(styles[name].line[1])
        look = {"name": name, "colour": styles[name].colour, "dashes": dashes}
        contacts.append(look | {"friction": touch.friction, "spans": spans})
    background = None
    if ghost is not None:
        few = _choose_rows(ghost, steps[:0], most)
        background = {"t": _round(ghost.t[few]), "z": round_z(ghost.z[few], scene)}
    return describe_hand(scene) | {
        "epsilon": problem.epsilon,
        "t": _round(trajectory.t[rows]),
        "z": round_z(trajectory.z[rows], scene),
        "tau": _round(trajectory.tau[rows]),
        "phase": trajectory.phase[rows].tolist(),
        "starts": _round(trajectory.phase_starts),
        "steps": np.searchsorted(rows, steps).tolist(),
        "contacts": contacts,
        "ghost": background,
    }


def _choose_rows(trajectory: Trajectory, steps: Numbers, most: int) -> Numbers:
    """Rows to show: even ones, about `most`, ends of phases and both sides of steps."""
    count = len(trajectory.t)
    joints = np.flatnonzero(np.diff(trajectory.phase)) + 1
    ends = np.concatenate([[0, count - 1], joints - 1, joints, steps - 1, steps])
    return np.union1d(np.arange(0, count, -(-count // most)), ends).astype(np.int64)


def describe_hand(scene: Scene) -> dict[str, Any]:
    """Data of the object and the fingers, as plain values."""
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


def round_z(values: Array, scene: Scene) -> Any:
    """Nested lists of places, directions or angles [m, rad].

    They have 5 decimals for an object of a centimetre or more.
    """
    return np.round(values, max(5, 3 - math.floor(math.log10(scene.scales.length)))).tolist()


def _round(values: Array) -> Any:
    """Nested lists of numbers with six digits, None where there is no number."""
    return to_plain(np.reshape([float(f"{v:.6g}") for v in values.ravel().tolist()], values.shape))
