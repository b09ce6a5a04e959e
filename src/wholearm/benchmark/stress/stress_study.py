"""The stress study: generated scenes, changed problems and damaged files, counted by kind.

Every plan is replayed and checked by Newton's and Euler's laws written out anew; every refusal is
looked at by arguments that share nothing with the planner.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from ...common.errors import SolverError, WholearmError
from ...common.files import make_folder, write_text
from ...geometry.tracing import check_phases, load
from ...planning.plan import solve
from ...problem.read import build_problem, read_problem
from ...problem.table import write_toml
from ...verification.verify import verify
from ..study import Case, Row, Study, format_table, name_case
from .damage import describe_error, run_file
from .plan_check import check_plan
from .refusals import judge
from .scenes import Case as Scene
from .scenes import draw_case

OBJECTIVES = ("time", "effort", "margin")
SAME = 1e-6  # relative difference of two values that rounding may make
TRIALS = {"noise": 8, "change": 20}
"""Times that noise is added to the masses, and that masses, friction, drag and limits change."""
_PARTS = ("palm", "finger1", "finger2", "viscous", "dry", "torque_limit")
CHANGES = {"noise": (("mass", "inertia"), 1e-10), "change": (("mass", "inertia", *_PARTS), 0.1)}
"""Numbers that each of them changes, and by how much at most, relative."""

Finding = tuple[str, str]
"""The kind of something that must not happen, and a text."""
KINDS = (
    "traceback", "warning", "list that does not load", "plan refuted by replay",
    "plan refuted by residual", "refusal where a motion exists", "no answer",
    "optimum that differs under noise", "check that failed", "no plan for a shipped problem",
    "unclear end",
)  # fmt: skip
"""Kinds of findings that are counted; each count has to be zero."""


class Stress(Study):
    """Generated scenes, damaged files, and shipped problems with other numbers."""

    name, title = "stress", "Stress study"
    strict = seeded = True
    options = """\
--scenes N           generated scenes = 1000 in 0..10000000
--files N            damaged files = 0 in 0..10000000
--problems FILE ...  problem files to plan with noise, and with other masses and forces
--only K             run scene K alone, and write its problem file in 0..10000000
"""

    def stamp(self, options: argparse.Namespace) -> dict[str, Any]:
        """Records are of one seed."""
        return {"seed": options.seed}

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Scenes, files, and problems: all of these once before any comes again."""
        seed, only = options.seed, options.only
        for path in options.problems:
            load(path)
        if only is not None:
            make_folder(options.output)
            path = os.path.join(options.output, f"stress_{seed}_{only}.toml")
            write_text(path, write_toml(draw_case(seed, only).table))
        numbers = range(options.scenes) if only is None else [only]
        yield from product(["scene"], [seed], numbers, OBJECTIVES)
        if only is None:
            yield from product(["file"], [seed], range(options.files))
            for number in range(max(TRIALS.values())):
                kinds = [what for what, count in TRIALS.items() if number < count]
                for what, path in product(kinds, options.problems):
                    yield from product(["problem"], [path], OBJECTIVES, [what], [number])

    def limit(self, case: Case) -> float:
        """By the kind of the case: a scene is planned twice."""
        return {"scene": 30.0, "file": 20.0}.get(case[0], 60.0)

    def run(self, case: Case) -> Row:
        """Run one case: a scene with and without noise, a file, or a problem with other numbers."""
        kind, *arguments = case
        if kind == "file":
            return run_file(*arguments)
        if kind == "problem":
            path, objective, what, number = arguments
            table = change(read_problem(path).table, what, np.random.default_rng(number))
            row = _plan(table, objective)
            if row["outcome"] == "refused":
                row["findings"].append(("no plan for a shipped problem", row["text"]))
            return row
        seed, number, objective = arguments
        scene = draw_case(seed, number)
        row = _plan(scene.table, objective, scene)
        if row["outcome"] != "failed":
            noisy = change(scene.table, "noise", np.random.default_rng(number))
            row["findings"] += _compare(row, _plan(noisy, objective))
        return {"kind": scene.kind, **row}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        """Tables of each part, and every finding."""
        found = [(name_case(row), *own) for row in rows for own in row["findings"]]
        found += [
            (name_case(row), "warning", f"printed: {row['printed']}")
            for row in rows
            if "printed" in row
        ]
        found += compare_values([row for row in rows if row["case"][0] == "problem"])
        lines = []
        for kind, title, describe in (
            ("scene", "Generated scenes", _describe_scenes),
            ("file", "Damaged files", _describe_files),
            ("problem", "Problems with noise and with other masses and forces", _describe_trials),
        ):
            mine = [row for row in rows if row["case"][0] == kind]
            if mine:
                lines += [f"## {title}", "", *describe(mine), ""]
        counted = Counter(kind for _, kind, _ in found)
        kinds = dict.fromkeys([*KINDS, *counted])
        lines += format_table(["finding", "number"], [(kind, counted[kind]) for kind in kinds])
        return "\n".join(lines), [f"{where}: {kind}: {text}" for where, kind, text in found]


STUDY = Stress()


