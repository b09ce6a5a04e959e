"""Where the unknowns of the time-domain NLP are: interval after interval, stage after stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.arrays import Array
from .assembly import Indices
from .collocation import Scheme
from .stage import Stage, StagePoints

Z, V = slice(0, 5), slice(5, 10)
"""What a node's unknowns are: z and z'. With a margin, that follows."""
STATE, MARGIN = 10, 10


@dataclass(frozen=True, eq=False)
class StageLayout:
    """Indices of one stage's unknowns.

    Attributes
    ----------
    nodes : ndarray of int, shape (K + 1, n)
    h : ndarray of int, shape (K,)
        Durations of the intervals.
    tau : ndarray of int, shape (K, 4)
        Torques at the start and at the end of each interval.
    z, v, a : ndarray of int, shape (K, d, 5)
        z, z' and z'' at the collocation points.
    forces : ndarray of int, shape (K, d, n_f)
    ends : ndarray of int, shape (K, 10)
        z and z' at the end of each interval: those of its last point, if that is there.
    short : ndarray of int, shape (K, n_c + 2 + R) or (K, 0)
        Shortfalls of c_n, of tau and of rolling contacts' cones in each interval.
    impulses : ndarray of int
        Of the impact that leads to the next stage, if one does.
    """

    nodes: Indices
    h: Indices
    tau: Indices
    z: Indices
    v: Indices
    a: Indices
    forces: Indices
    ends: Indices
    short: Indices
    impulses: Indices

    @property
    def stop(self) -> int:
        """Past its last unknown."""
        return int(self.nodes[-1, -1]) + 1 + len(self.impulses)


def lay_out(
    stages: Sequence[Stage], scheme: Scheme, with_margin: bool = False, elastic: bool = False
) -> list[StageLayout]:
    """Lay out the unknowns of stages that follow one another.

    Parameters
    ----------
    stages : sequence of Stage
    scheme : Scheme
    with_margin : bool
        Whether nodes have a margin.
    elastic : bool
        Whether limits have shortfalls.
    """
    layouts: list[StageLayout] = []
    first, state = 0, STATE + with_margin
    for stage, coming in zip(stages, [*stages[1:], None], strict=True):
        n_f = stage.formation.n_constraints
        inner = scheme.degree * (15 + n_f)
        n_short = (stage.formation.n_contacts + 2 + stage.formation.n_rolling) if elastic else 0
        stride = state + 5 + inner + (0 if scheme.ends else 10) + n_short
        starts = first + stride * np.arange(stage.intervals + 1)
        points = (starts[:-1, None] + state + 5 + np.arange(inner)).reshape(
            stage.intervals, scheme.degree, -1
        )
        short = starts[1:, None] - n_short + np.arange(n_short)
        ends = (
            points[:, -1, :10] if scheme.ends else starts[1:, None] - n_short - 10 + np.arange(10)
        )
        nodes = starts[:, None] + np.arange(state)
        ends_in_impact = coming is not None and stage.ends_in_impact
        extra = coming.formation.n_constraints if coming is not None and ends_in_impact else 0
        z, v, a, forces = np.split(points, [5, 10, 15], axis=2)
        h = starts[:-1] + state
        tau = h[:, None] + 1 + np.arange(4)
        impulses = nodes[-1, -1] + 1 + np.arange(extra)
        layouts.append(StageLayout(nodes, h, tau, z, v, a, forces, ends, short, impulses))
        first = layouts[-1].stop
    return layouts


def pack(points: Sequence[StagePoints], layouts: Sequence[StageLayout], margin: float) -> Array:
    """Unknowns as one vector."""
    x = np.zeros(layouts[-1].stop)
    for part, layout in zip(points, layouts, strict=True):
        x[layout.z], x[layout.v], x[layout.a] = part.z, part.v, part.a
        x[layout.forces], x[layout.tau] = part.forces, part.tau.reshape(-1, 4)
        x[layout.h], x[layout.short] = part.duration * part.fractions, 1.0
        x[layout.nodes[:, Z]], x[layout.nodes[:, V]] = part.nodes[:, 0], part.nodes[:, 1]
        x[layout.ends] = x[layout.nodes[1:, :STATE]]
        x[layout.nodes[:, MARGIN:]] = margin
        x[layout.impulses] = part.impulses
    return x


def unpack(x: Array, layouts: Sequence[StageLayout]) -> list[StagePoints]:
    """What `pack` put together."""
    parts = []
    for layout in layouts:
        duration = float(x[layout.h].sum())
        parts.append(
            StagePoints(
                duration,
                x[layout.h] / duration,
                x[layout.nodes[:, :STATE]].reshape(-1, 2, 5),
                x[layout.z],
                x[layout.v],
                x[layout.a],
                x[layout.forces],
                x[layout.tau].reshape(-1, 2, 2),
                x[layout.impulses],
            )
        )
    return parts
