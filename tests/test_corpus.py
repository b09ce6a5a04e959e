"""Stored answers of the corpus against those of now: the cases that cost little."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

from shipped import FOLDER
from wholearm.benchmark.corpus import compare
from wholearm.benchmark.corpus_cases import FAMILIES, answer, list_cases
from wholearm.benchmark.study import Case

STORED = json.loads((FOLDER.with_name("results") / "corpus.json").read_text(encoding="utf-8"))
QUICK: tuple[Case, ...] = (
    *(("plan", "heptagon_four_contacts", goal) for goal in ("time", "effort")),
    ("plan over time", "heptagon_four_contacts", "effort"),
    *(("variant", name) for name in ("speed", "weak", "rough", "certified", "rough, over time")),
    *(("goal", number) for number in (13, 20, 34)),
    *(("scene", number, "margin") for number in (2, 17, 44)),
    *(("leg", number, "time") for number in (24, 36)),
    ("torques", "heptagon", 0.9),
    ("tune", "heptagon_four_contacts"),
    ("free", "heptagon_four_contacts"),
    ("policy", "heptagon_four_contacts"),
    ("robustness", "heptagon_four_contacts"),
    ("compare", "heptagon_four_contacts"),
    ("report", "heptagon_four_contacts"),
    ("map", "square"),
    *(("list", number) for number in range(4)),
    *(("predict", name) for name in ("square", "triangle")),
)
REFUSED = ("input", "option", "torque file")
"""Families whose cases cost next to nothing."""


def name(case: Case) -> str:
    return " ".join(map(str, case))


@pytest.mark.parametrize("case", QUICK, ids=name)
def test_answers_are_as_stored(case: Case) -> None:
    kind, texts = compare(case[0], json.loads(json.dumps(answer(case, FOLDER))), STORED[name(case)])
    assert kind != "differs", texts


def list_words(found: Any) -> list[str]:
    """Words of an answer in any order, as two ways may be equal; numbers to six digits."""
    text = re.sub(r"\d+\.\d+(e-?\d+)?", lambda m: f"{float(m[0]):.6g}", json.dumps(found))
    return sorted(re.findall(r"[^\s,\"{}]+", text))


def test_bad_input_is_refused_as_ever() -> None:
    for case in list_cases():
        if case[0] in REFUSED:
            assert list_words(answer(case, FOLDER)) == list_words(STORED[name(case)]), case


def test_every_case_has_a_stored_answer() -> None:
    cases = list(list_cases())
    assert {name(case) for case in cases} == set(STORED)
    assert {case[0] for case in cases} == set(FAMILIES)


PLANNED: dict[str, Any] = {
    "objective": "time", "value": 1.0, "durations": [0.4, 0.6], "modes": [["+"], ["-"]],
    "replay": {"ok": True, "events": [0.1, 0.5]},
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({}, "same"),
        ({"value": 1 + 5e-7, "durations": [0.40002, 0.59998]}, "same"),
        ({"value": 1.0 + 5e-6}, "differs"),
        ({"value": 0.999, "modes": [["-"], ["-"]]}, "better"),
        ({"value": 0.999, "replay": {"ok": False, "events": []}}, "differs"),
        ({"objective": "margin", "value": 0.999}, "differs"),
        ({"modes": [["+"], ["-", "+"]]}, "differs"),
        ({"replay": {"ok": True, "events": [0.1, 0.50001]}}, "same"),
        ({"replay": {"ok": True, "events": [0.1, 0.501]}}, "differs"),
        ({"replay": {"ok": True, "events": [0.1]}}, "differs"),
        ({"text": "by another name"}, "other words"),
    ],
)
def test_what_counts_as_a_difference(change: dict[str, Any], kind: str) -> None:
    assert compare("plan", PLANNED | change, PLANNED)[0] == kind


def test_local_optima_agree_within_the_accuracy_of_plans() -> None:
    near = PLANNED | {"value": 1.0 + 5e-5}
    assert compare("goal", near, PLANNED)[0] == "same"
    assert compare("plan", near, PLANNED)[0] == "differs"


def test_refusals_agree_in_kind_and_in_what_is_short() -> None:
    refused = {"refused": "InfeasibleError", "amount": 0.1, "advice": {"a": 1.0}, "text": "why"}
    assert compare("leg", refused | {"text": "because", "advice": {}}, refused)[0] == "other words"
    assert compare("leg", refused | {"amount": 0.2}, refused)[0] == "differs"
    assert compare("leg", {"refused": "InputError"}, refused)[0] == "differs"
    assert compare("leg", PLANNED, refused)[0] == "differs"
    assert compare("leg", refused, None)[0] == "differs"
