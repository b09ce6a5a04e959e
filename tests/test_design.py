"""Sensitivities obey dimensions and agree with solved problems; design finds known best hands."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import wholearm
from wholearm import InfeasibleError, InputError, PlanOptions, Problem, find_sensitivities
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.design import sensitivities
from wholearm.design.hand import Design, Hand, HandCost, design_hand, read_choices
from wholearm.design.sweep import find_parameter, list_parameters, require_allowed
from wholearm.figures.result_figures import draw_search
from wholearm.planning.options import Objective

UNITS = {
    "": (0, 0, 0), "kg": (0, 1, 0), "m": (1, 0, 0), "N": (1, 1, -2), "N m": (2, 1, -2),
    "N m s": (2, 1, -1), "kg m^2": (2, 1, 0), "m/s^2": (1, 0, -2), "rad/s": (0, 0, -1),
}  # fmt: skip
"""Exponents of metres, kilograms and seconds."""


def test_parameters_are_all_numbers_by_their_shortest_names(box: Problem) -> None:
    names = [parameter.name for parameter in list_parameters(box)]
    assert {"mass", "epsilon", "gravity", "friction_palm", "base2_x", "torque_limit1"} <= {*names}
    assert {"x", "phases[1].until.x", "object.vertices[4][2]"} <= {*names}
    assert not {"viscous1", "flush", "object.mass", "length"} & {*names}
    joint = find_parameter(box, "base2_x")
    assert joint.value == -0.1 and joint.unit == "m"
    assert box.with_({joint.name: -0.101}).scene.fingers[1].base[0] == -0.101  # type: ignore[index]


@pytest.mark.parametrize("text, words", [
    ("lenght1=0.1:0.2", "did you mean 'length1'"),
    ("control_hold=1:2", "did you mean 'control_period'? those that this one gives are epsilon"),
    ("phases[1].until.phi_deg=1:2", "did you mean 'phases[1].until.x'"),
    ("length1=1e-6:0.2", "1e-06 given; allowed are 0.00255"),
    ("length1=0.2:0.1", "LOW below HIGH"),
    ("length1", "NAME=LOW:HIGH is needed"),
])  # fmt: skip
def test_what_cannot_be_chosen_is_refused(box: Problem, text: str, words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        read_choices(box, [text])


def test_a_symmetric_hand_mirrors_the_joint(box: Problem) -> None:
    first, second = read_choices(box, ["length1=0.1:0.2", "base1_x=0.08:0.12"], symmetric=True)
    assert first.factors == {"fingers.1.length": 1, "fingers.2.length": 1}
    assert second.factors == {"fingers.1.base[1]": 1, "fingers.2.base[1]": -1}
    with pytest.raises(InputError, match="base2_x"):
        read_choices(box, ["base1_x=0.08:0.12", "base2_x=-0.12:-0.08"], symmetric=True)


@pytest.mark.parametrize("transcription", ["auto", "time"])
def test_sensitivities_obey_dimensions(box: Problem, transcription: str) -> None:
    """The least time scales with the units: sums of exponent times p dT/dp are 0, 0, T (Euler)."""
    # The file leaves out the object's inertia, which follows from mass and corners.
    names = [p.name for p in list_parameters(box) if p.name != "inertia"]
    options = PlanOptions(transcription=transcription)
    result = find_sensitivities(box, options, names, jobs=1)
    assert {row.method for row in result.rows} == {"multipliers"}
    for unit, wanted in enumerate((0.0, 0.0, result.value)):
        terms = [UNITS[row.unit][unit] * row.given * row.derivative for row in result.rows]
        assert max(map(abs, terms)) > 0.01 * result.value
        assert sum(terms) == pytest.approx(wanted, abs=1e-4 * result.value)


def test_multipliers_agree_with_solved_problems(tmp_path: Path) -> None:
    names = ["mass", "torque_limit1", "finger_inertia1", "friction_palm", "base1_x", "epsilon"]
    main(["new", str(tmp_path / "tri"), "--vertices", "0,0 0.08,0 0.04,0.06"])
    tri = wholearm.load(tmp_path / "tri.toml")
    results = [
        find_sensitivities(tri, names=names, multipliers=way, jobs=1) for way in (True, False)
    ]
    rows = [{row.name: row for row in result.rows} for result in results]
    for name in names:
        exact, other = rows[0][name], rows[1][name]
        assert (exact.method, other.method) == ("multipliers", "differences")
        assert exact.percent == pytest.approx(other.percent, rel=1e-2, abs=1e-6 * results[0].value)


def test_sides_without_a_plan_are_said(box: Problem) -> None:
    # Without friction there is no less of it.
    row = find_sensitivities(box.with_(friction_palm=0.0), names=["friction_palm"], jobs=1).rows[0]
    assert row.note.startswith("with more only: ") and math.isfinite(row.derivative)


def test_a_kink_has_the_derivative_with_more(box: Problem) -> None:
    mass = find_parameter(box, "mass", "--of")

    def evaluate(changed: Problem, z: Array) -> tuple[sensitivities.Terms, Array]:
        more = changed.table["object"]["mass"] - mass.value
        return [("1", "", 1 + max(2 * more, -3 * more))], z

    ways = [("differences", 1e-3, evaluate(box, box.start)[0], evaluate)]
    row = sensitivities._find_one(box, Objective.TIME, ["1"], ways, 1e-3, mass)
    assert (row.derivative, row.error) == pytest.approx((2.0, 1.0 / mass.value))
    assert row.note == "with more only: with less the derivative is -3"


def test_the_largest_margin_is_differenced(box: Problem) -> None:
    options = PlanOptions("margin", duration=0.5, accuracy=1e-4)
    result = find_sensitivities(box, options, ["torque_limit"], jobs=1)
    assert result.rows[0].method == "differences" and result.unit == "N"
    assert result.rows[0].derivative > 0


@pytest.fixture(scope="module")
def designed(box: Problem) -> Design:
    over = ["torque_limit=0.02:2.5", "mass=0.15:0.25"]
    return design_hand(box, over, starts=1, budget=12, jobs=1)


def test_design_finds_the_strongest_hand(designed: Design, box: Problem) -> None:
    """More torque is never slower, and this box is moved faster with it."""
    best = dict(zip(["torque_limit", "mass"], designed.aim.find(designed.optima[0]), strict=True))
    assert best["torque_limit"] == pytest.approx(2.5, rel=1e-2)
    assert designed.plans[0].value < designed.aim.today[0]
    assert designed.plans[0].value == pytest.approx(designed.optima[0].cost, rel=1e-9)
    assert designed.plans[0].replay is not None
    # Lines for the best hand go on to the last one.
    lines = [line for axes in draw_search(designed).axes for line in axes.lines]
    ends = [np.max(line.get_xdata()) for line in lines if line.get_label() == "start 1"]
    assert ends == 3 * [sum(hand.start == 1 for hand in designed.hands)]


def test_hands_without_a_plan_are_counted(box: Problem) -> None:
    require_allowed(box, "length", 0.04, "--over")  # too short to touch: no mistake in a file
    with pytest.raises(InfeasibleError, match=r"none of \d+ hands has a plan; the reason of"):
        design_hand(box, ["length=0.03:0.035"], starts=1, budget=2, jobs=1)


def test_several_problems_share_a_hand(designed: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    aim = designed.aim
    assert aim.rate(1, [1.0, 0.0]).cost < aim.rate(1, [0.0, 0.0]).cost
    assert isinstance(aim.rate(1, [0.0, 0.0]), Hand)
    monkeypatch.setattr(HandCost, "rate", lambda _, k, p: Hand(k, p, sum(abs(x - 0.9) for x in p)))
    assert all(len(aim.search(2, budget, print)) <= 1 + budget for budget in range(1, 40))


def test_commands(box_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure, bars = (str(tmp_path / name) for name in ("best.toml", "search.png", "bars.png"))
    over = ["--over", "torque_limit=1:2.5", "--starts", "1", "--budget", "5", "--jobs", "1"]
    assert main(["design", str(box_file), *over, "-o", out, "--figure", figure]) == 0
    assert re.search(r"\d % less than today's \d", capsys.readouterr().out)
    assert Path(figure).stat().st_size > 1000
    assert wholearm.solve(wholearm.load(out)).duration > 0
    command = ["sensitivities", str(box_file), "--jobs", "1", "--of"]
    assert main([*command, "mass", "torque_limit1", "-o", bars, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {row["name"] for row in rows} == {"mass", "torque_limit1"}
    assert Path(bars).stat().st_size > 1000
    for name, words in (("mas", "did you mean 'mass'"), ("settle", "is no single number here")):
        assert main([*command, name]) == 2 and words in capsys.readouterr().err
