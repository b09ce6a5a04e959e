"""Initial stages of a motion from its initial paths, with an initial guess of states and forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ...common.arrays import Array
from ...geometry.path_guess import RELEASE_AT, PathGuess, guess_onwards, guess_phase
from ...mechanics.dynamics import Directions, force_rows
from ...problem.definition import End, Phase, Problem
from .collocation import Scheme
from .initial_path import PacedWay, PathSpeed
from .stage import Stage, StagePoints, in_own_units, scale_state
from .stage_modes import LEAST_INTERVALS, link

PRESS = 0.5  # normal forces of an initial guess, over the weight of the object
_NEAR = 0.02  # distance over the radius of gyration at which a limit is monitored from the start
_TOUCHES = 1e-5  # gap over the radius of gyration below which a released contact is closed


def guess_stages(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    scheme: Scheme,
    intervals: int,
    falls: float,
    onwards: bool = False,
    release_at: float = RELEASE_AT,
    way: PacedWay | None = None,
) -> list[Stage]:
    """Stages of phases in one NLP, with an initial guess, in the scene's own units.

    The guessed duration is `falls` times that of a fall over the length of the initial paths. With
    `onwards`, phases joined in motion may end farther away where that takes fewer reversals. A
    release is guessed at the share `release_at` of a curve. A single phase may follow a given path
    with its speed profile instead.
    """
    parts = _list_parts(problem, phases, z, onwards, release_at, way)
    lengths = np.array([outline.length for _, outline, _ in parts])
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    # The path parameter of the guess is (1 - cos) / 2 over all stages.
    total, profile = falls * float(np.sqrt(lengths.sum())), None if way is None else way.profile
    clock = np.arccos(1 - 2 * np.clip(ends, 0.0, 1.0)) / np.pi
    if profile is not None:
        total = float(profile.t[-1]) / problem.scene.scales.time
        clock = np.interp(ends, profile.s, profile.t / profile.t[-1])
    stages: list[Stage] = []
    released: tuple[int, ...] = ()
    for k, (phase, outline, last) in enumerate(parts):
        whole = lengths[[own is phase for own, _, _ in parts]].sum()
        count = max(LEAST_INTERVALS, round(lengths[k] / whole * intervals))
        guess = _guess(outline, scheme, count, clock[k : k + 2], ends[k : k + 2], total, profile)
        ends_in_impact = last and phase.end is End.IMPACT and k + 1 < len(parts)
        if ends_in_impact:
            guess = guess._replace(impulses=np.zeros(parts[k + 1][0].formation.n_constraints))
        opens = k > 0 and parts[k - 1][0] is not phase
        if opens:
            touching = np.abs(phase.formation.evaluate_limits(outline.z[:1])[0]) < _TOUCHES
            released = tuple(np.flatnonzero(touching).tolist())
        stages.append(
            Stage(
                phase.index,
                phase.formation,
                outline.directions,
                guess,
                until=phase.until if last and not phase.until.is_release else None,
                ends_in_impact=ends_in_impact,
                monitored=tuple(sorted({*_choose_monitored(phase, outline), *released})),
                released=released,
                opens=opens,
                ahead=_find_value_ahead(phase, parts),
            )
        )
    return link(stages)


def _find_value_ahead(
    phase: Phase, parts: Sequence[tuple[Phase, PathGuess, bool]]
) -> tuple[int, float, float] | None:
    """`Stage.ahead` of a phase that ends at the value of a coordinate."""
    if phase.until.value is None:
        return None
    row, value = 0 if phase.until.coordinate == "x" else 2, phase.until.value
    start = next(outline.z[0, row] for own, outline, _ in parts if own is phase)
    return row, value, 1.0 if value > start else -1.0


def _list_parts(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    onwards: bool,
    release_at: float,
    way: PacedWay | None,
) -> list[tuple[Phase, PathGuess, bool]]:
    """Phases with their initial paths, in own units, and whether each is the last of its phase."""
    parts: list[tuple[Phase, PathGuess, bool]] = []
    for k, phase in enumerate(phases):
        outlines = list(
            way.stretches if way else guess_phase(phase, z, phases[k + 1 :], release_at)
        )
        if parts and parts[-1][0].end is End.SMOOTH:
            outlines = [*_turn_first(outlines[0], parts[-1][1]), *outlines[1:]]
            if onwards:
                outlines = _go_straight(phase, outlines, parts[-1][1])
        parts += [(phase, outline, outline is outlines[-1]) for outline in outlines]
        z = outlines[-1].z[-1]
    scaled = []
    for phase, outline, last in parts:
        own = in_own_units(problem).phases[phase.index]
        z = scale_state(outline.z, problem.scene.scales)
        scaled.append((own, replace(outline, formation=own.formation, z=z), last))
    return scaled


def _guess(
    outline: PathGuess,
    scheme: Scheme,
    count: int,
    clock: Array,
    ends: Array,
    total: float,
    profile: PathSpeed | None,
) -> StagePoints:
    """Motion along an initial path, with equal normal forces where it has no speed profile.

    `clock` and `ends` are shares of the time `total` [s] and length of all stages at both ends.
    """
    knots = np.linspace(0.0, 1.0, len(outline.z))
    slopes = np.gradient(outline.z, knots, axis=0)
    bends = np.gradient(slopes, knots, axis=0)
    breaks = np.linspace(0.0, 1.0, count + 1)

    def follow(share: Array) -> tuple[Array, Array, Array]:
        passed = clock[0] + share * (clock[1] - clock[0])
        span = max(ends[1] - ends[0], 1e-12)
        place, rate, gain = _evaluate_profile(profile, passed)
        place = (place - ends[0]) / span
        rate, gain = rate[..., None] / (span * total), gain[..., None] / (span * total**2)
        z, slope, bend = (
            np.stack([np.interp(place, knots, column) for column in table.T], axis=-1)
            for table in (outline.z, slopes, bends)
        )
        return z, slope * rate, slope * gain + bend * rate**2

    at = breaks[:-1, None] + scheme.points / count
    z, v, a = follow(at)
    if profile is None:
        forces = _press(outline, z, v, a)
    else:
        passed = clock[0] + at * (clock[1] - clock[0])
        own = np.searchsorted(profile.t / profile.t[-1], passed) - 1
        forces = profile.forces[np.clip(own, 0, len(profile.forces) - 1)]
    tau = _balance(outline, scheme, z, v, a, forces)
    return StagePoints(
        total * (clock[1] - clock[0]),
        np.full(count, 1 / count),
        np.stack(follow(breaks)[:2], axis=1),
        z,
        v,
        a,
        forces,
        tau,
        np.zeros(0),
    )


def _evaluate_profile(profile: PathSpeed | None, passed: Array) -> tuple[Array, Array, Array]:
    """Share of the length at shares of the time, and its derivatives, without a profile by cos."""
    if profile is None:
        angle = np.pi * passed
        return (1 - np.cos(angle)) / 2, np.pi / 2 * np.sin(angle), np.pi**2 / 2 * np.cos(angle)
    total = profile.t[-1]
    k = np.clip(np.searchsorted(profile.t, passed * total) - 1, 0, len(profile.forces) - 1)
    begin, since = profile.v[k], passed * total - profile.t[k]
    gain = (np.diff(profile.v) / np.diff(profile.t))[k]
    place = profile.s[k] + since * (begin + gain * since / 2)
    return place, total * (begin + gain * since), total**2 * gain


def _lack(outline: PathGuess, z: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Rows of G, and the sum G^T c + S tau that the equations of motion require."""
    scene, flat = outline.formation.scene, [table.reshape(-1, 5) for table in (z, v, a)]
    G = force_rows(outline.formation, outline.formation.evaluate(*flat[:2]), outline.directions)
    applied = scene.applied_force - scene.dry * np.append(np.zeros(3), outline.directions.sigma)
    return G, scene.mass_diagonal * flat[2] + scene.viscous * flat[1] - applied


