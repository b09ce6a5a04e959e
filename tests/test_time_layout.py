from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from plane import make_formation
from timed import landing, tables
from tipping import roll
from wholearm.common.arrays import Array
from wholearm.mechanics.dynamics import Directions
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.nlp_layout import (
    MARGIN,
    STATE,
    StageLayout,
    V,
    Z,
    lay_out,
    pack,
    unpack,
)
from wholearm.planning.time_domain.stage import Stage, StagePoints

SCHEMES = [("radau", 2), ("radau", 3), ("legendre", 2), ("legendre", 4)]


def random_points(
    rng: np.random.Generator, count: int, degree: int, n_f: int, n_p: int = 0
) -> StagePoints:
    table = (count, degree)
    return StagePoints(
        float(rng.uniform(0.1, 0.4)),
        np.full(count, 1 / count),
        rng.normal(size=(count + 1, 2, 5)),
        rng.normal(size=(*table, 5)),
        rng.normal(size=(*table, 5)),
        rng.normal(size=(*table, 5)),
        rng.normal(size=(*table, n_f)),
        rng.normal(size=(count, 2, 2)),
        rng.normal(size=n_p),
    )


def make_stages(name: str, degree: int, ends_in_impact: bool) -> list[Stage]:
    """Three stages on different formations, one with a rolling contact."""
    rng = np.random.default_rng(degree)
    scene = landing().scene
    formations = [
        make_formation(scene, "v1-palm v3-finger1 v4-finger1 v6-finger2"),
        roll(make_formation(scene, "v1-palm v4-finger1"), "v1-palm"),
        make_formation(scene, "v1-palm"),
    ]
    stages = []
    for k, (formation, count) in enumerate(zip(formations, (3, 4, 5), strict=True)):
        hits = ends_in_impact and k == 0
        n_p = formations[1].n_constraints if hits else 0
        guess = random_points(rng, count, degree, formation.n_constraints, n_p)
        if make_scheme(name, degree).ends:
            # The last point of an interval and the node after it are one instant.
            guess.nodes[1:] = np.stack([guess.z[:, -1], guess.v[:, -1]], axis=1)
        directions = Directions(np.ones(formation.n_contacts), np.ones(2))
        stages.append(Stage(k, formation, directions, guess, ends_in_impact=hits))
    return stages


def owners(layouts: Sequence[StageLayout]) -> Array:
    """How often each unknown occurs in the layouts, but for ends of intervals that are points'."""
    counts = np.zeros(layouts[-1].stop)
    for layout in layouts:
        last = np.concatenate([layout.z[:, -1], layout.v[:, -1]], axis=1)
        own = ~np.isin(layout.nodes, last)
        assert own[1:, :STATE].all() or not own[1:, :STATE].any()
        tables = [*(getattr(layout, n) for n in ("h", "tau", "z", "v", "a", "forces"))]
        for table in (layout.nodes[own], *tables, layout.short, layout.impulses):
            np.add.at(counts, table.ravel().astype(int), 1)
    return counts


@pytest.mark.parametrize("elastic", [False, True])
@pytest.mark.parametrize("with_margin", [False, True])
@pytest.mark.parametrize("ends_in_impact", [False, True])
@pytest.mark.parametrize("name, degree", SCHEMES)
def test_every_unknown_has_one_place(
    name: str, degree: int, ends_in_impact: bool, with_margin: bool, elastic: bool
) -> None:
    scheme = make_scheme(name, degree)
    layouts = lay_out(
        make_stages(name, degree, ends_in_impact),
        scheme,
        with_margin,
        [6, 5, 3] if elastic else None,
    )
    np.testing.assert_array_equal(owners(layouts), 1.0)
    assert layouts[0].nodes.shape == (4, 11 if with_margin else 10)
    assert [len(layout.impulses) for layout in layouts] == [3 if ends_in_impact else 0, 0, 0]
    assert [layout.short.shape[1] for layout in layouts] == ([6, 5, 3] if elastic else [0] * 3)


@pytest.mark.parametrize("with_margin", [False, True])
@pytest.mark.parametrize("ends_in_impact", [False, True])
@pytest.mark.parametrize("name, degree", SCHEMES)
def test_points_are_packed_and_unpacked(
    name: str, degree: int, ends_in_impact: bool, with_margin: bool
) -> None:
    stages = make_stages(name, degree, ends_in_impact)
    layouts = lay_out(stages, make_scheme(name, degree), with_margin)
    given = [stage.guess for stage in stages]
    x = pack(given, layouts, 0.7)
    assert x.shape == (layouts[-1].stop,)
    for one, other in zip(given, unpack(x, layouts), strict=True):
        for mine, yours in zip(tables(one), tables(other), strict=True):
            # Shares are multiplied by the duration and divided by their sum.
            np.testing.assert_allclose(yours, mine, rtol=1e-14)
    for part, layout in zip(given, layouts, strict=True):
        np.testing.assert_array_equal(x[layout.h], part.duration * part.fractions)
        np.testing.assert_array_equal(x[layout.nodes[:, Z]], part.nodes[:, 0])
        np.testing.assert_array_equal(x[layout.nodes[:, V]], part.nodes[:, 1])
        np.testing.assert_array_equal(x[layout.a], part.a)
        if with_margin:
            np.testing.assert_array_equal(x[layout.nodes[:, MARGIN]], 0.7)
