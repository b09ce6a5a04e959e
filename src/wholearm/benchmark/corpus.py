"""Regression corpus: answers of the package compared with stored ones.

A case names a family and its arguments; families call public functions only. Two answers agree if
kinds, verdicts and contact modes are equal and numbers differ by at most `TOLERANCES`; of plans for
`margin`, values and verdicts. An answer with a better value passes, whatever else differs.
"""

from __future__ import annotations

import argparse
import copy
import fnmatch
import json
import math
import os
import random
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import cache, partial
from itertools import chain, groupby, pairwise, product
from numbers import Real
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

import wholearm
from wholearm import InputError, Plan, Problem

from ..common.document import Table, to_plain
from ..common.files import read_json, write_text
from ..geometry.tracing import check_phases, trace_phases
from ..planning.nlp import collect_costs
from ..problem.read import build_problem, read_problem
from ..problem.table import write_toml
from ..scene.model import Finger, Friction, Polygon, Scene
from ..search.find_route import forget_roadmaps
from ..simulation.simulate import simulate
from ..simulation.system import STAGE_TIMES
from .queries import draw_leg, draw_query
from .scenes import draw_case
from .stress import BASE, OBJECTIVES, STRANGE, change_tree, damage_torques
from .study import Case, Findings, Row, Study, digest_source, group, name_case

FOUR = "heptagon_four_contacts"
PROBLEMS = (
    "box_rolling", "heptagon", FOUR, "heptagon_impact", "heptagon_twice", "hexagon", "square",
    "triangle",
)  # fmt: skip
RANGES = {"mass": 0.1, "inertia": 0.1, "friction": 0.2, "start_x": 5e-4, "geometry": 0.0}
"""Half widths of uncertain numbers."""
VARIANTS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "dwell": (FOUR, {"settle": "10 %"}, {}),
    "dwell, landing": ("heptagon", {"settle": "10 %"}, {}),
    "dwell, effort": ("triangle", {"settle": 0.02}, {"objective": "effort"}),
    "dwell, impacts": ("heptagon_impact", {"settle": "10 %"}, {}),
    "dwell, rate": (FOUR, {"settle": 0.02, "torque_rate_limit": 500.0}, {}),
    "rate": (FOUR, {"torque_rate_limit": 500.0}, {}),
    "rate, landing": ("heptagon", {"torque_rate_limit": 500.0}, {}),
    "rate, box": ("box_rolling", {"torque_rate_limit": 500.0}, {}),
    "lag": (FOUR, {"actuator_lag": 0.002}, {}),
    "rate and lag": (FOUR, {"torque_rate_limit": 1000.0, "actuator_lag": 0.001}, {}),
    "period": (FOUR, {"control_period": 0.005}, {}),
    "period, landing": ("heptagon", {"control_period": 0.005}, {}),
    "period, linear": (FOUR, {"control_period": 0.005, "control_hold": "linear"}, {}),
    "ranges": (FOUR, {"uncertainty": RANGES}, {"robust": 1.0}),
    "ranges, widest": (FOUR, {"uncertainty": RANGES}, {"robust": 1.0, "largest": True}),
    "ranges, landing": ("heptagon", {"uncertainty": RANGES}, {"robust": 1.0}),
    "ranges, none": ("box_rolling", {"uncertainty": RANGES}, {"robust": 1.0}),
    "speed": (FOUR, {"speed_limit": 3.0}, {}),
    "certified": (FOUR, {}, {"certify": True}),
    "certified, landing": ("heptagon", {}, {"certify": True}),
    "certified, impacts": ("heptagon_impact", {}, {"certify": True}),
    "accurate": (FOUR, {}, {"accuracy": 1e-6}),
    "weak": (FOUR, {"torque_limit": 0.7}, {}),
    "weak, rate": (FOUR, {"torque_rate_limit": 5.0}, {}),
    "rough": (FOUR, {"friction": 0.5}, {}),
    "pressed": (FOUR, {"epsilon": 1.5}, {}),
    "weak, over time": ("square", {"torque_limit": 0.25}, {}),
    "rough, over time": ("triangle", {"friction": 0.5}, {}),
}
"""Variants by name: problem, changes of it, and options of the planner."""
TUNED = {
    FOUR: ("heptagon_tuned.csv", 0),
    "heptagon": ("heptagon_landing_tuned.csv", 0),
    "hexagon": ("hexagon_tuned.csv", 1),
}
"""Problems with tuned torques: file, and number of stops allowed in `tune`."""
SEED = 0