def _press(outline: PathGuess, z: Array, v: Array, a: Array) -> Array:
    """Contact forces of a motion nearest to equal normal forces, shape (K, d, n_c + R)."""
    formation, (G, needed) = outline.formation, _lack(outline, z, v, a)
    light = np.zeros(formation.n_constraints)
    light[: formation.n_contacts] = PRESS
    forces = []
    for rows, wanted in zip(G[:, :, :3], needed[:, :3], strict=True):
        missing = wanted - light @ rows
        forces.append(light + np.linalg.lstsq(rows.T, missing, rcond=1e-6)[0])
    c = np.array(forces)
    c[:, : formation.n_contacts] = np.clip(c[:, : formation.n_contacts], 0.1 * PRESS, 20.0)
    return c.reshape(*z.shape[:2], -1)


def _balance(
    outline: PathGuess, scheme: Scheme, z: Array, v: Array, a: Array, forces: Array
) -> Array:
    """Control points of the torques of a motion with contact forces, (K, m, 2), within limits."""
    limit, (G, needed) = outline.formation.scene.torque_limit, _lack(outline, z, v, a)
    c = forces.reshape(len(G), -1)
    tau = needed[:, 3:] - np.einsum("nij,ni->nj", G[:, :, 3:], c)
    tau = np.clip(tau, -0.9 * limit, 0.9 * limit).reshape(*z.shape[:2], 2)
    chosen = np.linspace(0, scheme.degree - 1, scheme.controls).round().astype(int)
    return np.asarray(tau[:, chosen])


