"""MuJoCo: a scene and a plan's torques as an MJCF file, written without MuJoCo, and replays in it.

Positions are z = (x, y, phi, theta_1, theta_2), with the start of the motion as the model's own
position and as the keyframe ``home``. `add_clock` describes the further elements of a plan.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from ..common.arrays import Array
from ..common.errors import require_number
from ..problem.definition import Problem
from ..results.adopt import MotionLike, adopt_motion
from ..results.torque import place_rows
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from . import engine_replay as engine

ANGLE_WEIGHT = 1e-6
"""Weight of a joint's angle in its tendon, over the scene's time; that of the clock is 1."""
RAMP_ERROR = 1e-3  # Largest error of the ramps, relative to the largest torque
CLOCK = "clock"
HIDDEN = {"group": 3}
"""Group of joints and actuators that have no sliders in MuJoCo's viewer by default."""
# In a convex contact model sliding separates the surfaces at a rate that falls with the time
# constant of friction and with the impedance.
GAP_STEPS = 7.5  # time constant of the gap (critically damped), in time steps
SLIDE_STEPS = 300.0  # time constant of the sliding speed, in time steps
IMPEDANCE = 0.01  # fraction of the unconstrained motion that a contact removes
RATIO = 100.0  # impedance of friction over that of the gap


def write_mjcf(
    problem: Problem,
    plan: Trajectory | MotionLike | None = None,
    *,
    step: float | None = None,
    softness: float = 1.0,
) -> str:
    """The scene as the text of an MJCF file.

    Parameters
    ----------
    plan        its torques are part of the model, and each of its phases has a keyframe at its
                start
    step : [s]  time step; that of `Setting` by default
    softness    factor of the time constants of contacts

    InputError if a link has no thickness, or a number is not positive.
    """
    scene, home = problem.scene, problem.start
    if plan is not None:
        problem, plan = adopt_motion(problem, plan)
        home = plan.z[0]
    root = Element("mujoco", model=problem.name)
    step = engine.Setting().step * scene.scales.time if step is None else step
    for name, number in (("step", step), ("softness", softness)):
        require_number(number, name, positive=True)
    _add_options(root, scene, step)
    world = add(root, "worldbody")
    reach = 10 * max(scene.polygon.size, *(link.length for link in scene.fingers))
    place, size = [0.0, -engine.find_rounding(scene), 0.0], [reach, reach, reach / 100]
    _add_geom(
        world, engine.PALM, "plane", pos=place, zaxis=[0, 1, 0], size=size, rgba=".6 .6 .6 .3"
    )
    _add_bodies(world, scene, home)
    contact = add(root, "contact")
    for pair in engine.list_pairs(scene):
        has_friction = pair.friction > 0
        add(
            contact,
            "pair",
            name=pair.name,
            geom1=pair.first,
            geom2=pair.second,
            condim="3" if has_friction else "1",
            friction=[pair.friction, pair.friction, 0, 0, 0] if has_friction else [1, 1, 0, 0, 0],
            solref=[softness * GAP_STEPS * step, 1.0],
            solreffriction=[softness * SLIDE_STEPS * step, 1.0],
            solimp=[IMPEDANCE, IMPEDANCE, 1.0],
        )
    motors = add(root, "actuator")
    for number, link in enumerate(scene.fingers, 1):
        # Controls contain the dry friction of the joint.
        limit = np.array([-1, 1]) * (link.torque_limit + link.dry)
        add(motors, "motor", name=f"motor{number}", joint=f"theta{number}", ctrlrange=limit)
    keys = add(root, "keyframe")
    if plan is None:
        add(keys, "key", name="home", qpos=home)
    else:
        add_clock(root, scene, plan, step)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_options(root: Element, scene: Scene, step: float) -> None:
    """Add units, solver, and settings of a viewer."""
    size, depth = scene.polygon.size, scene.polygon.size / 20
    add(root, "compiler", angle="radian", autolimits="true")
    # MuJoCo 4.0.0 factorises sparse Hessians wrongly; its midphase drops shapes this thin.
    solver_options = {"solver": "Newton", "jacobian": "dense", "integrator": "implicitfast"}
    gravity = [0.0, -scene.gravity, 0.0]
    accuracy = {"tolerance": 1e-12, "cone": "elliptic", "impratio": RATIO}
    option = add(root, "option", timestep=step, gravity=gravity, **accuracy, **solver_options)
    add(option, "flag", midphase="disable")
    add(root, "statistic", center=[0.0, size / 2, 0.0], extent=2 * size)
    visual = add(root, "visual")
    add(visual, "global", azimuth="90", elevation="-89.9")
    add(visual, "headlight", ambient=".5 .5 .5", diffuse=".4 .4 .4")
    points = [(*corner, side) for side in (-depth, depth) for corner in scene.polygon.vertices]
    add(add(root, "asset"), "mesh", name=engine.OBJECT, inertia="convex", vertex=points)


