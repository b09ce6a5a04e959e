"""What is planned along curves, and how it is laid out on meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...common.errors import AmbiguityError
from ...geometry.curve import Curve, describe_pose
from ...mechanics.dynamics import Directions, reduced_inertia
from ...mechanics.uniqueness import describe_uniqueness, find_minors
from ..advice import name_phases
from ..options import Objective, PlanOptions
from ..robust.robust_rows import Guide, Spread, spread
from .elements import DEGREE
from .path_data import PhaseData, join, prepare
from .path_mesh import SOFT, START, Mesh, find_ends
from .path_nlp import PathNLP, build_path_nlp
from .rate_terms import QUICK, MotorShape
from .switches import Switch
from .terms import LimitShape
from .unique_start import SureStart
from .violations import MISS

LOOKS = 17
"""Places of a stretch without reversals at which contact forces are looked at."""
Pins = tuple[float | None, float | None]
"""Squeezes at the start and the end of a motion, where they are given [N]."""
EARLY = 1e-5
"""Accuracy from which on few elements will do, and limits are tightened before all solves."""
_BESIDES = 8
"""Elements with slow motors beside the one of each stretch."""
_STEPS = 5
"""What numbers of elements are multiples of with slow motors."""


@dataclass(frozen=True)
class Task:
    """What is planned: see `plan_curves`; with ranges, near `guides`, one for each curve.

    Motors may be taken to be `quick`. The squeeze at both ends is as `pins` say [N], where they do.
    """

    curves: Sequence[Curve]
    epsilon: float
    options: PlanOptions
    phases: Sequence[int]
    duration: float | None
    start: SureStart | None = None
    guides: tuple[Guide, ...] = ()
    quick: bool = False
    pins: Pins = (None, None)

    @cached_property
    def spreads(self) -> list[Spread | None]:
        """What ranges make of the force limits of each curve."""
        if not self.guides:
            return [None] * len(self.curves)
        pairs = zip(self.curves, self.guides, strict=True)
        return [spread(curve, self.epsilon, self.options.ranges, own) for curve, own in pairs]

    @property
    def is_held(self) -> bool:
        """Whether motions begin and end without acceleration, as torques may not step."""
        return self.curves[0].formation.scene.has_slow_motors and not self.quick

    @property
    def name(self) -> str:
        """The phases, for messages."""
        return name_phases(self.phases)

    @property
    def lost(self) -> float:
        """Least normal force below which a margin is none [N]."""
        return self.epsilon - MISS * self.curves[0].formation.scene.scales.force

    @property
    def elements(self) -> int:
        """Elements of each phase to begin with."""
        intervals = self.options.intervals
        if intervals is None:
            few = START if self.options.accuracy >= EARLY else 2 * START
            return max(few, SOFT) if self.is_held or self.options.goal is Objective.EFFORT else few
        return max(-(-intervals // DEGREE), 3)

    def require_unique(self) -> None:
        """Require contact forces to be the only ones; see `task.require_unique`."""
        for curve, phase in zip(self.curves, self.phases, strict=True):
            require_unique(curve, self.options.uniqueness_margin, phase)

    def lay_out(
        self, meshes: Sequence[Mesh], wanted: int
    ) -> tuple[int, list[PhaseData], PhaseData, PathNLP]:
        """Each phase on its mesh, all as one, and the NLP for that.

        Each has as many elements, also returned, as are wanted if that is enough for its ends.
        """
        pairs = zip(self.curves, meshes, strict=True)
        ends = max(len(find_ends(curve, mesh.breaks)) for curve, mesh in pairs)
        if self.is_held and self.options.intervals is None:
            # Ramps take elements that the rest is not to lack; few numbers of them are built for.
            ends = -(-(ends + _BESIDES) // _STEPS) * _STEPS
        elements = max(wanted, ends)
        parts = self.prepare(meshes, elements)
        data = join(parts)
        motors = MotorShape.of(self.curves[0].formation.scene) if self.is_held else QUICK
        shape = LimitShape.of(data.limits, motors)
        nlp = build_path_nlp(shape, len(data.grid.steps), self.options.goal)
        return elements, parts, data, nlp

    def place_breaks(self, switches: Sequence[Switch]) -> tuple[Mesh, ...]:
        """Meshes with elements that end at switches, which are at places along all curves.

        Where a fixed number of elements is too few for that, they do not.
        """
        starts = np.cumsum([0.0, *(curve.length for curve in self.curves)])
        of_curve = np.searchsorted(starts[1:-1], [place for place, _ in switches])
        meshes = list[Mesh]()
        for k, curve in enumerate(self.curves):
            pairs = zip(switches, of_curve, strict=True)
            own = [Switch(place - starts[k], jumps) for (place, jumps), at in pairs if at == k]
            meshes.append(Mesh.of(curve, own, self.is_held))
            ends = find_ends(curve, meshes[-1].breaks)
            if self.options.intervals and len(ends) > self.elements:
                meshes[-1] = Mesh()
        return tuple(meshes)

    def prepare(self, meshes: Sequence[Mesh], elements: int) -> list[PhaseData]:
        """What each phase gives the NLP on its grid."""
        found, last = [], len(meshes) - 1
        for k, (curve, mesh) in enumerate(zip(self.curves, meshes, strict=True)):
            grid = mesh.make_grid(curve, elements, (k == 0, k == last), self.is_held)
            found.append(prepare(curve, self.epsilon, grid, self.phases[k], self.spreads[k]))
        return found


def require_unique(curve: Curve, least: float, phase: int) -> None:
    """Require contact forces to be the only ones along a curve.

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
    s = np.concatenate([np.linspace(own.start, own.stop, LOOKS) for own in segments])
    point = curve.evaluate(s)
    Xi = np.repeat([own.Xi for own in segments], LOOKS, axis=0)
    still = (formation.sliding_friction > 0) & (Xi == 0).all(axis=0)
    sticking = tuple(np.flatnonzero(still).tolist())
    ratio, names, row = find_minors(formation, point.kinematics, Xi, sticking).find_least()
    if ratio >= least:
        return
    sigma = np.repeat([own.sigma for own in segments], LOOKS, axis=0)
    if reduced_inertia(formation, point.kinematics, Directions(Xi, sigma)).min() > 0:
        text = describe_uniqueness(ratio, names, describe_pose(point.z[row]), least)
        raise AmbiguityError(f"phase {phase}: {text}")
