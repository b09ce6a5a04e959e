"""Regression corpus: answers of the package compared with stored ones.

Two answers agree if kinds, verdicts and contact modes are the same and numbers are within
`TOLERANCES`. A better value of the objective is no difference, whatever else it changes.

Numbers may be rounded differently: OpenBLAS has kernels for each processor, of which
``OPENBLAS_CORETYPE`` chooses one, and `perturb_scenes` changes numbers in the last bits.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from fnmatch import fnmatch
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from ..common.files import read_json, write_text
from ..scene.model import Finger, Friction, Polygon, Scene
from .corpus_cases import answer, list_cases
from .study import Case, Row, Study, format_table, name_case

TOLERANCES = {
    "value": 1e-6,
    "amount": 1e-2,
    "advice": 5e-2,
    "numbers": 1e-3,
    "least": 1e-3,
    "margins": 1e-3,
    "stops": 2e-3,
}
"""Relative to the largest number of an entry: what Ipopt and the refinement of limits leave open.

An amount is the shortfall of a motion that solves another problem, advice a bisection. Numbers of a
report have four digits; a least force or margin is one at an instant. Phases of a policy stop at
samples, 1 ms apart in simulations of more than 1 s.
"""
USUAL = 1e-4  # for all others: the accuracy that plans are made with
LOCAL = ("plan over time", "goal", "scene", "leg")
"""Families whose optimum need not be the only one: values agree within `USUAL`.

Values are flat at an optimum: motions whose values differ by `USUAL` differ by its root.
"""
WORDS = ("words", "text", "advice", "help", "reason")
"""Entries that do not count as an answer: words, and advice, which ends by processor time."""
COUNTED = ("goals", "kept")  # entries that count samples


class Corpus(Study):
    """Answers of today against stored ones."""

    name, title = "corpus", "Answers against stored ones"
    of_code, folder, shipped = True, "build", True
    stored = ("--answers", "results/corpus.json")
    problems, rounding = Path("problems"), 0
    options = """\
--only PATTERN ...  cases whose names match, such as 'plan heptagon *' (all)
--values            compare values, verdicts and contact modes of plans, and nothing else of these,
    as rounding may change what an optimum leaves open
--rounding K        change all numbers of scenes in the last bits, drawn from K (0: none) = 0
    in 0..1000000000
"""

    def stamp(self, options: argparse.Namespace) -> dict[str, Any]:
        """How numbers are rounded."""
        return {"kernel": os.environ.get("OPENBLAS_CORETYPE"), "rounding": options.rounding}

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Those that are asked for."""
        self.problems, self.rounding = Path(options.problems), options.rounding
        for case in list_cases():
            if any(fnmatch(" ".join(map(str, case)), own) for own in options.only or "*"):
                yield case

    def list_inputs(self, options: argparse.Namespace) -> list[Path]:
        """The problem files."""
        return sorted(Path(options.problems).glob("*.toml"))

    def limit(self, case: Case) -> float:
        """Tuning takes a thousand simulations."""
        return 300.0 if case[0] == "tune" else 120.0

    def run(self, case: Case) -> Row:
        """Ask."""
        if self.rounding:
            perturb_scenes(self.rounding)
        return {"answer": answer(case, self.problems)}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        """How many answers of each family are the same, and which differ; or they are stored."""
        found = {name_case(row): row["answer"] for row in rows}
        if options.update:
            known = _read(options.answers) if Path(options.answers).exists() else {}
            names = {" ".join(map(str, case)) for case in list_cases()}
            _write(options.answers, {k: v for k, v in (known | found).items() if k in names})
        stored = _read(options.answers)
        verdicts = {}
        for row in rows:
            pair = row["answer"], stored.get(name_case(row))
            one, other = map(_reduce, pair) if options.values else pair
            verdicts[name_case(row)] = compare(row["case"][0], one, other)
        kinds = ("same", "better", "other words", "differs")
        table = []
        for family in [*dict.fromkeys(row["case"][0] for row in rows), "all"]:
            mine = [row for row in rows if family in ("all", row["case"][0])]
            count = Counter(verdicts[name_case(row)][0] for row in mine)
            seconds = sum(row["seconds"] for row in mine)
            table.append((family, len(mine), *(count[kind] for kind in kinds), f"{seconds:.0f}"))
        lines = [*format_table(["family", "cases", *kinds, "processor time [s]"], table), ""]
        for name, (kind, texts) in verdicts.items():
            if kind in kinds[1:3]:
                lines.append(f"* {kind}: {name}: {texts[0]}")
        wrong = {name: texts for name, (kind, texts) in verdicts.items() if kind == "differs"}
        return "\n".join(lines), [
            f"{name}: {own}" for name, texts in wrong.items() for own in texts[:3]
        ]


STUDY = Corpus()