def _go_straight(phase: Phase, nearest: list[PathGuess], before: PathGuess) -> list[PathGuess]:
    """Of paths to the nearest end and to farther ones, those with the fewest reversals."""
    ahead = [_turn_first(other, before) for other in guess_onwards(phase, before)]
    return min([nearest, *ahead], key=lambda way: (len(way), sum(part.length for part in way)))


def _turn_first(outline: PathGuess, before: PathGuess) -> list[PathGuess]:
    """Split a path so that it starts in the sliding directions of the one before.

    Velocities are continuous, so that other directions need reversals along the path.
    """
    # Rolling contacts have no direction to keep.
    slides = np.delete(np.arange(before.formation.n_contacts), before.formation.rolling_rows)
    known = {before.formation.names[k]: before.directions.Xi[k] for k in slides}
    own, formation = np.concatenate(outline.directions), outline.formation
    n_c = formation.n_contacts
    signs = own.copy()
    signs[n_c:] = before.directions.sigma
    for k in range(n_c):
        if k not in formation.rolling_rows:
            together = [formation.names[i] for i in formation.turn_with(k)]
            signs[k] = next((known[name] for name in together if name in known), signs[k])
    differing = np.flatnonzero(signs != own).tolist()
    turns = list(dict.fromkeys(formation.turn_with(k) for k in differing))
    pieces = []
    cuts = np.linspace(0, len(outline.z) - 1, len(turns) + 2).astype(int)
    for k, (begin, stop) in enumerate(pairwise(cuts)):
        turn = turns[k] if k < len(turns) else outline.turns
        directions = Directions(signs[:n_c].copy(), signs[n_c:].copy())
        z = outline.z[begin : stop + 1]
        pieces.append(replace(outline, z=z, directions=directions, turns=turn))
        if k < len(turns):
            signs[list(turns[k])] = own[list(turns[k])]
    return pieces


def _choose_monitored(phase: Phase, outline: PathGuess) -> tuple[int, ...]:
    """Limits that are near zero along the path, and that of the phase's end."""
    near = outline.formation.evaluate_limits(outline.z).min(axis=0) < _NEAR
    ends = np.array([limit.gains(phase.until.contact) for limit in outline.formation.limits])
    return tuple(np.flatnonzero(near | ends).tolist())
