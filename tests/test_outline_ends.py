from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plane import make_formation, measure_gaps
from wholearm.contact import parse_contact
from wholearm.errors import InputError
from wholearm.formation import Formation
from wholearm.outline import close, load, outline_phase
from wholearm.path import trace_phases
from wholearm.problem import Phase, Problem, Until

CLOSED = 1e-9
"""Gap [m] that counts as closed: what a trajectory file promises."""


@pytest.fixture(scope="module")
def hexagon() -> Problem:
    return load(str(Path(__file__).parents[1] / "problems" / "hexagon.toml"))


def test_an_end_is_found_where_the_nearest_one_breaks_a_limit(hexagon: Problem) -> None:
    """v0 is lifted until edge 0 is flush on finger 2, while v1 stays on the link's side."""
    start = trace_phases(hexagon)[4].end
    formation = make_formation(hexagon.scene, "v1-palm v3-finger1 v0-finger2")
    until = parse_contact("v1-finger2", hexagon.scene)
    ending = Formation(hexagon.scene, (*formation.contacts, until))
    nearest = close(ending, start, np.zeros(0))
    assert nearest is not None and ending.evaluate_limits(nearest[None]).min() < -CLOSED
    (part,) = outline_phase(hexagon, Phase(5, formation, Until(until)), start)
    assert np.abs(measure_gaps(ending, part.z[-1])).max() < CLOSED
    assert formation.evaluate_limits(part.z).min() > -CLOSED
    # Edge 0 leaves the palm by the angle between finger 2 and the left end of the palm.
    np.testing.assert_allclose(part.z[-1, 2], part.z[-1, 4] - np.pi, atol=1e-9)


def test_an_end_that_is_nowhere_is_named(hexagon: Problem) -> None:
    start = trace_phases(hexagon)[4].end
    formation = make_formation(hexagon.scene, "v1-palm v3-finger1 v0-finger2")
    until = Until(parse_contact("v5-finger1", hexagon.scene))
    with pytest.raises(InputError, match="v5-finger1 cannot be reached") as caught:
        outline_phase(hexagon, Phase(5, formation, until), start)
    assert caught.value.key == "phases[6].until"