def compare(family: str, found: Any, stored: Any) -> tuple[str, list[str]]:
    """Whether an answer is as stored: same, better, other words, or differs; and where."""
    if stored is None:
        return "differs", ["no answer is stored; --update stores it"]
    if "value" in found and found["objective"] == stored.get("objective"):
        gain = found["value"] / stored["value"] - 1
        gain = gain if stored["objective"] == "margin" else -gain
        holds = found["replay"]["ok"] >= stored["replay"]["ok"]
        if gain > _allowed(family, "value") and holds:
            return "better", [f"value {found['value']:.9g} instead of {stored['value']:.9g}"]
    if "refused" in stored and found.get("replay", {}).get("ok"):
        return "better", [f"value {found['value']:.9g} instead of a refusal"]
    texts = list(_differ(family, "", found, stored))
    if not texts:
        return "same", []
    strong = [text for weak, text in texts if not weak]
    return ("differs", strong) if strong else ("other words", [text for _, text in texts])


def _reduce(answer: Any) -> Any:
    """Verdict, value and contact modes of a plan, or its refusal; other answers as they are."""
    if not answer or not {"replay", "refused"} & answer.keys():
        return answer
    own = {key: answer[key] for key in ("refused", "objective", "value", "modes") if key in answer}
    return own | {"replay": {"ok": answer.get("replay", {}).get("ok", False)}}


def _allowed(family: str, key: str) -> float:
    if family not in LOCAL:
        return TOLERANCES.get(key, USUAL)
    return USUAL if key == "value" else max(TOLERANCES.get(key, 0.0), math.sqrt(USUAL))


def _differ(family: str, key: str, found: Any, stored: Any) -> Iterator[tuple[bool, str]]:
    """Whether a difference is one of words, and what it is, for each entry."""
    if isinstance(found, Mapping) and isinstance(stored, Mapping):
        for name in dict.fromkeys([*stored, *found]):
            own = key if key in WORDS else name
            for weak, text in _differ(family, own, found.get(name), stored.get(name)):
                yield weak, f"{name}: {text}"
        return
    numbers, others = _flatten(found), _flatten(stored)
    if numbers is not None and others is not None and len(numbers) == len(others):
        off = max(abs(a - b) for a, b in zip(numbers, others, strict=True))
        scale = max(map(abs, [*numbers, *others]))
        # One sample at the edge of what a plan bears may end otherwise.
        if off > (1 if key in COUNTED else _allowed(family, key) * scale):
            yield key in WORDS, f"{_show(found)}, stored {_show(stored)}, off by {off:.2g}"
    elif isinstance(found, list) and isinstance(stored, list) and len(found) == len(stored):
        for one, other in zip(found, stored, strict=True):
            yield from _differ(family, key, one, other)
    elif found != stored:
        yield key in WORDS, f"{_show(found)}, stored {_show(stored)}"


def _flatten(value: Any) -> list[float] | None:
    """A number, or numbers in lists, as a list; None for anything else."""
    if isinstance(value, bool) or value is None:
        return None
    if isinstance(value, int | float):
        return [value]
    if not isinstance(value, list) or not value:
        return None
    parts = [_flatten(own) for own in value]
    known = [part for part in parts if part is not None]
    return [own for part in known for own in part] if len(known) == len(parts) else None


def _show(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 100 else f"{text[:60]} ... {text[-30:]}"


def _read(path: str) -> dict[str, Any]:
    return dict(read_json(path))


def _write(path: str, answers: Mapping[str, Any]) -> None:
    lines = [f"{json.dumps(name)}: {json.dumps(own)}" for name, own in sorted(answers.items())]
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


LARGEST = 4  # largest change of a number, in units of 2^-52 of it


def perturb_scenes(seed: int) -> None:
    """Multiply every number of each scene that is made from now on by 1 + k 2^-52, |k| <= 4.

    k follows from the seed, the name of the number and its first 14 digits, to which the number
    is rounded first. So a scene that is made again from its own numbers keeps them.
    """
    for kind in (Polygon, Finger, Friction, Scene):
        _perturb(kind, seed)


def _perturb(kind: Any, seed: int) -> None:
    check = getattr(kind.__post_init__, "exact", kind.__post_init__)
    names = [field.name for field in fields(kind) if field.init and field.name != "name"]

    def check_and_perturb(self: Any) -> None:
        # First as they were given: messages about bad numbers quote them.
        given = [name for name in names if getattr(self, name) is not None]
        left_out = set(names) - set(given)
        check(self)
        for name in left_out:
            object.__setattr__(self, name, None)
        for name in given:
            label = f"{seed} {kind.__name__}.{getattr(self, 'name', '')}.{name}"
            object.__setattr__(self, name, _change(getattr(self, name), label))
        check(self)

    check_and_perturb.exact = check  # type: ignore[attr-defined]
    kind.__post_init__ = check_and_perturb


def _change(value: Any, label: str) -> Any:
    if isinstance(value, np.ndarray):
        changed = [_change_number(float(v), f"{label}{i}") for i, v in np.ndenumerate(value)]
        return np.array(changed).reshape(value.shape)
    if isinstance(value, Real) and not isinstance(value, bool):
        return _change_number(float(value), label)
    return value


@cache
def _change_number(value: float, label: str) -> float:
    if value == 0.0 or not np.isfinite(value):
        return value
    rounded = float(f"{value:.13e}")
    k = random.Random(f"{label} {rounded!r}").randint(-LARGEST, LARGEST)
    return rounded * (1 + k * 2.0**-52)
