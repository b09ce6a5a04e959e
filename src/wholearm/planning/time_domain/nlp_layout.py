"""Indices of the unknowns of the time-domain NLP, interval by interval, and its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.arrays import Array
from ..columns import Columns
from .assembly import Block, Indices, Kernel, Triplets
from .collocation import Scheme
from .stage import Stage, StagePoints

Z, V = slice(0, 5), slice(5, 10)
"""Slices of a node's unknowns: z and z'. With a margin, that follows."""
STATE, MARGIN = 10, 10


@dataclass(frozen=True, eq=False)
class StageLayout:
    """Indices of one stage's unknowns."""

    nodes: Indices  # (K + 1, n): z and z' at the ends of intervals, and a margin if there is one
    h: Indices  # (K,): durations of the intervals
    tau: Indices  # (K, 2 m): control points of the torques in each interval, one after the other
    z: Indices  # z, v, a (K, d, 5): z, z' and z'' at the collocation points
    v: Indices
    a: Indices
    forces: Indices  # (K, d, n_f)
    short: Indices  # (K, n) or (K, 0): shortfalls of limits in each interval
    impulses: Indices  # of the impact that leads to the next stage, if one does
    begin: (
        Indices  # begin, finish: forces at rest at both ends of the motion, of continuous torques
    )
    finish: Indices

    @property
    def stop(self) -> int:
        """Past its last unknown."""
        return 1 + max(int(part.max(initial=-1)) for part in vars(self).values())


def lay_out(
    stages: Sequence[Stage],
    scheme: Scheme,
    with_margin: bool = False,
    shortfalls: Sequence[int] | None = None,
    held: bool = False,
) -> list[StageLayout]:
    """Indices of the unknowns of successive stages.

    `shortfalls` are numbers of them in each interval of a stage; `held`: torques hold both ends.
    """
    layouts: list[StageLayout] = []
    stop, d = 0, scheme.degree
    for k, (stage, coming) in enumerate(zip(stages, [*stages[1:], None], strict=True)):
        point = Columns(z=5, v=5, a=5, forces=stage.formation.n_constraints)
        end, short = (0 if scheme.ends else STATE), shortfalls[k] if shortfalls else 0
        sizes = {"h": 1, "tau": 2 * scheme.controls, "points": d * point.count}
        interval = Columns(**sizes, end=end, short=short, m=int(with_margin))
        begin = stop + np.arange(point.sizes["forces"] * (held and not layouts))
        first = stop + len(begin) + np.arange(STATE + with_margin)
        starts = first[-1] + 1 + interval.count * np.arange(stage.intervals)
        own = {
            name: starts[:, None] + np.arange(part.start, part.stop)
            for name, part in interval.slices.items()
        }
        points = own["points"].reshape(stage.intervals, d, point.count)
        at = {name: points[..., part] for name, part in point.slices.items()}
        ends = points[:, -1, :STATE] if scheme.ends else own["end"]
        nodes = np.vstack([first, np.hstack([ends, own["m"]])])
        stop = int(first[-1]) + 1 + interval.count * stage.intervals
        ends_in_impact = coming is not None and stage.ends_in_impact
        extra = coming.formation.n_constraints if coming is not None and ends_in_impact else 0
        layouts.append(
            StageLayout(
                nodes=nodes,
                h=own["h"][:, 0],
                tau=own["tau"],
                **at,
                short=own["short"],
                impulses=stop + np.arange(extra),
                begin=begin,
                finish=stop + np.arange(point.sizes["forces"] * (held and coming is None)),
            )
        )
        stop += extra + len(layouts[-1].finish)
    return layouts


