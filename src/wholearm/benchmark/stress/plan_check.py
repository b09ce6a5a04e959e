"""Independent check of plans at many instants: Newton, Euler, Coulomb, and overlaps."""

from __future__ import annotations

import numpy as np

from ...common.arrays import Array
from ...problem.definition import End, Phase, Problem
from ...results.trajectory import Samples, Trajectory
from ...scene.model import Scene
from ...verification.newton_euler import Touch, locate
from .event_tracing import clearances

ROUNDING = 1e-6  # what may be left of an equation, over the largest of its terms
OVERLAP = 1e-6  # overlap and open gaps that pass for rounding, over the radius of gyration
STILL = 1e-5  # speed over the scene's own below which friction may point either way


def check_plan(problem: Problem, plan: Trajectory) -> list[str]:
    """Sentences on what is wrong with a plan; none if nothing is."""
    found: list[str] = []
    before: Array | None = None
    for phase, motion, start in zip(problem.phases, plan.motions, plan.phase_starts, strict=False):
        # Some of the instants are in pieces of the torques that are short.
        breaks, duration = plan.torque.breaks - start, motion.duration
        ends = np.concatenate([[0.0], breaks[(breaks > 0.0) & (breaks < duration)], [duration]])
        runs = np.diff(ends)
        short = (runs > 1e-6 * duration) & (runs < duration / 200)
        inside = ends[:-1][short, None] + runs[short, None] * np.array([0.1, 0.5, 0.9])
        t = np.unique(np.concatenate([np.linspace(0.0, duration, 401), inside.ravel()]))
        rows = motion.evaluate(t)
        texts = _check_phase(problem, phase, rows)
        middles = motion.evaluate((t[1:] + t[:-1]) / 2)
        texts += check_rates(problem.scene, t, rows, middles)
        # The torques as functions of time are those of the motion, between their steps.
        near = np.abs((start + t)[:, None] - plan.torque.breaks).min(axis=1)
        miss = np.abs(plan.torque.at(start + t) - rows.tau)[near > 1e-9 * plan.duration]
        share = (miss / problem.scene.torque_limit).max(initial=0.0)
        texts += [f"the torque profile is {share:.2g} of the limit off"] if share > 1e-4 else []
        texts += _check_ends(problem, phase, before, rows)
        before = np.array([rows.z[-1], rows.z_dot[-1]])
        found += [f"phase {phase.number}: {text}" for text in texts]
    return found


def balance(
    scene: Scene, touches: list[Touch], motion: tuple[Array, Array], tau: Array, forces: Array
) -> Array:
    """What is left of Newton's and Euler's laws at n instants, shape (n, 5) [N, N m].

    Parameters
    ----------
    motion : (n, 5)           z' and z''
    tau : (n, 2) [N m]
    forces : (2, n, n_c) [N]  c_n and c_t
    """
    z_dot, z_ddot = motion
    rest = scene.mass_diagonal * z_ddot + scene.viscous * z_dot + scene.dry * np.sign(z_dot)
    rest = rest - scene.applied_force
    rest[:, 3:] -= tau
    for touch, c_n, c_t in zip(touches, forces[0].T, forces[1].T, strict=True):
        rest -= c_n[:, None] * touch.normal + c_t[:, None] * touch.tangent
    return np.asarray(rest)


def _check_phase(problem: Problem, phase: Phase, rows: Samples) -> list[str]:
    scene, names = problem.scene, phase.formation.names
    size, speed = scene.scales.length, scene.scales.speed
    fastest = max(speed, float(np.abs(rows.z_dot[:, :2]).max()))
    touches, texts = [locate(scene, name, rows.z) for name in names], []
    for name, touch in zip(names, touches, strict=True):
        separation = np.abs((touch.normal * rows.z_dot).sum(axis=1)).max()
        worst = {
            "gap": np.abs(touch.gap).max() / size / OVERLAP,
            "beyond its feature": -np.minimum(touch.low, touch.high).min() / size / OVERLAP,
            "rate of separation": separation / fastest / ROUNDING,
        }
        texts += [f"{what} of {name} is {v:.2g} of its bound" for what, v in worst.items() if v > 1]
    for pair, gap in clearances(scene, rows.z).items():
        if gap.min() < -OVERLAP * size:
            texts.append(f"{pair} overlap by {-gap.min():.3g} m")
    texts += _check_forces(problem, phase, rows, touches)
    motion, forces = (rows.z_dot, rows.z_ddot), np.stack([rows.c_n, rows.c_t])
    rest = np.abs(balance(scene, touches, motion, rows.tau, forces))
    # A joint that all but stands still is held by any dry friction up to its own.
    still = np.abs(rows.z_dot) < STILL * speed / np.append(np.ones(2), np.full(3, size))
    rest -= np.where(still, 2 * scene.dry, 0.0)
    arms = scene.scales.force * np.array([1.0, 1.0, size, size, size])
    biggest = np.maximum(np.abs(scene.mass_diagonal * rows.z_ddot).max(axis=0), arms)
    biggest[3:] = np.maximum(biggest[3:], np.abs(rows.tau).max(axis=0))
    excess = rest.max(axis=0) / biggest / ROUNDING
    for k in np.flatnonzero(excess > 1):
        row, at = ("x", "y", "phi", "theta_1", "theta_2")[k], int(rest[:, k].argmax())
        text = f"the equation of {row} misses {rest[at, k]:.3g} ({excess[k]:.2g} of its bound)"
        texts.append(f"{text} at instant {at}")
    return texts