def _add_geom(body: Element, name: str, kind: str, **attributes: object) -> None:
    """Add a shape that touches only others in its pairs."""
    add(body, "geom", name=name, type=kind, contype="0", conaffinity="0", **attributes)


def _add_bodies(world: Element, scene: Scene, z: Array) -> None:
    """Add object and links at a configuration, shape (5,), on their joints."""
    polygon, (x, y, phi, *theta) = scene.polygon, z.tolist()
    body = add(world, "body", name=engine.OBJECT, pos=[x, y, 0.0])
    add(body, "inertial", pos=[0, 0, 0], mass=polygon.mass, diaginertia=[polygon.inertia] * 3)
    for axis, (name, kind) in enumerate((("x", "slide"), ("y", "slide"), ("phi", "hinge"))):
        add(body, "joint", name=name, type=kind, axis=np.eye(3)[axis], ref=z[axis])
    rotation = [0.0, 0.0, phi]
    _add_geom(body, engine.OBJECT, "mesh", mesh=engine.OBJECT, euler=rotation, rgba=".9 .7 .3 1")
    _add_shapes(body, scene, phi)
    for k, link in enumerate(scene.fingers):
        place = [*np.asarray(link.base), 0.0]
        # Links have no weight.
        body = add(world, "body", name=engine.LINKS[k], pos=place, gravcomp="1")
        # A uniform rod. In MuJoCo the stiffness of a contact depends on the motion of centres of
        # mass: with one at the joint, which does not move, contacts of light links are too stiff.
        middle = link.length / 2 * np.array([np.cos(theta[k]), np.sin(theta[k]), 0.0])
        rod = {"mass": 3 * link.inertia / link.length**2, "diaginertia": [link.inertia / 4] * 3}
        add(body, "inertial", pos=middle, **rod)
        hinge = {"axis": [0, 0, 1], "ref": theta[k], "damping": link.viscous}
        add(body, "joint", name=f"theta{k + 1}", type="hinge", **hinge)
        _add_shapes(body, scene, theta[k])


def _add_shapes(body: Element, scene: Scene, angle: float) -> None:
    """Add balls and capsules, rotated to their places at the model's own position."""
    c, s = np.cos(angle), np.sin(angle)
    for shape in engine.list_shapes(scene):
        if shape.body == body.get("name"):
            ends = np.pad(shape.points @ np.array([[c, s], [-s, c]]), ((0, 0), (0, 1)))
            kind, key = ("sphere", "pos") if len(ends) == 1 else ("capsule", "fromto")
            _add_geom(body, shape.name, kind, size=shape.radius, **{key: ends})