def list_cases() -> list[Case]:
    """All cases."""
    return [(family, *each) for family, (_, cases) in FAMILIES.items() for each in cases]


def answer(case: Case, folder: Path) -> Row:
    """Answer of the package to a case, or its refusal; `folder` has the shipped problems.

    JSON values, numbers with nine digits.
    """
    family, *arguments = case
    try:
        row = FAMILIES[family][0](folder, *arguments)
    except wholearm.WholearmError as error:
        row = _refuse(error)
    text = json.dumps(to_plain(row))
    return dict(json.loads(text, parse_float=lambda digits: float(f"{float(digits):.9g}")))


def _load(folder: Path, name: str) -> Problem:
    return wholearm.load(str(folder / f"{name}.toml"))


def mask(text: str) -> str:
    """A message with its numbers masked."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)


def _refuse(error: Exception) -> Row:
    """The answer of a refusal."""
    row: Row = {"refused": type(error).__name__, "words": mask(str(error)), "text": str(error)}
    for lack in getattr(error, "shortfalls", ())[:1]:
        row |= {"short": [lack.part, lack.kind, lack.place.phase], "amount": lack.amount}
    changes = getattr(error, "changes", ())
    return row | {"advice": {change.parameter.key: change.value for change in changes}}


def list_modes(plan: Plan) -> list[list[str]]:
    """Sequence of contact modes and joint directions in every phase.

    Modes shorter than a thousandth of the phase are ignored.
    """
    modes = []
    for phase in plan.phases:
        spans = [s for s in phase.modes if s.stop - s.start > 1e-3 * phase.duration]
        texts = (f"{' '.join(s.contacts.values())} {' '.join(s.joints)}" for s in spans)
        modes.append([text for text, _ in groupby(texts)])
    return modes


def _describe_plan(plan: Plan) -> Row:
    row: Row = {
        "status": plan.status.value,
        "objective": plan.options.goal.value,
        "value": plan.value,
        "durations": [phase.duration for phase in plan.phases],
        "modes": list_modes(plan),
        "impacts": len(plan.transitions),
    }
    dwells = [phase.settling.duration if phase.settling else 0.0 for phase in plan.phases]
    if any(dwells):
        row["dwells"] = dwells
    if plan.certificate is not None:
        row["gaps"] = sorted(plan.certificate.gaps)
        row["bound"] = None if plan.certificate.total is None else plan.certificate.total.bound
    if plan.ranges is not None:
        row |= {"without ranges": plan.ranges.nominal, "widest": plan.ranges.largest}
    return row


def _verify(problem: Problem, what: Any) -> Row:
    """Verdict on a plan or torques, with results of the replay."""
    report = wholearm.verify(problem, what)
    energy = report.energy
    return {
        "ok": report.ok,
        "reached": report.reached,
        "failed phase": report.failed_phase,
        "failures": [mask(text) for text in report.failures],
        "arrivals": [phase.arrival for phase in report.phases],
        "least": [force.value for phase in report.phases if (force := phase.least_force)],
        "events": [change.time for change in report.changes],
        "kinds": [f"{change.phase} {change.what} {change.kind}" for change in report.changes],
        "energy": [energy.work, energy.kinetic, energy.potential, energy.dry, energy.contact],
        "help": mask(json.dumps(report.to_dict().get("help"))) if not report.ok else "",
    }


def _solve(problem: Problem, **options: Any) -> Row:
    """A plan with its replay."""
    plan = wholearm.solve(problem, **options)
    return _describe_plan(plan) | {"replay": _verify(problem, plan)}


def _plan(folder: Path, name: str, objective: str, **options: Any) -> Row:
    return _solve(_load(folder, name), objective=objective, **options)


def _vary(folder: Path, variant: str) -> Row:
    name, changes, options = VARIANTS[variant]
    return _solve(_load(folder, name).with_(changes), **options)


def _reach(folder: Path, number: int) -> Row:
    """Route to a goal of the queries study, or the refusal.

    From number 40 on the goal is an edge without x, or sometimes an angle.
    """
    problem = draw_query(SEED, number, folder)
    goal = problem.table["goal"]
    if number >= 40:
        flush, polygon = goal["flush"], problem.scene.polygon
        if flush == problem.table["start"]["flush"]:
            flush = (flush + 1) % polygon.n_vertices
        edge = polygon.flush_angle(flush)
        free = {"flush": flush} if number % 4 else {"phi_deg": np.degrees(edge) + 10.0}
        problem = problem.with_({"goal": free})
    # Roadmaps of other goals may lead to another route.
    forget_roadmaps()
    answer = wholearm.find_route(problem)
    phases = [
        f"{' '.join(phase['contacts'])} {phase.get('end', '')}"
        for phase in answer.problem.table["phases"]
    ]
    row = _describe_plan(answer.plan) | {"route": phases, "in cells": answer.route.in_cells}
    row["bound"] = None if answer.bound is None else answer.bound.value
    return row | {"replay": _verify(answer.problem, answer.plan)}


def _scene(folder: Path, number: int, objective: str) -> Row:
    problem = build_problem(draw_case(SEED, number).table, "F")
    check_phases(problem)
    return _solve(problem, objective=objective)


def _leg(folder: Path, number: int, objective: str) -> Row:
    leg = draw_leg(SEED, number, folder)
    return {"refused": "no route"} if leg is None else _solve(leg[0], objective=objective)


def _simulate_free(folder: Path, name: str) -> Row:
    """Phases of a plan with free contacts, each from its planned start.

    The whole simulation by the clock is excluded: rounding errors grow from phase to phase.
    """
    problem = _load(folder, name)
    report = wholearm.verify_free(problem, wholearm.solve(problem))
    return {
        "ok": report.ok,
        "failures": [mask(text) for text in report.failures],
        "phases": [phase.number for phase in report.alone if phase.reached],
        "stops": [phase.stop for phase in report.alone],
        "lost": [f"{number} {contact}" for number, contact, _ in _list_losses(report.alone)],
    }


def _list_losses(phases: Iterable[Any]) -> list[tuple[int, str, float]]:
    return [(each.number, loss.contact, loss.time) for each in phases for loss in each.losses]


def _follow(folder: Path, name: str, factor: float) -> Row:
    """Torques of a file times a factor: verified, and simulated with free contacts."""
    problem = _load(folder, name)
    torque = wholearm.read_torque_csv(str(folder / "torques" / TUNED[name][0]))
    torque = replace(torque, coefficients=factor * torque.coefficients)
    report = wholearm.verify_free(problem, torque)
    lost = _list_losses(report.phases)
    # With bouncing contacts, and after the first loss, rounding errors grow from event to event.
    end = min([report.phases[0].stop, *(time for *_, time in lost)]) - 1e-3
    events = [event for event in report.whole.events if event.time < end]
    free = {
        "ok": report.ok,
        "lost": [f"{number} {contact}" for number, contact, _ in lost[:1]],
        "times": [time for *_, time in lost[:1]],
        "stops": [phase.stop for phase in report.phases if not lost or phase.number < lost[0][0]],
        "events": [event.time for event in events],
        "kinds": [f"{event.kind.value} {event.contact}" for event in events],
    }
    try:
        verdict = _verify(problem, torque)
    except wholearm.WholearmError as error:
        verdict = _refuse(error)
    return {"free": free, "told": verdict}


def _tune(folder: Path, name: str) -> Row:
    tuning = wholearm.tune(_load(folder, name), brake=True, stops=TUNED[name][1])
    return {
        "ok": tuning.ok,
        "reason": mask(tuning.reason),
        "raised": [[phase.raised, phase.braked, phase.supported] for phase in tuning.phases],
        "simulations": tuning.simulations,
        **_collect(tuning.phases, acting="acting", durations="duration", least="least"),
    }


def _predict(folder: Path, name: str) -> Row:
    phases = [
        {
            "path": phase.path,
            "length": phase.length,
            "kept": phase.is_kept,
            "first": "" if phase.slow is None else phase.slow.name,
            "least": None if phase.slow is None else phase.slow.force,
            "speeds": [survival.speed for survival in phase.survivals],
            "breaks": [f"{survival.motion}: {survival.first.name}" for survival in phase.survivals],
        }
        for phase in wholearm.predict(_load(folder, name)).phases
    ]
    return {"phases": phases}


def _control(folder: Path, name: str) -> Row:
    """The policy of a least-time plan, and the outcome of its phases."""
    problem = _load(folder, name)
    plan = wholearm.solve(problem)
    policy = wholearm.make_policy(problem, plan)
    report = wholearm.verify_policy(problem, plan, policy)
    return {
        "duration": policy.duration,
        "durations": [phase["duration"] for phase in policy.about["phases"]],
        "shares": [phase["share"] for phase in policy.about["phases"]],
        "ok": report.ok,
        "reached": [phase.number for phase in report.phases if phase.reached],
        "stops": [phase.stop for phase in report.phases],
        "lost": [f"{number} {contact}" for number, contact, _ in _list_losses(report.phases)],
    }


def _assess(folder: Path, name: str) -> Row:
    problem = _load(folder, name)
    plan = wholearm.solve(problem, "margin")
    start = partial(ThreadPoolExecutor, 1)
    study = wholearm.assess_robustness(problem, plan, samples=40, phase=3, start=start)
    counts = {"goals": study.reached.hits, "kept": study.kept.hits}
    return {"samples": len(study.records), **counts, "first": sorted(study.first_lost)}


def _compare(folder: Path, name: str) -> Row:
    problem = _load(folder, name)
    with tempfile.TemporaryDirectory() as directory:
        path = str(Path(directory, "plan.npz"))
        wholearm.solve(problem).save(path)
        comparison = wholearm.compare(problem, [path, str(folder / "torques" / TUNED[name][0])])
    attributes = {"ok": "ok", "durations": "duration", "efforts": "effort", "margins": "margin"}
    attributes |= {"losses": "lost", "peaks": "peaks", "simulations": "simulations"}
    # Among contacts with c_n = epsilon rounding decides which one is the smallest.
    contacts = [
        f"{each.contact} in phase {each.phase}" if (each.margin or 0.0) > 1e-5 else "several"
        for each in comparison.contenders
    ]
    return _collect(comparison.contenders, **attributes) | {"contacts": contacts}


def _collect(items: Sequence[Any], **names: str) -> Row:
    """Lists of attributes of the items, by key."""
    return {key: [getattr(item, name) for item in items] for key, name in names.items()}


def _report(folder: Path, name: str) -> Row:
    """Numbers in the tables of a report of a plan and of torques, without timings."""
    from ..__main__ import start

    with tempfile.TemporaryDirectory() as directory:
        path, page = str(Path(directory, "plan.npz")), Path(directory, "page.html")
        wholearm.solve(_load(folder, name)).save(path)
        torques = str(folder / "torques" / TUNED[name][0])
        status = start(["report", str(folder / f"{name}.toml"), path, torques, "-o", str(page)])
        text = page.read_text(encoding="utf-8")
    tables = (t for t in re.findall(r"<table>.*?</table>", text) if "planning took" not in t)
    cells = re.findall(r"<td[^>]*>(.*?)</td>", "".join(tables))
    numbers = [float(cell) for cell in cells if re.fullmatch(r"[-+]?\d+\.\d+", cell)]
    return {"exit": status, "cells": len(cells), "numbers": numbers}


def _draw_map(folder: Path, name: str) -> Row:
    graph = wholearm.build_map(_load(folder, name))
    x, phi = np.sort([crossing.point for crossing in graph.crossings], axis=0).T.tolist()
    return {
        "formations": _count(graph.formations),
        "borders": _count(border.contacts for border in graph.borders),
        "crossings": _count(crossing.contacts for crossing in graph.crossings),
        "x": x,
        "phi": phi,
        "forth": sum(int(border.forth.sum()) for border in graph.borders),
        "back": sum(int(border.back.sum()) for border in graph.borders),
        "possible": graph.possible.sum(axis=0).tolist(),
    }


def _count(formations: Iterable[Iterable[object]]) -> list[Any]:
    """Number of formations, and a digest of their names."""
    names = sorted(" ".join(map(str, formation)) for formation in formations)
    return [len(names), f"{crc32(' '.join(names).encode()):08x}"]


def _list(folder: Path, number: int) -> Row:
    """Formations along a route: number 0 is that of the documentation, others are legs."""
    if number == 0:
        problem = _load(folder, FOUR)
        places = (0.045, -2.0), (-0.0637, -2.0), (-0.0505, -23.4), (0.0078, -50.0)
        route = wholearm.list_formations(problem, *((x, np.radians(phi)) for x, phi in places))
        formations = [map(str, stretch.contacts) for stretch in route]
        stops = [stretch.stop.tolist() for stretch in route]
    else:
        leg = draw_leg(SEED + 1, number, folder)
        if leg is None:
            return {"refused": "no route"}
        formations = [phase["contacts"] for phase in leg[0].table["phases"]]
        stops = [list(stop) for stop in leg[1]]
    return {"route": [" ".join(names) for names in formations], "places": stops}


def count(problem: Problem) -> dict[str, int]:
    """Work of a least-time plan and its replay: sizes, iterations, evaluations.

    Sizes are those of the first NLP of each block, such as "phase 5-6 of 6: rows".
    """
    notes = list[tuple[str, int]]()
    with collect_costs() as costs:
        runs = costs.runs
        plan = wholearm.solve(
            problem, replay=False, progress=lambda text: notes.append((text, len(runs)))
        )
    counts = dict[str, int]()
    for (text, first), (_, last) in pairwise([*notes, ("", len(runs))]):
        for size in ("unknowns", "rows", "jacobian nonzeros", "hessian nonzeros"):
            if first < last:
                value = getattr(runs[first], size.replace(" ", "_"))
                counts.setdefault(f"{text.removesuffix(': time')}: {size}", value)
    replay = simulate(problem, plan.trajectory.torque)
    return counts | {
        "panels of curves": sum(len(curve.panels) for curve in trace_phases(problem)),
        "iterations": sum(run.iterations for run in runs),
        "evaluations of the replay": len(STAGE_TIMES) * (replay.steps + replay.rejected),
    }


OPTIONS: dict[str, dict[str, Any]] = {
    "objective": {"objective": "speed"},
    "intervals": {"intervals": 0},
    "intervals, text": {"intervals": "many"},
    "accuracy": {"accuracy": 1.0},
    "duration": {"duration": 1.0},
    "short duration": {"objective": "margin", "duration": 0.01},
    "degree": {"degree": 9},
    "scheme": {"scheme": "euler"},
    "transcription": {"transcription": "space"},
    "certify": {"objective": "margin", "certify": True},
    "certified ranges": {"certify": True, "robust": 1.0},
    "widest": {"largest": True},
    "robust": {"robust": 30.0},
    "time limit": {"time_limit": -1.0},
    "unknown": {"speed": 1.0},
}


def _read(folder: Path, number: int) -> Row:
    """Reading of a problem file with a changed entry."""
    table = copy.deepcopy(BASE)
    change = change_tree(np.random.default_rng([SEED, number]), table, STRANGE)
    return {"change": change} | _try(wholearm.load, "problem.toml", write_toml(table).encode())


def _try(work: Callable[[str], object], name: str = "none", content: bytes = b"") -> Row:
    """Whether `work` on a file is refused, and the message without its folder."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, name)
        path.write_bytes(content)
        try:
            work(str(path))
        except (wholearm.WholearmError, TypeError) as error:
            return {"refused": type(error).__name__, "message": str(error).replace(str(path), "F")}
    return {"refused": ""}