def _plan(table: Mapping[str, Any], objective: str, scene: Scene | None = None) -> Row:
    """Load, plan, replay and check; of a scene, judge the refusal."""
    problem, loaded, refusal = None, False, None
    row: Row = {"outcome": "failed", "value": None, "text": "", "findings": [], "verdict": ""}
    findings: list[Finding] = row["findings"]
    try:
        problem = build_problem(table)
        check_phases(problem)
        loaded = True
        plan = solve(problem, objective)
        row |= {"outcome": "planned", "value": plan.value}
        findings += [("plan refuted by replay", t) for t in verify(problem, plan).failures[:1]]
        if found := check_plan(problem, plan.trajectory):
            findings.append(("plan refuted by residual", "; ".join(found[:3])))
    except WholearmError as error:
        row["text"] = str(error)
        if row["outcome"] == "planned":
            findings.append(("plan refuted by replay", str(error)))
        elif isinstance(error, SolverError):
            findings.append(("no answer", str(error)))
        else:
            row["outcome"], refusal = "refused", error
    except Exception as error:
        findings.append(describe_error(error))
    if scene is None or refusal is None:
        return row
    kind, reason = "open", ""
    try:
        if problem is not None:
            kind, reason = judge(problem, refusal, scene.stops)
    except Exception as failure:
        kind, reason = "failed", describe_error(failure)[1]
    row["verdict"], kinds = kind, dict[str, str]()
    kinds["refuted"], kinds["failed"] = "refusal where a motion exists", "check that failed"
    if not loaded and scene.kind.endswith("from the map"):
        findings.append(("list that does not load", f"{refusal} ({kind}: {reason})"))
    elif kind in kinds:
        findings.append((kinds[kind], f"{refusal} ({reason})"))
    return row


def _compare(one: Row, other: Row) -> list[Finding]:
    """What noise changed in an answer."""
    if other["outcome"] == "failed":
        return []
    text = ""
    if one["outcome"] != other["outcome"]:
        why = other["text"] or one["text"]
        text = f"{one['outcome']}, with noise {other['outcome']} {why}"
    elif one["value"] and abs(one["value"] - other["value"]) > SAME * abs(one["value"]):
        text = f"{one['value']:.9g} and {other['value']:.9g}"
    return [("optimum that differs under noise", text)] if text else []


def change(table: Mapping[str, Any], what: str, rng: np.random.Generator) -> dict[str, Any]:
    """A problem file's table with noise, or with other masses, friction, drag and torque limits."""
    keys, share = CHANGES[what]

    def vary(key: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: vary(name, own) for name, own in value.items()}
        return value * (1 + share * float(rng.uniform(-1, 1))) if key in keys else value

    return dict(vary("", table))


def compare_values(rows: Iterable[Row]) -> list[tuple[str, str, str]]:
    """Optima of one problem and objective that differ under noise."""
    groups: dict[str, list[float]] = {}
    for row in rows:
        _, path, objective, what, _ = row["case"]
        if what == "noise" and row["value"] is not None:
            groups.setdefault(f"{path}, {objective}", []).append(row["value"])
    found = []
    for name, values in groups.items():
        apart = np.ptp(values) / np.abs(values).max()
        if apart > SAME:
            text = f"{min(values):.9g} to {max(values):.9g}, {apart:.2g} apart"
            found.append((name, "optimum that differs under noise", text))
    return found


def _describe_scenes(rows: Sequence[Row]) -> list[str]:
    verdicts = [row["verdict"] or "not judged" for row in rows if row["outcome"] == "refused"]
    seconds = np.array([row["seconds"] for row in rows])
    middle, most = np.percentile(seconds, [50, 95])
    text = f"median {middle:.2f} s, 95 % within {most:.2f} s, longest {seconds.max():.2f} s"
    about = [
        ("scenes", len({row["case"][2] for row in rows})),
        ("answers, one for each objective", _count(row["outcome"] for row in rows)),
        ("refusals, looked at a second time", _count(verdicts)),
        ("processor time of an answer, planned twice and checked", text),
    ]
    outcomes = ("planned", "refused", "failed")
    kinds = Counter((row["kind"], row["outcome"]) for row in rows)
    names = sorted({row["kind"] for row in rows})
    counts = [(kind, *(kinds[kind, outcome] for outcome in outcomes)) for kind in names]
    return [
        *format_table(["", ""], about, 2),
        "",
        *format_table(["kind of scene", *outcomes], counts),
    ]


def _describe_files(rows: Sequence[Row]) -> list[str]:
    statuses = dict[str, list[str]]()
    for row in sorted(rows, key=lambda row: str(row["kind"])):
        statuses.setdefault(row["kind"], []).append(str(row["status"]))
    table = [(kind, len(mine), _count(mine)) for kind, mine in statuses.items()]
    return format_table(["files", "number", "exit status"], table)


def _describe_trials(rows: Sequence[Row]) -> list[str]:
    table = []
    for path, objective in dict.fromkeys(tuple(row["case"][1:3]) for row in rows):
        mine = [row for row in rows if row["case"][1:3] == [path, objective]]
        good = sum(not row["findings"] for row in mine)
        values = [row["value"] for row in mine if row["case"][3] == "noise" and row["value"]]
        apart = f"{np.ptp(values) / np.abs(values).max():.1e}" if values else ""
        table.append((os.path.basename(path), objective, len(mine), good, apart))
    heads = ["problem", "objective", "trials", "without a finding", "values apart under noise"]
    return format_table(heads, table, 2)


def _count(names: Iterable[str]) -> str:
    return ", ".join(f"{number} {name}" for name, number in sorted(Counter(names).items()))
