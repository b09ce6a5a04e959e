"""Scaling of problems, options and stages to the scene's own units, and back.

Length is the object's radius of gyration, force its weight, mass its mass; time follows
(`scene.model.Scales`). Tolerances and guesses of the time domain are in these.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from ...common.arrays import Array
from ...common.fields import keys_of
from ...contacts.formation import Formation
from ...problem.definition import Phase, Problem
from ...problem.uncertainty import PARAMETERS
from ...scene.model import Scales, Scene
from ...scene.polygon import Polygon
from ..options import Objective, PlanOptions
from .stage import Stage


@lru_cache(maxsize=16)
def in_own_units(problem: Problem) -> Problem:
    """The problem in its scene's own units; the same object every time."""
    scales = problem.scene.scales
    scene = _scale_scene(problem.scene, scales)
    phases = tuple(_scale_phase(phase, scene, scales) for phase in problem.phases)
    return replace(
        problem,
        scene=scene,
        epsilon=problem.epsilon / scales.force,
        start=scale_state(problem.start, scales),
        phases=phases,
        table={},
    )


def _scale_scene(scene: Scene, scales: Scales) -> Scene:
    body = scene.polygon
    assert body.inertia is not None
    polygon = Polygon(
        body.vertices / scales.length, body.mass / scales.mass, body.inertia / scales.inertia
    )

    def scale(owner: Any) -> dict[str, Any]:
        known = keys_of(owner).items()
        units = {name: getattr(scales, own.scale) for name, own in known if own.scale}
        return {name: getattr(owner, name) / unit for name, unit in units.items()}

    right, left = (replace(finger, **scale(finger)) for finger in scene.fingers)
    return replace(scene, polygon=polygon, fingers=(right, left), **scale(scene))


def _scale_phase(phase: Phase, scene: Scene, scales: Scales) -> Phase:
    until = phase.until
    if until.coordinate == "x" and until.value is not None:
        until = replace(until, value=until.value / scales.length)
    formation = Formation(scene, phase.formation.contacts, phase.formation.rolling)
    units = {"x": scales.length, "phi": 1.0}
    # With one freedom nothing is left for pins to say.
    pins = () if formation.n_constraints >= 4 else until.pins
    until = replace(until, pins=tuple((name, own / units[name]) for name, own in pins))
    return replace(phase, formation=formation, until=until)


def scale_state(z: Array, scales: Scales) -> Array:
    """Configurations, shape (..., 5), in own units."""
    return np.asarray(z / unit_lengths(scales))


def scale_options(options: PlanOptions, scales: Scales) -> PlanOptions:
    """Options in own units."""
    lengths = {own.name for own in PARAMETERS if own.unit == "m"}
    ranges = {
        name: radius / scales.length if name in lengths else radius
        for name, radius in options.ranges.items()
    }
    return replace(options, time_weight=options.time_weight / scales.torque**2, ranges=ranges)


def unit_of(goal: Objective, scales: Scales) -> float:
    """Unit of an objective in SI units."""
    efforts = scales.torque**2 * scales.time
    return {Objective.TIME: scales.time, Objective.EFFORT: efforts}.get(goal, scales.force)


def unit_lengths(scales: Scales) -> Array:
    """Units of the coordinates of z in SI units, shape (5,)."""
    return np.array([scales.length, scales.length, 1.0, 1.0, 1.0])


def to_si(stage: Stage, problem: Problem) -> Stage:
    """A stage in SI units, of the same problem in SI units."""
    scales, part = problem.scene.scales, stage.guess
    lengths, unit = unit_lengths(scales), scales.time
    points = part._replace(
        duration=part.duration * unit,
        nodes=part.nodes * lengths / np.array([[1.0], [unit]]),
        z=part.z * lengths,
        v=part.v * lengths / unit,
        a=part.a * lengths / unit**2,
        forces=part.forces * scales.force,
        tau=part.tau * scales.torque,
        impulses=part.impulses * scales.force * unit,
    )
    formation = problem.phases[stage.phase].formation
    rolling = stage.formation.rolling
    if set(rolling) != set(formation.rolling):
        formation = _with_rolling(formation, rolling)
    return replace(stage, formation=formation, guess=points, gained=None)


@lru_cache(maxsize=64)
def _with_rolling(formation: Formation, rolling: tuple[object, ...]) -> Formation:
    contacts = tuple(contact for contact in formation.contacts if contact in rolling)
    return Formation(formation.scene, formation.contacts, contacts)