def _ask(folder: Path, name: str) -> Row:
    row = _try(lambda _: wholearm.solve(_load(folder, FOUR), **OPTIONS[name]))
    return {key: mask(text) for key, text in row.items()}


def _read_torques(folder: Path, number: int) -> Row:
    """Reading of a table of torques with a changed entry."""
    rng = np.random.default_rng([SEED, number])
    change, content = damage_torques(rng, b"t,tau1,tau2\n0,0,0\n0.5,1,0\n1,0,0\n")

    def verify(path: str) -> None:
        wholearm.verify(_load(folder, "square"), wholearm.read_torque_csv(path))

    return {"change": change} | _try(verify, "bad.csv", content)


FAMILIES: dict[str, tuple[Callable[..., Row], list[Case]]] = {
    "tune": (_tune, [*zip(reversed(TUNED))]),
    "plan over time": (partial(_plan, transcription="time"), [*product(PROBLEMS, OBJECTIVES)]),
    "policy": (_control, [*zip(PROBLEMS)]),
    "plan": (_plan, [*product(PROBLEMS, OBJECTIVES)]),
    "variant": (_vary, [*zip(VARIANTS)]),
    "goal": (_reach, [*zip(range(60))]),
    "robustness": (_assess, [(FOUR,)]),
    "scene": (_scene, [(k, OBJECTIVES[k % 3]) for k in range(60)]),
    "leg": (_leg, [(k, OBJECTIVES[k % 3]) for k in range(60)]),
    "free": (_simulate_free, [*zip(PROBLEMS)]),
    "torques": (_follow, [*product(TUNED, (1.0, 1.05, 0.9))]),
    "compare": (_compare, [(FOUR,)]),
    "report": (_report, [(FOUR,)]),
    "predict": (_predict, [*zip(PROBLEMS)]),
    "map": (_draw_map, [*zip(PROBLEMS)]),
    "counts": (lambda folder, name: count(_load(folder, name)), [*zip(PROBLEMS)]),
    "list": (_list, [*zip(range(20))]),
    "input": (_read, [*zip(range(120))]),
    "option": (_ask, [*zip(OPTIONS)]),
    "torque file": (_read_torques, [*zip(range(10))]),
}
"""Families: function and list of arguments. Long ones come first, so that processes end
together."""


