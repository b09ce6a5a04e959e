"""Solving the NLP of motions along curves from what is known, and multipliers for that."""

from __future__ import annotations

import numpy as np

from ...common.arrays import Array
from .data import PhaseData
from .elements import Grid, Profile
from .misses import PathSolution
from .nlp import PathNLP, Tightening, Units, make_bounds, pack, parameters, unpack
from .task import Task

_MU, _INSIDE = 1e-6, 1e-4
"""Least complementarity to start slow motors from, and the least slack that it is for."""


def solve(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    tightening: Tightening,
    start: PathSolution,
    time_weight: float,
    task: Task,
) -> PathSolution | str:
    """Solve once; the solution, or in words how the solver ended."""
    bounds = make_bounds(nlp, data, units, tightening, start=task.start, pins=task.pins)
    if (bounds["lbg"] > bounds["ubg"]).any():
        return "limits that hold between the nodes too leave nothing"
    result = nlp.solver(
        x0=pack(nlp, start.profile, units, start.margin, data.grid.sizes),
        p=parameters(nlp, data, units, time_weight),
        **bounds,
        **start.multipliers,
    )
    stats = nlp.solver.stats()
    if not stats["success"]:
        return f"Ipopt stopped with {stats['return_status']}"
    profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], units)
    multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
    lasts = float(result["g"][-1]) * units.time if tightening.duration else 0.0
    return PathSolution(profile, margin, multipliers, float(result["f"]), lasts)


def center(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    profile: Profile,
    multipliers: dict[str, Array],
    task: Task,
) -> dict[str, Array]:
    """Multipliers with which a motion inside its limits is near the central path.

    At least those of a small complementarity.
    """
    bounds = make_bounds(nlp, data, units, Tightening.none(data, task.duration), pins=task.pins)
    x = pack(nlp, profile, units, 0.0, data.grid.sizes)
    p = parameters(nlp, data, units, task.options.time_weight)
    g = nlp.solver.function.get_function("nlp_g")(x, p).full()[:, 0]
    found = {}
    for key, here in (("x", x), ("g", g)):
        low, high, known = bounds[f"lb{key}"], bounds[f"ub{key}"], multipliers[f"lam_{key}0"]
        slack = np.maximum(high - here, _INSIDE), np.maximum(here - low, _INSIDE)
        push = _MU / slack[0] - _MU / slack[1]
        weak = (low < high) & (np.abs(known) < np.abs(push))
        found[f"lam_{key}0"] = np.where(weak, push, known)
    return found


def move_multipliers(
    before: PathNLP, after: PathNLP, multipliers: dict[str, Array], old: Grid, new: Grid
) -> dict[str, Array]:
    """Interpolate multipliers from one grid to another of the same curves."""

    def interpolate(table: Array, weights: tuple[Array, Array] | None = None) -> Array:
        first, last = weights or (np.ones(len(old.s)), np.ones(len(new.s)))
        columns = [last * old.interpolate(column / first, new) for column in table.T]
        return np.column_stack(columns) if columns else np.zeros((len(new.s), 0))

    on_x, on_g, rows = multipliers["lam_x0"], multipliers["lam_g0"], before.columns.g
    weights = old.weights, new.weights
    table = np.zeros(before.free.shape)
    table[before.free] = on_x
    table[:, 0] /= old.sizes
    blocks = {name: on_g[rows[name]] for name in rows.sizes}
    blocks["links"] = blocks["links"] / old.link_sizes
    for name in ("links", "chain"):
        if rows.sizes[name]:
            blocks[name] = interpolate(np.append(blocks[name], 0.0)[:, None])[:-1, 0]
    limits = blocks["limits"].reshape(len(old.s), -1)
    blocks["limits"] = interpolate(limits, weights).ravel()
    for name in ("rates", "commands"):
        if rows.sizes[name]:
            blocks[name] = interpolate(blocks[name].reshape(-1, len(old.s)).T, weights).ravel("F")
    if rows.sizes["joins"]:
        joins = blocks["joins"].reshape(-1, len(old.edges) - 1)
        places = new.edges[1:, 0], old.edges[1:, 0]
        blocks["joins"] = np.concatenate([np.interp(*places, own) for own in joins])
    for name, size in after.columns.g.sizes.items():
        if name in ("rates", "commands", "joins", "begins") and not rows.sizes[name]:
            blocks[name] = np.zeros(size)
    blocks["links"] = blocks["links"] * new.link_sizes
    table = interpolate(table, weights)
    table[:, 0] *= new.sizes
    return {"lam_x0": table[after.free], "lam_g0": after.columns.g.join(**blocks)}
