"""Policy in a simulated control loop: sample and hold, delay, and torque gains."""

from __future__ import annotations

from collections.abc import Mapping

from ..common.arrays import Array
from .playback import Policy

ROOM = 1.0  # Time that a simulation goes on after the policy's own, over that
EXTRA = 0.05  # Time in which the contact of the first phase may close, in addition [s]


class ClosedLoop:
    """Feedback of a simulation; a `free_simulation.feedback.Law`.

    Parameters
    ----------
    policy       copied, so that several loops may run
    phase        number of the phase to begin with
    delay : [s]  of the torques; the policy's if left out
    gains        applied torques over those of the policy

    Attributes
    ----------
    began  when each phase began, by its number [s]
    """

    def __init__(
        self,
        policy: Policy,
        phase: int = 1,
        delay: float | None = None,
        gains: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        self.policy, self.gains, self.first = policy.with_(), gains, phase
        self.period = policy.settings.period
        self.delay = policy.settings.delay if delay is None else delay
        self.began: dict[int, float] = {}
        self.policy.reset(phase)

    @property
    def over(self) -> bool:
        """Whether the last phase is over."""
        last = self.policy.last
        return self.policy.index == last and self.policy.laws[last].over

    def find_duration(self, last: int) -> float:
        """Nominal duration of the phases up to the `last` [s]."""
        phases = self.policy.about["phases"][self.first - 1 : last]
        return EXTRA + sum(float(phase["duration"]) for phase in phases)

    def held(
        self, t: float, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> tuple[float, float]:
        """Torques for a state; as `free_simulation.feedback.Law`."""
        felt: dict[str, float] | None = None
        if self.policy.sensor and t > 0.0:
            felt = {name: forces.get(name, 0.0) for name in self.policy.contacts}
        one, two = self.policy.step(theta.tolist(), theta_dot.tolist(), felt)
        self.began.setdefault(self.policy.phase, t)
        return one * self.gains[0], two * self.gains[1]
