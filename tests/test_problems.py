"""Every problem file against its reference figures, which are stored beside it.

``python tests/test_problems.py NAME ...`` plans the problems that are named, or all of them, and
writes their figures anew.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from timed import fastest

FOLDER = Path(__file__).parents[1] / "problems"
FILES = sorted(FOLDER.glob("*.toml"))
FIGURES = ("status", "objective", "phase_durations", "least_margin")


def reference_of(path: Path) -> Path:
    return path.with_suffix(".reference.json")


def measure(path: Path) -> dict[str, Any]:
    """Figures of a problem's least-time plan, times in s and forces in N.

    The least margin is that of the least normal force over epsilon.
    """
    plan = fastest(path)
    return {
        "status": plan.meta["status"],
        "objective": plan.meta["objective"],
        "phase_durations": [round(duration, 6) for duration in plan.meta["phase_durations"]],
        "least_margin": round(float(np.nanmin(plan.c_n)) - plan.meta["epsilon"], 6),
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_plans_have_their_reference_figures(path: Path) -> None:
    stored = reference_of(path)
    assert stored.exists(), f"{stored.name} is missing; python tests/test_problems.py writes it"
    expected = json.loads(stored.read_text(encoding="utf-8"))
    assert tuple(expected) == FIGURES
    got = measure(path)
    assert (got["status"], got["objective"]) == (expected["status"], expected["objective"])
    # Another machine or solver version may stop elsewhere on a flat optimum, not 0.2 % slower.
    np.testing.assert_allclose(got["phase_durations"], expected["phase_durations"], rtol=2e-3)
    # Least time presses no harder than it has to, so the margin is zero but for discretisation.
    assert got["least_margin"] == pytest.approx(expected["least_margin"], abs=1e-3)
    assert got["least_margin"] > -2e-6


def test_every_reference_has_its_problem() -> None:
    names = {reference_of(path).name for path in FILES}
    assert {path.name for path in FOLDER.glob("*.json")} <= names


def main(names: list[str]) -> None:
    for path in FILES:
        if not names or path.stem in names:
            text = json.dumps(measure(path), indent=2) + "\n"
            reference_of(path).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