TOLERANCES = {
    "value": 1e-6, "amount": 1e-2, "advice": 5e-2, "numbers": 1e-3, "least": 1e-3, "margins": 1e-3,
    "stops": 2e-3,
}  # fmt: skip
"""Relative to the largest number of an entry: accuracy of Ipopt and of the refinement of limits.

An amount is the shortfall in a relaxed problem, advice the result of a bisection. Numbers of a
report have four digits; a least force or margin is one at an instant. Phases of a policy stop at
samples, 1 ms apart in simulations of more than 1 s.
"""
DEFAULT = 1e-4  # of all other entries: the accuracy of plans
LOCAL_OPTIMA = ("plan over time", "goal", "scene", "leg")
"""Families with several local optima: values agree within `DEFAULT`.

Near an optimum, motions whose values differ by `DEFAULT` differ by its root.
"""
TEXT_KEYS = ("words", "text", "advice", "help", "reason")
"""Entries without influence on the verdict: texts, and advice limited by processor time."""
SAMPLE_COUNTS = ("goals", "kept")  # entries that are numbers of samples
BANDS = {"iterations": 1.25, "evaluations of the replay": 1.1, "panels of curves": 1.25}
"""Largest ratio to stored counts that depend on rounding; other counts must not grow.

Over five kernels of OpenBLAS, five seeds of changes in the last bits and NumPy 2.1 to 2.5,
iterations differ by 1 %, evaluations by 0.5 %, and panels by one.
"""


