"""Replays in Drake, with its point contact model and the TAMSI solver.

`engine_replay.require_engine` imports this module where Drake is installed.
"""

from __future__ import annotations

import logging
from itertools import pairwise
from typing import Any

import numpy as np
from pydrake import geometry
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody import plant as multibody
from pydrake.multibody import tree
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from ..common.arrays import Array
from ..problem.definition import Problem
from ..scene.model import Scene
from . import engine_replay as engine

_STRIDE = 4  # steps between two readings of forces: oscillations of contacts last ten times as long


def play(
    problem: Problem, stretch: engine.EngineStretch, torque: engine.Drive, setting: engine.Setting
) -> engine.EngineRun:
    """Simulate a stretch in Drake; an `Engine`."""
    steps = engine.list_steps(problem, stretch, torque, setting.step, _STRIDE)
    drive, setting = steps.drive, setting._replace(step=steps.h / problem.scene.scales.time)
    # Drake warns of half spaces, which cannot touch deformable bodies.
    log = logging.getLogger("drake")
    level = log.level
    log.setLevel(logging.ERROR)
    diagram, plant, numbers = _build(problem.scene, steps.h, setting)
    simulator = Simulator(diagram)
    log.setLevel(level)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    pairs = engine.list_pairs(problem.scene)
    stiffness = dict.fromkeys((p.name for p in pairs), _find_stiffness(problem.scene, setting))
    plant.SetPositions(context, engine.penetrate_start(problem, stretch, stiffness))
    plant.SetVelocities(context, steps.v)
    simulator.Initialize()
    results, motors = plant.get_contact_results_output_port(), plant.get_actuation_input_port()

    def advance(start: int, end: int) -> Array:
        total, readings = np.zeros(len(pairs)), range(end, start, -_STRIDE)[::-1]
        for begin, stop in pairwise([start, *readings]):
            torques = steps.tau[begin:stop]
            if drive is not None:
                z, v = plant.GetPositions(context), plant.GetVelocities(context)
                tau = drive.step(begin * steps.h, z[3:], v[3:])
                torques = np.tile(tau, (stop - begin, 1))
            for step, tau in enumerate(torques, begin):
                motors.FixValue(context, tau)
                # Half a step more: the step at that time is complete then, in spite of rounding.
                simulator.AdvanceTo((step + 0.5) * steps.h)
            contact_results = results.Eval(context)
            for k in range(contact_results.num_point_pair_contacts()):
                info = contact_results.point_pair_contact_info(k)
                point_pair = info.point_pair()
                number = numbers[frozenset((point_pair.id_A, point_pair.id_B))]
                total[number] += abs(info.contact_force() @ point_pair.nhat_BA_W)
        return total / len(readings)

    def read() -> tuple[Array, Array]:
        return plant.GetPositions(context), plant.GetVelocities(context)

    return engine.record(stretch, steps, pairs, advance, read)


def _build(scene: Scene, h: float, setting: engine.Setting) -> tuple[Any, Any, dict[Any, int]]:
    """Diagram, plant with steps of h [s], and numbers of pairs by identities of their shapes."""
    builder = DiagramBuilder()
    plant, graph = multibody.AddMultibodyPlantSceneGraph(builder, h)
    # The default approximation, lagged, has errors of millimetres; TAMSI converges.
    plant.set_discrete_contact_approximation(multibody.DiscreteContactApproximation.kTamsi)
    plant.set_contact_model(multibody.ContactModel.kPoint)
    _add_bodies(plant, scene)
    pairs = _add_shapes(plant, graph, scene, setting)
    plant.Finalize()
    plant.set_stiction_tolerance(1e-5 * scene.scales.speed)
    return builder.Build(), plant, pairs


