"""Planning task along curves, its discretization, and the uniqueness check of contact forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...common.errors import AmbiguityError
from ...geometry.curve import Curve, describe_pose, directions_of
from ...mechanics.dynamics import reduced_inertia
from ...mechanics.uniqueness import describe_uniqueness, find_minors
from ..advice import name_phases
from ..options import Objective, PlanOptions
from ..robust.robust_rows import Guide, RobustLimits, spread
from .elements import DEGREE
from .path_data import PhaseData, join, prepare
from .path_mesh import SOFT, START, Mesh, Switch, find_ends
from .path_nlp import PathNLP, build_path_nlp
from .rate_terms import UNLIMITED, MotorShape
from .terms import LimitShape
from .unique_start import SureStart
from .violations import MISS

LOOKS = 17  # places of a segment at which uniqueness is checked
Pins = tuple[float | None, float | None]  # prescribed internal force at start and end [N]
EARLY = 1e-5  # accuracy from which few elements will do, and limits are tightened before any solve
_EXTRA = 8  # elements beyond one for each stretch, under rate limits
_STEPS = 5  # their number is a multiple of it: fewer different NLPs to build


@dataclass(frozen=True)
class Task:
    """Arguments of `plan_curves`; with ranges also a reference for each curve."""

    curves: Sequence[Curve]
    epsilon: float
    options: PlanOptions
    phases: Sequence[int]
    duration: float | None
    start: SureStart | None = None
    guides: tuple[Guide, ...] = ()
    unlimited: bool = False  # whether torque rates and lags are left out
    pins: Pins = (None, None)

    @cached_property
    def spreads(self) -> list[RobustLimits | None]:
        """Robust force limits of each curve, None without ranges."""
        if not self.guides:
            return [None] * len(self.curves)
        args = self.epsilon, self.options.ranges
        return [spread(*pair, *args) for pair in zip(self.curves, self.guides, strict=True)]

    @property
    def is_held(self) -> bool:
        """Whether motions start and end without acceleration, as torques may not step."""
        return self.curves[0].formation.scene.has_slow_motors and not self.unlimited

    @property
    def name(self) -> str:
        """The phases, for messages."""
        return name_phases(self.phases)

    @property
    def lost(self) -> float:
        """Least acceptable c_n of a plan of largest margin [N]."""
        return self.epsilon - MISS * self.curves[0].formation.scene.scales.force

    @property
    def elements(self) -> int:
        """Initial number of elements of each phase."""
        intervals = self.options.intervals
        if intervals is None:
            few = START if self.options.accuracy >= EARLY else 2 * START
            return max(few, SOFT) if self.is_held or self.options.goal is Objective.EFFORT else few
        return max(-(-intervals // DEGREE), 3)

    def lay_out(
        self, meshes: tuple[Mesh, ...], wanted: int
    ) -> tuple[int, tuple[Mesh, ...], list[PhaseData], PhaseData, PathNLP]:
        """Elements of each phase, meshes, each phase on its mesh, all joined, and their NLP.

        There are as many elements as wanted, if that is enough for the breaks.
        """
        pairs = list(zip(self.curves, meshes, strict=True))
        ends = max(len(find_ends(curve, mesh.breaks)) for curve, mesh in pairs)
        if self.is_held and self.options.intervals is None:
            ends = -(-(ends + _EXTRA) // _STEPS) * _STEPS
        elements, parts, last = max(wanted, ends), list[PhaseData](), len(meshes) - 1
        for k, (curve, mesh) in enumerate(pairs):
            grid = mesh.make_grid(curve, elements, (k == 0, k == last), self.is_held)
            parts.append(prepare(curve, self.epsilon, grid, self.phases[k], self.spreads[k]))
        data = join(parts)
        motors = MotorShape.of(self.curves[0].formation.scene) if self.is_held else UNLIMITED
        shape = LimitShape.of(data.limits, motors)
        nlp = build_path_nlp(shape, len(data.grid.steps), self.options.goal)
        return elements, meshes, parts, data, nlp

    def place_breaks(self, switches: Sequence[Switch]) -> tuple[Mesh, ...]:
        """Meshes with breaks at switches, which are at places along all curves.

        None on a curve where a fixed number of elements is too few for them.
        """
        starts = np.cumsum([0.0, *(curve.length for curve in self.curves)])
        of_curve = np.searchsorted(starts[1:-1], [place for place, _ in switches])
        meshes = list[Mesh]()
        for k, curve in enumerate(self.curves):
            pairs = zip(switches, of_curve, strict=True)
            local = [Switch(place - starts[k], jumps) for (place, jumps), at in pairs if at == k]
            mesh = Mesh.of(curve, local, self.is_held)
            few = self.options.intervals and len(find_ends(curve, mesh.breaks)) > self.elements
            meshes.append(Mesh() if few else mesh)
        return tuple(meshes)


def require_unique(curve: Curve, least: float, phase: int) -> None:
    """Require unique contact forces along a curve.

    Parameters
    ----------
    least  least uniqueness margin (`mechanics.uniqueness`)
    phase  its number, for messages

    Raises
    ------
    AmbiguityError  if one is less; where friction jams the curve, `path_data.prepare` raises
    """
    formation, segments = curve.formation, curve.segments
    if not formation.friction.any():
        return
    s = np.concatenate([np.linspace(part.start, part.stop, LOOKS) for part in segments])
    point = curve.evaluate(s)
    directions = directions_of(curve, np.repeat(np.arange(len(segments)), LOOKS))
    Xi = directions.Xi
    still = (formation.sliding_friction > 0) & (Xi == 0).all(axis=0)
    sticking = tuple(np.flatnonzero(still).tolist())
    ratio, names, row = find_minors(formation, point.kinematics, Xi, sticking).find_least()
    if ratio >= least:
        return
    if reduced_inertia(formation, point.kinematics, directions).min() > 0:
        text = describe_uniqueness(ratio, names, describe_pose(point.z[row]), least)
        raise AmbiguityError(f"phase {phase}: {text}")
