"""Regression corpus: answers of the package compared with stored ones.

A case names a family and what that is asked with; families call the public functions alone. Two
answers agree if kinds, verdicts and contact modes are the same and numbers are within `TOLERANCES`.
A better value of the objective is no difference, whatever else it changes.
"""

from __future__ import annotations

import argparse
import copy
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
from fnmatch import fnmatch
from functools import cache, partial
from itertools import chain, groupby, pairwise, product
from numbers import Real
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

import wholearm
from wholearm import Plan, Problem

from ..common.document import Table, to_plain
from ..common.files import read_json, write_text
from ..geometry.tracing import check_phases, trace_phases
from ..planning.nlp import open_ledger
from ..problem.read import build_problem
from ..problem.table import write_toml
from ..scene.model import Finger, Friction, Polygon, Scene
from ..search.find_route import forget_roadmaps
from ..simulation.simulate import simulate
from ..simulation.system import NODES
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
"""A problem, changes of it, and options of the planner."""
TUNED = {
    FOUR: ("heptagon_tuned.csv", 0),
    "heptagon": ("heptagon_landing_tuned.csv", 0),
    "hexagon": ("hexagon_tuned.csv", 1),
}
"""Problems with torques that `tune` found, and how often it may stop on the way."""
SEED = 0


def list_cases() -> list[Case]:
    """All cases."""
    return [(family, *each) for family, (_, cases) in FAMILIES.items() for each in cases]


def answer(case: Case, folder: Path) -> Row:
    """What the package says to a case, or why it refuses; `folder` has the shipped problems.

    Plain values as JSON has them, numbers with nine digits.
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
    """A message without its numbers, which differ as those of an answer may."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)


def _refuse(error: Exception) -> Row:
    """Why there is no answer."""
    row: Row = {"refused": type(error).__name__, "words": mask(str(error)), "text": str(error)}
    for short in getattr(error, "shortfalls", ())[:1]:
        row |= {"short": [short.part, short.kind, short.place.phase], "amount": short.amount}
    changes = getattr(error, "changes", ())
    return row | {"advice": {change.parameter.key: change.value for change in changes}}


def list_modes(plan: Plan) -> list[list[str]]:
    """Contact modes and directions of the joints that follow each other in every phase.

    Those of less than a thousandth of it do not count.
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
    """The verdict about a plan or torques, and what the replay shows."""
    report = wholearm.verify(problem, what)
    energy = report.energy
    return {
        "ok": report.ok,
        "reached": report.reached,
        "failed phase": report.failed_phase,
        "failures": [mask(text) for text in report.failures],
        "arrivals": [phase.arrival for phase in report.phases],
        "least": [one.value for phase in report.phases if (one := phase.least_force)],
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
    """A goal of the queries study, with the blocked borders where nothing leads there.

    From the 40th on it is an edge without x, or now and then an angle.
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
    # What is known of a scene from other goals may lead to another route.
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
    """Phases of a plan, each from its planned start, without telling which contacts hold.

    The whole by the clock is not looked at: what rounding does to it grows from phase to phase.
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


def _follow(folder: Path, name: str, share: float) -> Row:
    """Torques of a file, times a share: up to their first loss of a contact, and simulated free."""
    problem = _load(folder, name)
    torque = wholearm.read_torque_csv(str(folder / "torques" / TUNED[name][0]))
    torque = replace(torque, coefficients=share * torque.coefficients)
    report = wholearm.verify_free(problem, torque)
    lost = _list_losses(report.phases)
    # Once contacts bounce, and beyond the first loss, what rounding does grows from event to event.
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
        told = _verify(problem, torque)
    except wholearm.WholearmError as error:
        told = _refuse(error)
    return {"free": free, "told": told}


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
            "speeds": [one.speed for one in phase.survivals],
            "breaks": [f"{one.motion}: {one.first.name}" for one in phase.survivals],
        }
        for phase in wholearm.predict(_load(folder, name)).phases
    ]
    return {"phases": phases}


def _control(folder: Path, name: str) -> Row:
    """The policy of a least-time plan, and what becomes of its phases."""
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
    with tempfile.TemporaryDirectory() as place:
        path = str(Path(place, "plan.npz"))
        wholearm.solve(problem).save(path)
        comparison = wholearm.compare(problem, [path, str(folder / "torques" / TUNED[name][0])])
    names = {"ok": "ok", "durations": "duration", "efforts": "effort", "margins": "margin"}
    names |= {"losses": "lost", "peaks": "peaks", "simulations": "simulations"}
    # Of contacts that keep epsilon exactly rounding decides which one presses least.
    contacts = [
        f"{each.contact} in phase {each.phase}" if (each.margin or 0.0) > 1e-5 else "several"
        for each in comparison.contenders
    ]
    return _collect(comparison.contenders, **names) | {"contacts": contacts}


def _collect(items: Sequence[Any], **names: str) -> Row:
    """Lists of attributes of the items, by key."""
    return {key: [getattr(item, name) for item in items] for key, name in names.items()}


def _report(folder: Path, name: str) -> Row:
    """Numbers in the tables of a report of a plan and of torques, but for how long it took."""
    from ..__main__ import start

    with tempfile.TemporaryDirectory() as place:
        path, page = str(Path(place, "plan.npz")), Path(place, "page.html")
        wholearm.solve(_load(folder, name)).save(path)
        torques = str(folder / "torques" / TUNED[name][0])
        status = start(["report", str(folder / f"{name}.toml"), path, torques, "-o", str(page)])
        text = page.read_text(encoding="utf-8")
    tables = (t for t in re.findall(r"<table>.*?</table>", text) if "planning took" not in t)
    cells = re.findall(r"<td[^>]*>(.*?)</td>", "".join(tables))
    numbers = [float(cell) for cell in cells if re.fullmatch(r"[-+]?\d+\.\d+", cell)]
    return {"exit": status, "cells": len(cells), "numbers": numbers}


def _draw_map(folder: Path, name: str) -> Row:
    chart = wholearm.build_map(_load(folder, name))
    x, phi = np.sort([crossing.point for crossing in chart.crossings], axis=0).T.tolist()
    return {
        "formations": _count(chart.formations),
        "borders": _count(border.contacts for border in chart.borders),
        "crossings": _count(crossing.contacts for crossing in chart.crossings),
        "x": x,
        "phi": phi,
        "forth": sum(int(border.forth.sum()) for border in chart.borders),
        "back": sum(int(border.back.sum()) for border in chart.borders),
        "possible": chart.possible.sum(axis=0).tolist(),
    }


def _count(formations: Iterable[Iterable[object]]) -> list[Any]:
    """How many formations there are, and a digest of their names."""
    names = sorted(" ".join(map(str, formation)) for formation in formations)
    return [len(names), f"{crc32(' '.join(names).encode()):08x}"]


def _list(folder: Path, number: int) -> Row:
    """Formations along a route: that of the documentation first, then those of legs."""
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
    """Plan a problem for least time, replay the plan, and count what that takes.

    Sizes are those of the first NLP of each block, such as "phase 5-6 of 6: rows".
    """
    notes = list[tuple[str, int]]()
    with open_ledger() as ledger:
        runs = ledger.runs
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
        "evaluations of the replay": len(NODES) * (replay.steps + replay.rejected),
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
    """A problem file with another entry."""
    table = copy.deepcopy(BASE)
    change = change_tree(np.random.default_rng([SEED, number]), table, STRANGE)
    return {"change": change} | _try(wholearm.load, "problem.toml", write_toml(table).encode())


def _try(work: Callable[[str], object], name: str = "none", content: bytes = b"") -> Row:
    """Whether work on a file is refused, by a message that does not name its folder."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place, name)
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
    """A table of torques with another entry."""
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
"""What families ask, and with which arguments; first those that take long, so that processes end
together."""