def _add_bodies(plant: Any, scene: Scene) -> None:
    """Object and links, without weight of the links, on their joints."""

    def add(name: str, mass: float, inertia: float) -> Any:
        unit = tree.UnitInertia(*3 * [inertia / mass])
        return plant.AddRigidBody(name, tree.SpatialInertia(mass, np.zeros(3), unit))

    polygon = scene.polygon
    assert polygon.inertia is not None
    body = add(engine.OBJECT, polygon.mass, polygon.inertia)
    plant.AddJoint(tree.PlanarJoint(engine.OBJECT, plant.world_frame(), body.body_frame()))
    for name, link in zip(engine.LINKS, scene.fingers, strict=True):
        link_body = add(name, link.inertia / link.length**2, link.inertia)
        place = RigidTransform([*np.asarray(link.base), 0.0])
        base = plant.AddFrame(tree.FixedOffsetFrame(f"{name} base", plant.world_frame(), place))
        frames = base, link_body.body_frame()
        joint = tree.RevoluteJoint(name, *frames, [0.0, 0.0, 1.0], link.viscous)
        plant.AddJointActuator(name, plant.AddJoint(joint))
    plant.mutable_gravity_field().set_gravity_vector([0.0, -scene.gravity, 0.0])


def _add_shapes(plant: Any, graph: Any, scene: Scene, setting: engine.Setting) -> dict[Any, int]:
    """Add balls, capsules and the palm; numbers of the pairs that may touch, by their shapes."""
    shapes = {shape.name: shape for shape in engine.list_shapes(scene)}
    geometry_ids: dict[tuple[str, float], Any] = {}

    def register(name: str, friction: float) -> Any:
        key = (name, friction)
        if key not in geometry_ids:
            if name == engine.PALM:
                low = [0.0, -engine.find_rounding(scene), 0.0]
                place = RigidTransform(RotationMatrix.MakeXRotation(-np.pi / 2), low)
                body, form = plant.world_body(), geometry.HalfSpace()
            else:
                body, (place, form) = plant.GetBodyByName(shapes[name].body), _place(shapes[name])
            # Twice the stiffness of a pair, for both of its shapes.
            material = geometry.ProximityProperties()
            geometry.AddContactMaterial(
                material,
                dissipation=1000.0 / scene.scales.speed,
                point_stiffness=2 * _find_stiffness(scene, setting),
                friction=multibody.CoulombFriction(friction, friction),
            )
            geometry_ids[key] = plant.RegisterCollisionGeometry(
                body, place, form, f"{name} {friction:g}", material
            )
        return geometry_ids[key]

    numbers = {}
    for number, pair in enumerate(engine.list_pairs(scene)):
        # Drake combines two frictions as 2 a b / (a + b), which is 2 b for a large a.
        friction1, friction2 = (1e12, pair.friction / 2) if pair.friction else (0.0, 0.0)
        ids = [register(pair.first, friction1), register(pair.second, friction2)]
        numbers[frozenset(ids)] = number
    manager = graph.collision_filter_manager()
    all_shapes = geometry.GeometrySet(list(geometry_ids.values()))
    manager.Apply(geometry.CollisionFilterDeclaration().ExcludeWithin(all_shapes))
    allowed = geometry.CollisionFilterDeclaration()
    for first, second in numbers:
        allowed.AllowBetween(geometry.GeometrySet(first), geometry.GeometrySet(second))
    manager.Apply(allowed)
    return numbers


def _find_stiffness(scene: Scene, setting: engine.Setting) -> float:
    """Stiffness of a pair: penetration of 6e-3 lengths under the scene's force [N/m]."""
    return scene.scales.force / (6e-3 * setting.step * setting.softness * scene.scales.length)


def _place(shape: engine.Shape) -> tuple[Any, Any]:
    """Pose of a ball or a capsule on its body, and its geometry."""
    middle = [*shape.points.mean(axis=0), 0.0]
    if len(shape.points) == 1:
        return RigidTransform(middle), geometry.Sphere(shape.radius)
    axis = shape.points[1] - shape.points[0]
    length = float(np.hypot(*axis))
    rotation = RotationMatrix.MakeFromOneVector([*(axis / length), 0.0], 2)
    return RigidTransform(rotation, middle), geometry.Capsule(shape.radius, length)