def pack(points: Sequence[StagePoints], layouts: Sequence[StageLayout], margin: float) -> Array:
    """Unknowns as one vector."""
    x = np.zeros(layouts[-1].stop)
    for part, layout in zip(points, layouts, strict=True):
        x[layout.z], x[layout.v], x[layout.a] = part.z, part.v, part.a
        x[layout.forces], x[layout.tau] = part.forces, part.tau.reshape(len(part.tau), -1)
        x[layout.h], x[layout.short] = part.duration * part.fractions, 1.0
        x[layout.nodes[:, Z]], x[layout.nodes[:, V]] = part.nodes[:, 0], part.nodes[:, 1]
        x[layout.nodes[:, MARGIN:]] = margin
        x[layout.impulses] = part.impulses
        x[layout.begin] = part.forces[0, 0, : len(layout.begin)]
        x[layout.finish] = part.forces[-1, -1, : len(layout.finish)]
    return x


def unpack(x: Array, layouts: Sequence[StageLayout]) -> list[StagePoints]:
    """What `pack` put together."""
    parts = []
    for own in layouts:
        duration = float(x[own.h].sum())
        nodes = x[own.nodes[:, :STATE]].reshape(-1, 2, 5)
        z, v, a, forces = (x[part] for part in (own.z, own.v, own.a, own.forces))
        tau = x[own.tau].reshape(len(own.tau), -1, 2)
        fractions, impulses = x[own.h] / duration, x[own.impulses]
        parts.append(StagePoints(duration, fractions, nodes, z, v, a, forces, tau, impulses))
    return parts


class NlpRows:
    """Constraints in the order in which they are added, with their bounds."""

    def __init__(self) -> None:
        self.blocks: list[Block] = []
        self._count = 0
        self._low: list[Array] = []
        self._high: list[Array] = []
        self._linear: list[Indices] = []
        self._entries: list[tuple[Array, Array, Array]] = []

    def __getstate__(self) -> dict[str, Any]:
        # Which rows there are, and their bounds: kernels belong to CasADi.
        return self.__dict__ | {"blocks": [], "_entries": []}

    def nonlinear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Rows of a kernel, equal to zero unless bounds are given."""
        own = self._count + np.arange(int(np.prod(shape))).reshape(shape)
        self._count += own.size
        for bounds, given in ((self._low, low), (self._high, high)):
            bounds.append(np.broadcast_to(np.asarray(given, dtype=float), shape).ravel())
        return own

    def linear(self, *shape: int, low: Any = 0.0, high: Any = 0.0) -> Indices:
        """Rows that are sums of unknowns, equal to zero unless bounds are given."""
        own = self.nonlinear(*shape, low=low, high=high)
        self._linear.append(own.ravel())
        return own

    def add_entries(self, rows: Any, columns: Any, values: Any) -> None:
        """Add entries to linear rows; the three are broadcast against one another."""
        parts = np.broadcast_arrays(rows, columns, np.asarray(values, dtype=float))
        self._entries.append((parts[0].ravel(), parts[1].ravel(), parts[2].ravel()))

    def add_copies(
        self, kernel: Kernel, columns: Indices, rows: Indices, parameters: Array | None = None
    ) -> None:
        """Say which rows are copies of a kernel, one for all but the last axis of `columns`."""
        table = columns.reshape(-1, columns.shape[-1])
        given = np.zeros((len(table), 0)) if parameters is None else parameters
        own = rows.reshape(len(table), -1)
        self.blocks.append(Block(kernel, table, own, given.reshape(len(table), -1)))

    def add_cost(self, kernel: Kernel, columns: Indices, parameters: Array | None = None) -> None:
        """Add copies of a kernel to the cost."""
        self.add_copies(kernel, columns, np.zeros((len(columns), 0), dtype=np.int64), parameters)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all rows."""
        return np.concatenate(self._low), np.concatenate(self._high)

    @property
    def linear_rows(self) -> Indices:
        """Which rows are linear."""
        return np.concatenate(self._linear)

    @property
    def triplets(self) -> Triplets:
        """Entries of the linear rows."""
        return Triplets(*(np.concatenate(part) for part in zip(*self._entries, strict=True)))
