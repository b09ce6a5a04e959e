"""Motion of a loaded plan between its rows: torques of the file, forces by forward dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions, forward, measure_speed, split_forces
from ..problem.definition import Phase
from .trajectory import ROLLS, ModeSpan, Motion, SampledMotion, Samples

REST_SPEED = 1e-9  # speed of rest but for rounding, relative to the scene's speed
SIGNS = {"+": 1.0, "-": -1.0, ROLLS: 0.0}  # of directions, by modes


@dataclass(frozen=True, eq=False)
class PlannedMotion(SampledMotion):
    """A phase of a loaded plan, which satisfies the equations of motion between its samples.

    z and z' are interpolated; z'' and forces follow from torques, by the plan's contact modes or,
    along a curve, the directions of z'. At rest z'' and forces are interpolated, too.
    """

    formation: Formation  # contacts in the order of the samples
    modes: Sequence[ModeSpan] = ()  # none along a curve

    @staticmethod
    def of(motion: Motion, phase: Phase, modes: Sequence[ModeSpan]) -> PlannedMotion:
        """The motion of a phase from its loaded samples."""
        assert isinstance(motion, SampledMotion)
        by_name = {contact.name: contact for contact in phase.formation.contacts}
        contacts = tuple(by_name[name] for name in motion.contacts)
        formation = replace(phase.formation, contacts=contacts)
        parts = motion.t, motion.contacts, motion.samples, motion.torque
        return PlannedMotion(*parts, formation, modes)

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        samples, k = super().evaluate(t), self.locate(t)
        v, scene = self.samples.z_dot, self.formation.scene
        moves = np.array([measure_speed(scene, row) for row in v]) > REST_SPEED * scene.scales.speed
        # At rest directions are those of the adjacent rows.
        ahead = samples.z_dot + 1e-9 * (v[k] + v[k + 1])
        span_index = np.searchsorted([span.start for span in self.modes[1:]], t, side="right")
        for index in set(span_index.tolist()):
            rows = np.flatnonzero((moves[k] | moves[k + 1]) & (span_index == index))
            modes = self.modes[index] if self.modes else None
            a, *forces = self._solve(Samples(*(part[rows] for part in samples)), ahead[rows], modes)
            # After a row at rest, motion begins where the acceleration has its direction.
            started = moves[k[rows]] | ((a * ahead[rows]).sum(axis=1) > 0)
            for table, values in zip((samples.z_ddot, *samples[4:]), (a, *forces), strict=True):
                table[rows[started]] = values[started]
        return samples

    def _solve(self, samples: Samples, velocity: Array, modes: ModeSpan | None) -> list[Array]:
        """z'', c_n and c_t, with contact modes if known, or directions of `velocity` (n, 5)."""
        formation, (z, v, _, tau, *_) = self.formation, samples
        directions = Directions.of(formation.evaluate(z, v), velocity)
        if modes is not None:
            names = [modes.contacts[name] for name in formation.names]
            rolling = tuple(c for c, m in zip(formation.contacts, names, strict=True) if m == ROLLS)
            formation = replace(formation, rolling=rolling)
            signs = ([SIGNS[mode] for mode in part] for part in (names, modes.joints))
            directions = Directions(*map(np.array, signs))
        a, c = forward(formation, formation.evaluate(z, v), v, tau, directions)
        return [a, *split_forces(formation, c, directions.Xi)]