def _check_forces(problem: Problem, phase: Phase, rows: Samples, touches: list[Touch]) -> list[str]:
    scene, texts = problem.scene, []
    force, speed = scene.scales.force, scene.scales.speed
    names, rolling = phase.formation.names, phase.formation.rolling_rows
    for k, (name, touch) in enumerate(zip(names, touches, strict=True)):
        c_n, c_t = rows.c_n[:, k], rows.c_t[:, k]
        # A normal force may lack what `verification.verify` allows.
        lack = problem.epsilon * (1 - 2e-3) - c_n.min()
        if lack > ROUNDING * force:
            texts.append(f"c_n of {name} is {lack:.3g} N short of epsilon")
        slip = (touch.tangent * rows.z_dot).sum(axis=1)
        scale = max(force, float(np.abs(c_n).max())) * ROUNDING * 10
        over = (np.abs(c_t) - touch.friction * c_n).max()
        if over > scale:
            texts.append(f"c_t of {name} is {over:.3g} N outside its friction cone")
        if k in rolling:
            if np.abs(slip).max() > 10 * STILL * speed:
                texts.append(f"{name} rolls, but slides at {np.abs(slip).max():.3g} m/s")
            continue
        moving = np.abs(slip) > STILL * speed
        wrong = np.where(moving, np.abs(c_t + touch.friction * np.sign(slip) * c_n), 0.0).max()
        if wrong > scale:
            texts.append(f"friction at {name} is {wrong:.3g} N off Coulomb's for its sliding")
    for text, values, limits in (
        ("tau_{} exceeds its limit by {:.2g} of it", rows.tau, scene.torque_limit),
        ("joint {} exceeds its speed by {:.2g} of it", rows.z_dot[:, 3:], scene.speed_limit),
    ):
        share = np.abs(values).max(axis=0) / limits - 1
        texts += [text.format(j + 1, share[j]) for j in (0, 1) if share[j] > 1e-5]
    return texts


def check_rates(scene: Scene, t: Array, rows: Samples, middles: Samples) -> list[str]:
    """Whether z' is the derivative of z, and z'' that of z', as well as samples can tell.

    Simpson's rule takes instants, at `rows`, and those halfway between, at `middles`. A step of the
    acceleration there, or a kink, changes what it gives by no more than what the instants about it
    show: with the ends alone, a kink and a curvature could cancel in them.
    """
    texts, h = [], np.diff(t)[:, None]
    if not (h > 0).all():
        return ["instants of a phase without a duration"]
    unit = np.array([1.0, 1.0, *[1.0 / scene.scales.length] * 3])
    for what, value, rate, middle in (
        ("z", rows.z, rows.z_dot, middles.z_dot),
        ("z'", rows.z_dot, rows.z_ddot, middles.z_ddot),
    ):
        miss = np.abs(np.diff(value, axis=0) - h * (rate[1:] + 4 * middle + rate[:-1]) / 6)
        span = _spread(rate, middle)
        tiny = 1e-7 * unit * float((np.abs(value) / unit).max())
        excess = miss - (h * span + tiny)
        if (excess > 0).any():
            at, k = np.unravel_index(int(excess.argmax()), excess.shape)
            texts.append(f"{what} and its rate differ by {miss[at, k]:.3g} in row {k}")
    return texts


def _spread(values: Array, middles: Array) -> Array:
    """How much values change over each interval and those beside it, shape (n - 1, k)."""
    every = np.empty((2 * len(values) + 3, values.shape[1]))
    every[2:-2:2], every[3:-3:2] = values, middles
    every[:2], every[-2:] = values[0], values[-1]
    windows = np.stack([every[k : k + 2 * len(middles) : 2] for k in range(7)])
    return np.asarray(windows.max(axis=0) - windows.min(axis=0))


def _check_ends(problem: Problem, phase: Phase, before: Array | None, rows: Samples) -> list[str]:
    """Whether a phase goes on from where the one before ended, and ends as it has to."""
    scene, until, texts = problem.scene, phase.until, []
    size, z, offs = scene.scales.length, rows.z[-1], [0.0]
    fastest, speed = float(np.abs(rows.z_dot).max()), scene.scales.speed
    if before is not None:
        if np.abs(rows.z[0] - before[0]).max() > 1e-6 * max(1.0, size):
            texts.append("starts somewhere else than the phase before ends")
        step = np.abs(rows.z_dot[0] - before[1])[:2].max()
        struck = problem.phases[phase.index - 1].end is End.IMPACT
        if not struck and step > 1e-5 * max(speed, fastest):
            texts.append(f"velocity steps by {step:.3g} m/s at the start")
    pins = [*until.pins]
    if until.contact is not None:
        offs.append(float(np.abs(locate(scene, until.contact.name, rows.z[-1:]).gap[0])) / size)
    elif until.value is not None:
        pins.append((until.coordinate, until.value))
    units = {"x": (0, size), "phi": (2, 1.0)}
    offs += [abs(z[units[name][0]] - value) / units[name][1] for name, value in pins]
    if max(offs) > 1e-5:
        texts.append(f"ends {max(offs):.3g} from {until}")
    if phase.end is End.REST:
        left = np.abs(rows.z_dot[-1]) * np.array([1.0, 1.0, size, size, size])
        if left.max() > 1e-5 * max(speed, fastest * size):
            texts.append(f"ends at {left.max():.3g} m/s, not at rest")
    return texts