def add_clock(root: Element, scene: Scene, plan: Trajectory, step: float) -> None:
    """Add clock, tendons, springs, and a keyframe for the start and for each phase.

    At the start of a time step the lines between rows of torque have the mean over that step, so
    that torques that jump within a step have the right effect.
    """
    parts = {part.tag: part for part in root}
    rows = place_rows(engine.apply_friction(scene, plan), RAMP_ERROR)
    t, jumps = rows[:, 0] - step / 2, np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    t[jumps] -= step / 2
    t[jumps + 1] += step / 2
    # Rows that are nearer to a jump keep their order, at distances of a millionth of a step.
    t, tau = np.maximum.accumulate(t) + 1e-6 * step * np.arange(len(t)), rows[:, 1:]
    weight = ANGLE_WEIGHT * scene.scales.time
    rises = np.diff(tau, axis=0) / weight
    # The force that drives the clock is much larger than those of all springs.
    drive = 1e9 * (np.abs(rises).sum() + np.abs(tau[0]).sum() / weight + scene.scales.force)
    body = add(parts["worldbody"], "body", name=CLOCK)
    add(body, "inertial", pos=[0, 0, 0], mass=scene.scales.mass, diaginertia=[1, 1, 1])
    add(body, "joint", name=CLOCK, type="slide", axis=[0, 0, 1], damping=drive, **HIDDEN)
    tendons, springs = add(root, "tendon"), parts["actuator"]
    spring = {"gainprm": [0], "biastype": "affine", **HIDDEN}
    add(springs, "general", name=CLOCK, joint=CLOCK, biasprm=[drive, 0, 0], **spring)
    for k, name in enumerate(("torque1", "torque2")):
        tendon = add(tendons, "fixed", name=name)
        add(tendon, "joint", joint=CLOCK, coef=1)
        add(tendon, "joint", joint=f"theta{k + 1}", coef=weight)
        first = [tau[0, k] / weight, 0, 0]
        add(springs, "general", name=f"{name}-start", tendon=name, biasprm=first, **spring)
        for row in np.flatnonzero(rises[:, k]):
            rise, slope = rises[row, k], rises[row, k] / (t[row + 1] - t[row])
            ramp = {"biasprm": [-slope * t[row], slope, 0], "forcerange": sorted((0.0, rise))}
            add(springs, "general", name=f"{name}-{row}", tendon=name, **ramp, **spring)
    # Keyframes with positions, velocities and the clock.
    starts = plan.phase_starts[:-1]
    firsts = [int(np.flatnonzero(plan.phase == index)[0]) for index in range(len(starts))]
    names = ["home", *(f"phase{number}" for number in range(1, len(starts) + 1))]
    for name, k in zip(names, [0, *firsts], strict=True):
        state = {"qpos": [*plan.z[k], plan.t[k]], "qvel": [*plan.z_dot[k], 1.0]}
        add(parts["keyframe"], "key", name=name, time=plan.t[k], **state)


def add(parent: Element, tag: str, **attributes: object) -> Element:
    """Add an element to another; numbers are written with all their digits."""
    texts = {
        key: value
        if isinstance(value, str)
        else " ".join(format(x, ".17g") for x in np.ravel(np.array(value, dtype=float)))
        for key, value in attributes.items()
    }
    return ElementTree.SubElement(parent, tag, texts)


def play(
    problem: Problem, stretch: engine.EngineStretch, torque: engine.Drive, setting: engine.Setting
) -> engine.EngineRun:
    """Simulate a stretch in MuJoCo; an `Engine`."""
    import mujoco

    steps = engine.list_steps(problem, stretch, torque, setting.step)
    drive = steps.drive
    text = write_mjcf(problem, step=steps.h, softness=setting.softness)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    pairs = engine.list_pairs(problem.scene)
    # Numbers of the pairs by the numbers of their shapes, in either order.
    numbers = np.full((model.ngeom, model.ngeom), -1)
    for number, pair in enumerate(pairs):
        first, second = (model.geom(name).id for name in (pair.first, pair.second))
        numbers[first, second] = numbers[second, first] = number

    def collect(total: Array, find: Callable[[Any], Array]) -> None:
        """Add the values of `find` for rows of constraints to the totals of their pairs."""
        contact, active = data.contact, data.contact.efc_address >= 0
        pair = numbers[contact.geom1[active], contact.geom2[active]]
        np.add.at(total, pair, find(contact.efc_address[active]))

    def advance(start: int, end: int) -> Array:
        total = np.zeros(len(pairs))
        for step in range(start, end):
            tau = steps.tau[step]
            if drive is not None:
                tau = drive.step(step * steps.h, data.qpos[3:], data.qvel[3:])
            data.ctrl[:] = tau
            mujoco.mj_step(model, data)
            if data.ncon:
                collect(total, lambda rows: data.efc_force[rows])
        return total / (end - start)

    # MuJoCo computes stiffnesses from time constants and inertias; they are read at a small depth.
    data.qpos[:], stiffnesses = engine.penetrate_start(problem, stretch), np.zeros(len(pairs))
    mujoco.mj_forward(model, data)
    collect(stiffnesses, lambda k: data.efc_KBIP[k, 0] * data.efc_KBIP[k, 2] / data.efc_R[k])
    stiffness = dict(zip((pair.name for pair in pairs), stiffnesses.tolist(), strict=True))
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = engine.penetrate_start(problem, stretch, stiffness), steps.v
    # No warnings of states that are not finite, on stderr and in a file: the deviation has them.
    mujoco.set_mju_user_warning(lambda _: None)
    state = lambda: (data.qpos.copy(), data.qvel.copy())  # noqa: E731
    run = engine.record(stretch, steps, pairs, advance, state)
    mujoco.set_mju_user_warning(None)
    return run
