from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from timed import landing
from tipping import box
from wholearm.benchmark.precision.instances import keep_curves
from wholearm.benchmark.problem import run_bench
from wholearm.common.errors import InputError
from wholearm.problem.definition import End, Problem


def test_baselines_get_the_phases_that_they_know(heptagon: Problem) -> None:
    every = keep_curves(heptagon)
    assert every is not None and len(every.phases) == 5
    # The landing joins its last curve smoothly, and a phase without an end is no curve.
    kept = keep_curves(landing())
    assert kept is not None
    for got, phase in zip(kept.phases, landing().phases[:4], strict=True):
        assert got.formation is phase.formation
    assert {phase.end for phase in kept.phases} == {End.REST}
    slide = keep_curves(box())
    assert slide is not None and len(slide.phases) == 1
    assert slide.phases[0].formation is box().phases[0].formation


def test_without_such_a_phase_there_is_none() -> None:
    first = box().phases[1]
    assert keep_curves(replace(box(), phases=(first,))) is None


def test_a_folder_that_cannot_be_made_is_named(heptagon: Problem, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made") as caught:
        run_bench(heptagon, str(tmp_path / "file" / "results"))
    assert caught.value.exit_status == 2
