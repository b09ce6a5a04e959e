from __future__ import annotations

from pathlib import Path

import pytest

from wholearm.curve import Curve
from wholearm.outline import load
from wholearm.path import trace_phases
from wholearm.plan import solve
from wholearm.problem import Problem
from wholearm.trajectory import Trajectory

HEPTAGON = Path(__file__).parents[1] / "problems" / "heptagon_four_contacts.toml"


@pytest.fixture(scope="session")
def heptagon() -> Problem:
    return load(str(HEPTAGON))


@pytest.fixture(scope="session")
def curves(heptagon: Problem) -> tuple[Curve, ...]:
    return trace_phases(heptagon)


@pytest.fixture(scope="session")
def trajectory(heptagon: Problem) -> Trajectory:
    """The plan for the heptagon with every option at its default."""
    return solve(heptagon)
