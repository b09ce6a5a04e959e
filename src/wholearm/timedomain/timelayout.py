"""Where the unknowns of the time-domain NLP are: interval after interval, stage after stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..model import Array
from .blocknlp import Indices
from .collocation import Scheme
from .stage import Stage, StagePoints

Z, W, T = slice(0, 5), slice(5, 10), 10
"""What a node's unknowns are: z, w = T z' and T. With a margin, that and the time before follow."""
MARGIN, BEFORE = 11, 12


@dataclass(frozen=True, eq=False)
class StageLayout:
    """Indices of one stage's unknowns.

    Attributes
    ----------
    nodes : ndarray of int, shape (K + 1, n)
    tau : ndarray of int, shape (K, 4)
        Torques at the start and at the end of each interval.
    z, w, u : ndarray of int, shape (K, d, 5)
        z, T z' and T^2 z'' at the collocation points.
    forces : ndarray of int, shape (K, d, n_f)
    ends : ndarray of int, shape (K, 10)
        z and w at the end of each interval: those of its last point, if that is there.
    short : ndarray of int, shape (K, n_c + 2 + R) or (K, 0)
        Shortfalls of c_n [N], of tau [N m] and of rolling contacts' cones [N] in each interval.
    following : ndarray of int
        T of the next stage and, if an impact leads there, its impulses; empty in the last stage.
    """

    nodes: Indices
    tau: Indices
    z: Indices
    w: Indices
    u: Indices
    forces: Indices
    ends: Indices
    short: Indices
    following: Indices

    @property
    def stop(self) -> int:
        """Past its last unknown."""
        return int(self.nodes[-1, -1]) + 1 + len(self.following)


def lay_out(
    stages: Sequence[Stage], scheme: Scheme, with_margin: bool = False, elastic: bool = False
) -> list[StageLayout]:
    """Lay out the unknowns of stages that follow one another.

    Parameters
    ----------
    stages : sequence of Stage
    scheme : Scheme
    with_margin : bool
        Whether nodes have a margin, and the time before.
    elastic : bool
        Whether limits have shortfalls.
    """
    layouts: list[StageLayout] = []
    first, state = 0, 13 if with_margin else 11
    for stage, coming in zip(stages, [*stages[1:], None], strict=True):
        n_f = stage.formation.n_constraints
        inner = scheme.degree * (15 + n_f)
        n_short = (stage.formation.n_contacts + 2 + stage.formation.n_rolling) if elastic else 0
        stride = state + 4 + inner + (0 if scheme.ends else 10) + n_short
        starts = first + stride * np.arange(stage.intervals + 1)
        points = (starts[:-1, None] + state + 4 + np.arange(inner)).reshape(
            stage.intervals, scheme.degree, -1
        )
        short = starts[1:, None] - n_short + np.arange(n_short)
        ends = (
            points[:, -1, :10] if scheme.ends else starts[1:, None] - n_short - 10 + np.arange(10)
        )
        nodes = starts[:, None] + np.arange(state)
        extra = 0
        if coming is not None:
            extra = 1 + (coming.formation.n_constraints if stage.strikes else 0)
        z, w, u, forces = np.split(points, [5, 10, 15], axis=2)
        tau = starts[:-1, None] + state + np.arange(4)
        following = nodes[-1, -1] + 1 + np.arange(extra)
        layouts.append(StageLayout(nodes, tau, z, w, u, forces, ends, short, following))
        first = layouts[-1].stop
    return layouts


def pack(points: Sequence[StagePoints], layouts: Sequence[StageLayout], margin: float) -> Array:
    """Unknowns as one vector."""
    x = np.zeros(layouts[-1].stop)
    before = 0.0
    for part, layout, coming in zip(points, layouts, [*points[1:], None], strict=True):
        duration = part.duration
        x[layout.z], x[layout.w], x[layout.u] = part.z, duration * part.v, duration**2 * part.a
        x[layout.forces], x[layout.tau] = part.forces, part.tau.reshape(-1, 4)
        x[layout.short] = 1.0
        x[layout.nodes[:, Z]], x[layout.nodes[:, W]] = part.nodes[:, 0], duration * part.nodes[:, 1]
        x[layout.ends] = x[layout.nodes[1:, :T]]
        x[layout.nodes[:, T]] = duration
        if layout.nodes.shape[1] > MARGIN:
            x[layout.nodes[:, MARGIN]], x[layout.nodes[:, BEFORE]] = margin, before
        before += duration
        if coming is not None:
            x[layout.following[0]] = coming.duration
            x[layout.following[1:]] = part.impulses
    return x


def unpack(stages: Sequence[Stage], x: Array, layouts: Sequence[StageLayout]) -> list[StagePoints]:
    """What `pack` put together."""
    parts = []
    for stage, layout in zip(stages, layouts, strict=True):
        duration = float(x[layout.nodes[0, T]])
        nodes = x[layout.nodes[:, :T]].reshape(-1, 2, 5) / np.array([[1.0], [duration]])
        parts.append(
            StagePoints(
                duration,
                stage.guess.fractions,
                nodes,
                x[layout.z],
                x[layout.w] / duration,
                x[layout.u] / duration**2,
                x[layout.forces],
                x[layout.tau].reshape(-1, 2, 2),
                x[layout.following[1:]],
            )
        )
    return parts