class Corpus(Study):
    """Comparison of new answers with stored ones."""

    name, title = "corpus", "Answers against stored ones"
    keys = ("family",)
    folder, needs_problems = "build", True
    problems, rounding = Path("problems"), 0
    options = """\
--only PATTERN ...  cases whose names match, such as 'plan heptagon *' (all)
--values            compare values, verdicts and contact modes of plans, and nothing else of these,
    as rounding may change what an optimum leaves open
--rounding K        change all numbers of scenes in the last bits, drawn from K (0: none) = 0
    in 0..1000000000
--answers FILE      of what is stored = results/corpus.json
--update            store what is found now
"""

    def stamp(self, options: argparse.Namespace) -> dict[str, Any]:
        """Kernel, rounding, and a digest of source, problems and machine."""
        source = digest_source(sorted(Path(options.problems).glob("*.toml")))
        kernel = os.environ.get("OPENBLAS_CORETYPE")
        return {"kernel": kernel, "rounding": options.rounding, "source": source}

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Cases selected by `--only`."""
        self.problems, self.rounding = Path(options.problems), options.rounding
        for name in PROBLEMS:
            read_problem(self.problems / f"{name}.toml")
        cases = {name_case(case): case for case in list_cases()}
        selected = set[str]()
        for pattern in options.only or "*":
            names = fnmatch.filter(cases, pattern)
            if not names:
                text = f"{pattern!r} given; no case matches; families: {', '.join(FAMILIES)}"
                raise InputError("", "--only", text)
            selected.update(names)
        # Each once, and long ones first.
        yield from (case for name, case in cases.items() if name in selected)

    def limit(self, case: Case) -> float:
        """Tuning takes a thousand simulations."""
        return 300.0 if case[0] == "tune" else 120.0

    def run(self, case: Case) -> Row:
        """Compute the answer of a case."""
        if self.rounding:
            perturb_scenes(self.rounding)
        return {"answer": answer(case, self.problems)}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """Numbers of equal and different answers by family; stores them on `--update`."""
        new = options.update and not Path(options.answers).exists()
        stored = {} if new else read_json(options.answers)
        if options.update:
            stored |= {row["name"]: row["answer"] for row in rows}
            names = sorted({*map(name_case, list_cases())} & stored.keys())
            lines = [f"{json.dumps(name)}: {json.dumps(stored[name])}" for name in names]
            write_text(options.answers, "{\n" + ",\n".join(lines) + "\n}\n")
        kinds = ("same", "better", "other words", "differs")
        table, remarks, failures = list[list[Any]](), list[str](), list[str]()
        for family, family_rows in group(rows, "family").items():
            count = Counter[str]()
            for row in family_rows:
                pair = row["answer"], stored.get(row["name"])
                kind, texts = compare(family, *(map(_reduce, pair) if options.values else pair))
                count[kind] += 1
                if kind == "differs":
                    failures += [f"{row['name']}: {text}" for text in texts[:3]]
                elif texts:
                    remarks.append(f"* {kind}: {row['name']}: {texts[0]}")
            seconds = sum(row["seconds"] for row in family_rows)
            table.append([family, len(family_rows), *(count[kind] for kind in kinds), seconds])
        table.append(["all", *map(sum, zip(*(line[1:] for line in table), strict=True))])
        heads = ["family", *(f"{name}:d" for name in ("cases", *kinds)), "processor time [s]:.0f"]
        return [Table(heads, table), "\n".join(remarks)], failures


STUDY = Corpus()


def compare(family: str, new: Any, stored: Any) -> tuple[str, list[str]]:
    """Kind of agreement with a stored answer, and the differences."""
    if stored is None:
        return "differs", ["no answer is stored; --update stores it"]
    if family == "counts":
        changes = [f"{key} is counted in one of them alone" for key in new.keys() ^ stored.keys()]
        for key in new.keys() & stored.keys():
            if new[key] > (bound := stored[key] * BANDS.get(key, 1.0)):
                text = f"{key} has grown from {stored[key]} to {new[key]}"
                changes.append(f"{text} (allowed: {bound:.0f})" if key in BANDS else text)
        return ("differs", sorted(changes)) if changes else ("same", [])
    if stored.get("objective") == "margin":
        # Phases that do not set the margin are not determined.
        new, stored = (_reduce(answer) | {"modes": ""} for answer in (new, stored))
    if "value" in new and new["objective"] == stored.get("objective"):
        gain = new["value"] / stored["value"] - 1
        gain = gain if stored["objective"] == "margin" else -gain
        is_valid = new["replay"]["ok"] >= stored["replay"]["ok"]
        if gain > _allowed(family, "value") and is_valid:
            return "better", [f"value {new['value']:.9g} instead of {stored['value']:.9g}"]
    if "refused" in stored and new.get("replay", {}).get("ok"):
        return "better", [f"value {new['value']:.9g} instead of a refusal"]
    texts = list(_differ(family, "", new, stored))
    if not texts:
        return "same", []
    failures = [text for is_text, text in texts if not is_text]
    return ("differs", failures) if failures else ("other words", [text for _, text in texts])


def _reduce(answer: Any) -> Any:
    """Verdict, value and contact modes of a plan, or its refusal; other answers unchanged."""
    if not answer or not {"replay", "refused"} & answer.keys():
        return answer
    keys = ("refused", "objective", "value", "modes")
    entries = {key: answer[key] for key in keys if key in answer}
    return entries | {"replay": {"ok": answer.get("replay", {}).get("ok", False)}}


def _allowed(family: str, key: str) -> float:
    if family not in LOCAL_OPTIMA:
        return TOLERANCES.get(key, DEFAULT)
    return DEFAULT if key == "value" else max(TOLERANCES.get(key, 0.0), math.sqrt(DEFAULT))


def _differ(family: str, key: str, new: Any, stored: Any) -> Iterator[tuple[bool, str]]:
    """Differences of entries: (whether only in texts, description)."""
    if isinstance(new, Mapping) and isinstance(stored, Mapping):
        for name in dict.fromkeys([*stored, *new]):
            subkey = key if key in TEXT_KEYS else name
            for is_text, text in _differ(family, subkey, new.get(name), stored.get(name)):
                yield is_text, f"{name}: {text}"
        return
    leaves, stored_leaves = _list_leaves(new), _list_leaves(stored)
    if len(leaves) == len(stored_leaves) and {*map(type, leaves + stored_leaves)} <= {int, float}:
        deviation = max(abs(a - b) for a, b in zip(leaves, stored_leaves, strict=True))
        scale = max(map(abs, leaves + stored_leaves))
        # One sample close to the limits of a plan may have another outcome.
        if deviation > (1 if key in SAMPLE_COUNTS else _allowed(family, key) * scale):
            yield key in TEXT_KEYS, f"{_show(new)}, stored {_show(stored)}, off by {deviation:.2g}"
    elif isinstance(new, list) and isinstance(stored, list) and len(new) == len(stored):
        for a, b in zip(new, stored, strict=True):
            yield from _differ(family, key, a, b)
    elif new != stored:
        yield key in TEXT_KEYS, f"{_show(new)}, stored {_show(stored)}"


def _list_leaves(value: Any) -> list[Any]:
    """Leaves of nested lists, empty lists included, or the value itself."""
    return [*chain(*map(_list_leaves, value))] if value and isinstance(value, list) else [value]


def _show(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 100 else f"{text[:60]} ... {text[-30:]}"


LARGEST = 4  # largest change of a number, in units of 2^-52 of it


def perturb_scenes(seed: int) -> None:
    """Multiply all numbers of scenes created from now on by 1 + k 2^-52, |k| <= 4.

    Numbers are first rounded to 14 digits. k is a hash of the seed, the name of the number and
    these digits, so a scene created again from its own numbers keeps them.
    """

    def change(kind: Any) -> None:
        check = getattr(kind.__post_init__, "exact", kind.__post_init__)
        names = [field.name for field in fields(kind) if field.init and field.name != "name"]

        def check_and_perturb(self: Any) -> None:
            # Original values are checked first: messages quote them.
            values = {name: getattr(self, name) for name in names}
            check(self)
            for name, value in values.items():
                label = f"{seed} {kind.__name__}.{getattr(self, 'name', '')}.{name}"
                changed = None if value is None else _change(getattr(self, name), label)
                object.__setattr__(self, name, changed)
            check(self)

        check_and_perturb.exact = check  # type: ignore[attr-defined]
        kind.__post_init__ = check_and_perturb

    for kind in (Polygon, Finger, Friction, Scene):
        change(kind)


def _change(value: Any, label: str) -> Any:
    if isinstance(value, bool) or not isinstance(value, Real | np.ndarray):
        return value
    array = np.asarray(value, dtype=float)
    changed = [_change_number(float(v), f"{label}{i}") for i, v in np.ndenumerate(array)]
    return np.array(changed).reshape(array.shape) if array.ndim else changed[0]


@cache
def _change_number(value: float, label: str) -> float:
    if value == 0.0 or not np.isfinite(value):
        return value
    rounded = float(f"{value:.13e}")
    k = random.Random(f"{label} {rounded!r}").randint(-LARGEST, LARGEST)
    return rounded * (1 + k * 2.0**-52)