TOLERANCES = {
    "value": 1e-6, "amount": 1e-2, "advice": 5e-2, "numbers": 1e-3, "least": 1e-3, "margins": 1e-3,
    "stops": 2e-3,
}  # fmt: skip
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
BANDS = {"iterations": 1.25, "evaluations of the replay": 1.1, "panels of curves": 1.25}
"""Largest ratio to the stored counts of those in which rounding has a part; others may not grow.

Over five kernels of OpenBLAS, five seeds of changes in the last bits and NumPy 2.1 to 2.5,
iterations differ by 1 %, evaluations by 0.5 %, and panels by one.
"""


class Corpus(Study):
    """Answers of today against stored ones."""

    name, title = "corpus", "Answers against stored ones"
    keys = ("family",)
    folder, shipped = "build", True
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
        """How numbers are rounded, and source, problems and machine that records are of."""
        source = digest_source(sorted(Path(options.problems).glob("*.toml")))
        kernel = os.environ.get("OPENBLAS_CORETYPE")
        return {"kernel": kernel, "rounding": options.rounding, "source": source}

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Those that are asked for."""
        self.problems, self.rounding = Path(options.problems), options.rounding
        for case in list_cases():
            if any(fnmatch(name_case(case), pattern) for pattern in options.only or "*"):
                yield case

    def limit(self, case: Case) -> float:
        """Tuning takes a thousand simulations."""
        return 300.0 if case[0] == "tune" else 120.0

    def run(self, case: Case) -> Row:
        """Ask."""
        if self.rounding:
            perturb_scenes(self.rounding)
        return {"answer": answer(case, self.problems)}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """How many answers of each family are the same, and which differ; or they are stored."""
        new = options.update and not Path(options.answers).exists()
        stored = {} if new else read_json(options.answers)
        if options.update:
            stored |= {row["name"]: row["answer"] for row in rows}
            names = sorted({*map(name_case, list_cases())} & stored.keys())
            lines = [f"{json.dumps(name)}: {json.dumps(stored[name])}" for name in names]
            write_text(options.answers, "{\n" + ",\n".join(lines) + "\n}\n")
        kinds = ("same", "better", "other words", "differs")
        table, others, wrong = list[list[Any]](), list[str](), list[str]()
        for family, mine in group(rows, "family").items():
            count = Counter[str]()
            for row in mine:
                pair = row["answer"], stored.get(row["name"])
                kind, texts = compare(family, *(map(_reduce, pair) if options.values else pair))
                count[kind] += 1
                if kind == "differs":
                    wrong += [f"{row['name']}: {text}" for text in texts[:3]]
                elif texts:
                    others.append(f"* {kind}: {row['name']}: {texts[0]}")
            seconds = sum(row["seconds"] for row in mine)
            table.append([family, len(mine), *(count[kind] for kind in kinds), seconds])
        table.append(["all", *map(sum, zip(*(line[1:] for line in table), strict=True))])
        heads = ["family", *(f"{name}:d" for name in ("cases", *kinds)), "processor time [s]:.0f"]
        return [Table(heads, table), "\n".join(others)], wrong


STUDY = Corpus()


def compare(family: str, found: Any, stored: Any) -> tuple[str, list[str]]:
    """Whether an answer is as stored: same, better, other words, or differs; and where."""
    if stored is None:
        return "differs", ["no answer is stored; --update stores it"]
    if family == "counts":
        grown = [f"{key} is counted in one of them alone" for key in found.keys() ^ stored.keys()]
        for key in found.keys() & stored.keys():
            if found[key] > (most := stored[key] * BANDS.get(key, 1.0)):
                text = f"{key} has grown from {stored[key]} to {found[key]}"
                grown.append(f"{text} (allowed: {most:.0f})" if key in BANDS else text)
        return ("differs", sorted(grown)) if grown else ("same", [])
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
    keys = ("refused", "objective", "value", "modes")
    entries = {key: answer[key] for key in keys if key in answer}
    return entries | {"replay": {"ok": answer.get("replay", {}).get("ok", False)}}


def _allowed(family: str, key: str) -> float:
    if family not in LOCAL:
        return TOLERANCES.get(key, USUAL)
    return USUAL if key == "value" else max(TOLERANCES.get(key, 0.0), math.sqrt(USUAL))


def _differ(family: str, key: str, found: Any, stored: Any) -> Iterator[tuple[bool, str]]:
    """Whether a difference is one of words, and what it is, for each entry."""
    if isinstance(found, Mapping) and isinstance(stored, Mapping):
        for name in dict.fromkeys([*stored, *found]):
            subkey = key if key in WORDS else name
            for weak, text in _differ(family, subkey, found.get(name), stored.get(name)):
                yield weak, f"{name}: {text}"
        return
    leaves, others = _list_leaves(found), _list_leaves(stored)
    if len(leaves) == len(others) and {*map(type, leaves + others)} <= {int, float}:
        off = max(abs(a - b) for a, b in zip(leaves, others, strict=True))
        scale = max(map(abs, leaves + others))
        # One sample at the edge of what a plan bears may end otherwise.
        if off > (1 if key in COUNTED else _allowed(family, key) * scale):
            yield key in WORDS, f"{_show(found)}, stored {_show(stored)}, off by {off:.2g}"
    elif isinstance(found, list) and isinstance(stored, list) and len(found) == len(stored):
        for one, other in zip(found, stored, strict=True):
            yield from _differ(family, key, one, other)
    elif found != stored:
        yield key in WORDS, f"{_show(found)}, stored {_show(stored)}"


def _list_leaves(value: Any) -> list[Any]:
    """What nested lists hold, among it empty ones, or the value itself."""
    return [*chain(*map(_list_leaves, value))] if value and isinstance(value, list) else [value]


def _show(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 100 else f"{text[:60]} ... {text[-30:]}"


LARGEST = 4  # largest change of a number, in units of 2^-52 of it


def perturb_scenes(seed: int) -> None:
    """Multiply every number of each scene that is made from now on by 1 + k 2^-52, |k| <= 4.

    k follows from the seed, the name of the number and its first 14 digits, to which the number
    is rounded first. So a scene that is made again from its own numbers keeps them.
    """

    def change(kind: Any) -> None:
        check = getattr(kind.__post_init__, "exact", kind.__post_init__)
        names = [field.name for field in fields(kind) if field.init and field.name != "name"]

        def check_and_perturb(self: Any) -> None:
            # First as they were given: messages about bad numbers quote them.
            given = {name: getattr(self, name) for name in names}
            check(self)
            for name, value in given.items():
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
    given = np.asarray(value, dtype=float)
    changed = [_change_number(float(v), f"{label}{i}") for i, v in np.ndenumerate(given)]
    return np.array(changed).reshape(given.shape) if given.ndim else changed[0]


@cache
def _change_number(value: float, label: str) -> float:
    if value == 0.0 or not np.isfinite(value):
        return value
    rounded = float(f"{value:.13e}")
    k = random.Random(f"{label} {rounded!r}").randint(-LARGEST, LARGEST)
    return rounded * (1 + k * 2.0**-52)
