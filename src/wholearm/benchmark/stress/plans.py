"""One scene of the stress study: planned, replayed and checked, or its refusal judged."""

from __future__ import annotations

import copy
import time
import traceback
from typing import Any, NamedTuple

import numpy as np

from ...common.errors import InputError, SolverError, WholearmError
from ...geometry.path_guess import check_phases
from ...planning.plan import solve
from ...problem.definition import Problem
from ...problem.read import build_problem
from ...results.trajectory import Trajectory
from ...verification.verify import verify
from .cases import Case, draw_case
from .plan_check import check_plan
from .refusals import judge

OBJECTIVES = ("time", "effort", "margin")
NOISE = 1e-10
"""Relative change of the masses that must not change an answer."""
SAME = 1e-6
"""Relative difference of two values that rounding may make."""


class Finding(NamedTuple):
    """Something that must not happen.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    text : str
    """

    kind: str
    text: str


KINDS = (
    "traceback",
    "warning",
    "hang",
    "crash",
    "list that does not load",
    "plan refuted by replay",
    "plan refuted by residual",
    "refusal where a motion exists",
    "no answer",
    "optimum that differs under noise",
    "check that failed",
)
"""Kinds of findings that are counted; each count has to be zero."""


class Answer(NamedTuple):
    """What the planner said about a problem and an objective.

    Attributes
    ----------
    outcome : {"planned", "refused", "failed"}
    value : float or None
    text : str
        Of the refusal or failure.
    findings : list of Finding
    verdict : str
        Kind of the second look at a refusal.
    """

    outcome: str
    value: float | None
    text: str
    findings: list[Finding]
    verdict: str = ""


def run_scene(task: tuple[int, int, str]) -> dict[str, Any]:
    """Run one scene, given as (seed, number, objective); what came of it as plain data."""
    seed, number, objective = task
    case = draw_case(seed, number)
    answer, seconds = run_case(case, objective)
    return {
        "scene": [number, objective],
        "kind": case.kind,
        "outcome": answer.outcome,
        "value": answer.value,
        "text": answer.text,
        "verdict": answer.verdict,
        "findings": [list(finding) for finding in answer.findings],
        "seconds": round(seconds, 3),
    }


def run_case(case: Case, objective: str) -> tuple[Answer, float]:
    """Plan a case for an objective, with and without noise; the time is that of one plan [s]."""
    problem, refusal = _load(case.table)
    if problem is None or refusal is not None:
        return _refuse_list(case, problem, refusal), 0.0
    started = time.process_time()
    answer = _plan(problem, objective, case)
    seconds = time.process_time() - started
    noisy, _ = _load(_perturb(case))
    findings = [*answer.findings, *_compare(answer, _plan_again(noisy, objective))]
    return answer._replace(findings=findings), seconds


def _load(table: dict[str, Any]) -> tuple[Problem | None, Exception | None]:
    problem = None
    try:
        problem = build_problem(table)
        check_phases(problem)
    except Exception as error:
        return problem, error
    return problem, None


def _refuse_list(case: Case, problem: Problem | None, error: Exception | None) -> Answer:
    """Why a problem did not load, and whether that is right."""
    if not isinstance(error, InputError):
        return _fail(error)
    listed = case.kind.endswith("from the map")
    verdict, reason = "open", ""
    if problem is not None:
        verdict, reason = _judge(problem, error, case)
    findings = []
    if listed:
        findings.append(Finding("list that does not load", f"{error} ({verdict}: {reason})"))
    elif verdict == "refuted":
        findings.append(Finding("refusal where a motion exists", f"{error} ({reason})"))
    elif verdict == "failed":
        findings.append(Finding("check that failed", f"{error}: {reason}"))
    return Answer("refused", None, str(error), findings, verdict)


def _plan(problem: Problem, objective: str, case: Case) -> Answer:
    """Plan, replay and check."""
    try:
        plan = solve(problem, objective)
    except SolverError as error:
        return Answer("failed", None, str(error), [Finding("no answer", str(error))])
    except WholearmError as error:
        verdict, reason = _judge(problem, error, case)
        kinds = {"refuted": "refusal where a motion exists", "failed": "check that failed"}
        found = [Finding(kinds[verdict], f"{error} ({reason})")] if verdict in kinds else []
        return Answer("refused", None, str(error), found, verdict)
    except Exception as error:
        return _fail(error)
    return Answer("planned", plan.value, "", _check(problem, plan.trajectory))


def _fail(error: Exception | None) -> Answer:
    """An exception that nobody meant to raise."""
    kind = "warning" if isinstance(error, Warning) else "traceback"
    lines = traceback.format_exception(error)
    text = "".join(lines[-4:]).strip()
    return Answer("failed", None, repr(error), [Finding(kind, text)])


def _check(problem: Problem, plan: Trajectory) -> list[Finding]:
    findings = []
    try:
        report = verify(problem, plan)
        findings += [Finding("plan refuted by replay", text) for text in report.failures[:1]]
    except WholearmError as error:
        findings.append(Finding("plan refuted by replay", str(error)))
    except Exception as error:
        findings += _fail(error).findings
    try:
        found = check_plan(problem, plan)
        findings += [Finding("plan refuted by residual", "; ".join(found[:3]))] if found else []
    except Exception as error:
        findings.append(Finding("check that failed", _fail(error).findings[0].text))
    return findings


def _judge(problem: Problem, error: WholearmError, case: Case) -> tuple[str, str]:
    try:
        return judge(problem, error, case.stops)
    except Exception as failure:
        return "failed", _fail(failure).findings[0].text


def _perturb(case: Case) -> dict[str, Any]:
    """The problem with noise in its masses."""
    rng = np.random.default_rng(case.number)
    return add_noise(case.table, rng)


def add_noise(table: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """A problem file's table with noise in the object's mass and the joints' inertias."""
    changed = copy.deepcopy(dict(table))
    body = changed["object"]
    for part in (body, *changed["fingers"].values()):
        for key in ("mass", "inertia"):
            if key in part:
                part[key] *= 1 + NOISE * float(rng.uniform(-1, 1))
    return changed


def _plan_again(problem: Problem | None, objective: str) -> Answer:
    """Plan without looking at the plan."""
    if problem is None:
        return Answer("failed", None, "does not load", [])
    try:
        return Answer("planned", solve(problem, objective).value, "", [])
    except SolverError as error:
        return Answer("failed", None, str(error), [])
    except WholearmError as error:
        return Answer("refused", None, str(error), [])
    except Exception as error:
        return Answer("failed", None, repr(error), [])


def _compare(one: Answer, other: Answer) -> list[Finding]:
    """What noise changed in an answer."""
    kind = "optimum that differs under noise"
    if one.outcome != other.outcome:
        text = f"{one.outcome}, with noise {other.outcome} {other.text or one.text}"
        return [Finding(kind, text)] if "failed" not in (one.outcome, other.outcome) else []
    if one.value is None or other.value is None:
        return []
    difference = abs(one.value - other.value) / max(abs(one.value), 1e-300)
    if difference <= SAME:
        return []
    return [Finding(kind, f"{one.value:.9g} and {other.value:.9g}")]
