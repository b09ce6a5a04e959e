from __future__ import annotations

from wholearm.benchmark.lists import study_lists


def test_lists_of_a_few_scenes_load() -> None:
    loaded, outcomes = study_lists(seed=2, scenes=1)
    assert loaded == 1
    assert all(text.startswith("refused: ") for text in outcomes)
