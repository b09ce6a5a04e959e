"""Cases of the corpus, and their answers as plain values.

A case names a family and what that is asked with. Families call the public functions alone.
"""

from __future__ import annotations

import copy
import json
import math
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import groupby, product
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

import wholearm
from wholearm import Plan, Problem

from ..problem.table import write_toml
from ..search.find_route import forget_roadmaps
from ..verification.verdict import find_least_force
from .queries import draw_leg, draw_query
from .stress.damage import BASE, STRANGE, change_tree, damage_torques
from .stress.scenes import draw_case
from .study import Case, Row

PROBLEMS = (
    "box_rolling", "heptagon", "heptagon_four_contacts", "heptagon_impact", "heptagon_twice",
    "hexagon", "square", "triangle",
)  # fmt: skip
OBJECTIVES = ("time", "effort", "margin")
RANGES = {"mass": 0.1, "inertia": 0.1, "friction": 0.2, "start_x": 5e-4, "geometry": 0.0}
"""Half widths of uncertain numbers."""
VARIANTS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "dwell": ("heptagon_four_contacts", {"settle": "10 %"}, {}),
    "dwell, landing": ("heptagon", {"settle": "10 %"}, {}),
    "dwell, effort": ("triangle", {"settle": 0.02}, {"objective": "effort"}),
    "dwell, impacts": ("heptagon_impact", {"settle": "10 %"}, {}),
    "dwell, rate": ("heptagon_four_contacts", {"settle": 0.02, "torque_rate_limit": 500.0}, {}),
    "rate": ("heptagon_four_contacts", {"torque_rate_limit": 500.0}, {}),
    "rate, landing": ("heptagon", {"torque_rate_limit": 500.0}, {}),
    "rate, box": ("box_rolling", {"torque_rate_limit": 500.0}, {}),
    "lag": ("heptagon_four_contacts", {"actuator_lag": 0.002}, {}),
    "rate and lag": (
        "heptagon_four_contacts", {"torque_rate_limit": 1000.0, "actuator_lag": 0.001}, {},
    ),
    "period": ("heptagon_four_contacts", {"control_period": 0.005}, {}),
    "period, landing": ("heptagon", {"control_period": 0.005}, {}),
    "period, linear": (
        "heptagon_four_contacts", {"control_period": 0.005, "control_hold": "linear"}, {},
    ),
    "ranges": ("heptagon_four_contacts", {"uncertainty": RANGES}, {"robust": 1.0}),
    "ranges, widest": (
        "heptagon_four_contacts", {"uncertainty": RANGES}, {"robust": 1.0, "largest": True},
    ),
    "ranges, landing": ("heptagon", {"uncertainty": RANGES}, {"robust": 1.0}),
    "ranges, none": ("box_rolling", {"uncertainty": RANGES}, {"robust": 1.0}),
    "speed": ("heptagon_four_contacts", {"speed_limit": 3.0}, {}),
    "certified": ("heptagon_four_contacts", {}, {"certify": True}),
    "certified, landing": ("heptagon", {}, {"certify": True}),
    "certified, impacts": ("heptagon_impact", {}, {"certify": True}),
    "accurate": ("heptagon_four_contacts", {}, {"accuracy": 1e-6}),
    "weak": ("heptagon_four_contacts", {"torque_limit": 0.7}, {}),
    "weak, rate": ("heptagon_four_contacts", {"torque_rate_limit": 5.0}, {}),
    "rough": ("heptagon_four_contacts", {"friction": 0.5}, {}),
    "pressed": ("heptagon_four_contacts", {"epsilon": 1.5}, {}),
    "weak, over time": ("square", {"torque_limit": 0.25}, {}),
    "rough, over time": ("triangle", {"friction": 0.5}, {}),
}  # fmt: skip
"""A problem, changes of it, and options of the planner."""
TUNED = {
    "heptagon_four_contacts": ("heptagon_tuned.csv", 0),
    "heptagon": ("heptagon_landing_tuned.csv", 0),
    "hexagon": ("hexagon_tuned.csv", 1),
}
"""Problems with torques that `tune` found, and how often it may stop on the way."""
SEED = 0


def list_cases() -> Iterator[Case]:
    """All cases: first those that take long, so that processes end together."""
    yield from (("tune", name) for name in reversed(TUNED))
    yield from (("plan over time", *own) for own in product(PROBLEMS, OBJECTIVES))
    yield from (("policy", name) for name in PROBLEMS)
    yield from (("plan", *own) for own in product(PROBLEMS, OBJECTIVES))
    yield from (("variant", name) for name in VARIANTS)
    yield from (("goal", k) for k in range(60))
    yield "robustness", "heptagon_four_contacts"
    yield from (("scene", k, OBJECTIVES[k % 3]) for k in range(60))
    yield from (("leg", k, OBJECTIVES[k % 3]) for k in range(60))
    yield from (("free", name) for name in PROBLEMS)
    yield from (("torques", name, share) for name in TUNED for share in (1.0, 1.05, 0.9))
    yield from (("compare", "heptagon_four_contacts"), ("report", "heptagon_four_contacts"))
    yield from (("predict", name) for name in PROBLEMS)
    yield from (("map", name) for name in PROBLEMS)
    yield from (("list", k) for k in range(20))
    yield from (("input", k) for k in range(120))
    yield from (("option", name) for name in OPTIONS)
    yield from (("torque file", k) for k in range(10))


def answer(case: Case, folder: Path) -> Row:
    """What the package says to a case; `folder` has the shipped problems."""
    family, *given = case
    row: Row = _shorten(FAMILIES[family](folder, *given))
    return row


def _shorten(value: Any) -> Any:
    """Plain values for JSON: numbers with nine digits, None for NaN and infinity."""
    if isinstance(value, dict):
        return {key: _shorten(own) for key, own in value.items()}
    if isinstance(value, list | tuple):
        return [_shorten(own) for own in value]
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    return value


def _load(folder: Path, name: str) -> Problem:
    return wholearm.load(str(folder / f"{name}.toml"))


def mask(text: str) -> str:
    """A message without its numbers, which differ as those of an answer may."""
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", text)


def _refuse(error: Exception) -> Row:
    """Why there is no answer."""
    row: Row = {"refused": type(error).__name__, "words": mask(str(error)), "text": str(error)}
    short = getattr(error, "shortfalls", ())
    if short:
        row["short"] = [own.part for own in short[:1]] + [short[0].kind, short[0].place.phase]
        row["amount"] = short[0].amount
    changes = getattr(error, "changes", ())
    row["advice"] = {change.parameter.key: change.value for change in changes}
    return row


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
    if any(own.settling for own in plan.phases):
        row["dwells"] = [own.settling.duration if own.settling else 0.0 for own in plan.phases]
    if plan.certificate is not None:
        row["gaps"] = sorted(plan.certificate.gaps)
        row["bound"] = None if plan.certificate.total is None else plan.certificate.total.bound
    if plan.ranges is not None:
        row |= {"without ranges": plan.ranges.nominal, "widest": plan.ranges.largest}
    return row


def _verify(problem: Problem, what: Any) -> Row:
    """The verdict about a plan or torques, and what the replay shows."""
    report = wholearm.verify(problem, what)
    known = filter(None, map(find_least_force, report.phases))
    energy = report.energy
    return {
        "ok": report.ok,
        "reached": report.reached,
        "failed phase": report.failed_phase,
        "failures": [mask(text) for text in report.failures],
        "arrivals": [own.arrival for own in report.phases],
        "least": [own.least for own in known],
        "events": [change.time for change in report.changes],
        "kinds": [f"{own.phase} {own.what} {own.kind}" for own in report.changes],
        "energy": [energy.work, energy.kinetic, energy.potential, energy.dry, energy.contact],
        "help": mask(json.dumps(report.to_dict().get("help"))) if not report.ok else "",
    }


def _solve(problem: Problem, **options: Any) -> Row:
    """A plan with its replay, or why there is none."""
    try:
        plan = wholearm.solve(problem, **options)
        return _describe_plan(plan) | {"replay": _verify(problem, plan)}
    except wholearm.WholearmError as error:
        return _refuse(error)


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
    try:
        found = wholearm.find_route(problem)
    except wholearm.WholearmError as error:
        return _refuse(error)
    phases = [
        f"{' '.join(own['contacts'])} {own.get('end', '')}" for own in found.problem.table["phases"]
    ]
    row = _describe_plan(found.plan) | {"route": phases, "in cells": found.route.in_cells}
    row["bound"] = None if found.bound is None else found.bound.value
    return row | {"replay": _verify(found.problem, found.plan)}


def _scene(folder: Path, number: int, objective: str) -> Row:
    try:
        problem = _read_table(draw_case(SEED, number).table)
    except wholearm.WholearmError as error:
        return _refuse(error)
    return _solve(problem, objective=objective)


def _read_table(table: Any) -> Problem:
    """A problem by way of its file, whose messages do not name the folder."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place, "problem.toml")
        path.write_text(write_toml(table), encoding="utf-8")
        try:
            return wholearm.load(str(path))
        except wholearm.InputError as error:
            raise wholearm.InputError("F", error.key, error.problem) from None


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
        "phases": [own.number for own in report.alone if own.reached],
        "stops": [own.stop for own in report.alone],
        "lost": [f"{own.number} {loss.contact}" for own in report.alone for loss in own.losses],
    }


def _follow(folder: Path, name: str, share: float) -> Row:
    """Torques of a file, times a share: up to their first loss of a contact, and simulated free."""
    problem = _load(folder, name)
    torque = wholearm.read_torque_csv(str(folder / "torques" / TUNED[name][0]))
    torque = replace(torque, coefficients=share * torque.coefficients)
    report = wholearm.verify_free(problem, torque)
    lost = [(phase.number, loss) for phase in report.phases for loss in phase.losses]
    # Once contacts bounce, and beyond the first loss, what rounding does grows from event to event.
    end = min([report.phases[0].stop, *(loss.time for _, loss in lost)]) - 1e-3
    events = [event for event in report.whole.events if event.time < end]
    free = {
        "ok": report.ok,
        "lost": [f"{number} {loss.contact}" for number, loss in lost[:1]],
        "times": [loss.time for _, loss in lost[:1]],
        "stops": [own.stop for own in report.phases if not lost or own.number < lost[0][0]],
        "events": [own.time for own in events],
        "kinds": [f"{own.kind.value} {own.contact}" for own in events],
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
            "path": own.path,
            "length": own.length,
            "kept": own.is_kept,
            "first": "" if own.slow is None else own.slow.name,
            "least": None if own.slow is None else own.slow.force,
            "speeds": [one.speed for one in own.survivals],
            "breaks": [f"{one.motion}: {one.first.name}" for one in own.survivals],
        }
        for own in wholearm.predict(_load(folder, name)).phases
    ]
    return {"phases": phases}


def _control(folder: Path, name: str) -> Row:
    """The policy of a least-time plan, and what becomes of its phases."""
    problem = _load(folder, name)
    plan = wholearm.solve(problem)
    try:
        policy = wholearm.make_policy(problem, plan)
        report = wholearm.verify_policy(problem, plan, policy)
    except wholearm.WholearmError as error:
        return _refuse(error)
    return {
        "duration": policy.duration,
        "durations": [own["duration"] for own in policy.about["phases"]],
        "shares": [own["share"] for own in policy.about["phases"]],
        "ok": report.ok,
        "reached": [phase.number for phase in report.phases if phase.reached],
        "stops": [own.stop for own in report.phases],
        "lost": [f"{own.number} {loss.contact}" for own in report.phases for loss in own.losses],
    }


def _assess(folder: Path, name: str) -> Row:
    problem = _load(folder, name)
    plan = wholearm.solve(problem, "margin")
    start = partial(ThreadPoolExecutor, 1)
    study = wholearm.assess_robustness(problem, plan, samples=40, phase=3, start=start)
    return {
        "samples": len(study.records),
        "goals": study.reached.hits,
        "kept": study.kept.hits,
        "first": sorted(study.first_lost),
    }


def _compare(folder: Path, name: str) -> Row:
    problem = _load(folder, name)
    with tempfile.TemporaryDirectory() as place:
        path = str(Path(place, "plan.npz"))
        wholearm.solve(problem).save(path)
        comparison = wholearm.compare(problem, [path, str(folder / "torques" / TUNED[name][0])])
    numbers = _collect(
        comparison.contenders,
        ok="ok",
        durations="duration",
        efforts="effort",
        margins="margin",
        losses="lost",
        peaks="peaks",
        simulations="simulations",
    )
    contacts = [f"{own.contact} in phase {own.phase}" for own in comparison.contenders]
    return numbers | {"contacts": contacts}


def _collect(items: Iterable[Any], **names: str) -> Row:
    """Lists of attributes of the items, by key."""
    items = list(items)
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
    tables = [own for own in re.findall(r"<table>.*?</table>", text) if "planning took" not in own]
    cells = re.findall(r"<td[^>]*>(.*?)</td>", "".join(tables))
    numbers = [float(cell) for cell in cells if re.fullmatch(r"[-+]?\d+\.\d+", cell)]
    return {"exit": status, "cells": len(cells), "numbers": numbers}


def _draw_map(folder: Path, name: str) -> Row:
    chart = wholearm.build_map(_load(folder, name))
    points = np.array([crossing.point for crossing in chart.crossings])
    return {
        "formations": _count(chart.formations),
        "borders": _count(border.contacts for border in chart.borders),
        "crossings": _count(own.contacts for own in chart.crossings),
        "x": np.sort(points[:, 0]).tolist(),
        "phi": np.sort(points[:, 1]).tolist(),
        "forth": sum(int(own.forth.sum()) for own in chart.borders),
        "back": sum(int(own.back.sum()) for own in chart.borders),
        "possible": chart.possible.sum(axis=0).tolist(),
    }


def _count(formations: Iterable[Iterable[object]]) -> list[Any]:
    """How many formations there are, and a digest of their names."""
    names = sorted(" ".join(map(str, formation)) for formation in formations)
    return [len(names), f"{crc32(' '.join(names).encode()):08x}"]


def _list(folder: Path, number: int) -> Row:
    """Formations along a route: that of the documentation first, then those of legs."""
    if number == 0:
        problem = _load(folder, "heptagon_four_contacts")
        places = (0.045, -2.0), (-0.0637, -2.0), (-0.0505, -23.4), (0.0078, -50.0)
        route = wholearm.list_formations(problem, *((x, np.radians(phi)) for x, phi in places))
        return {
            "route": [" ".join(map(str, own.contacts)) for own in route],
            "places": [own.stop.tolist() for own in route],
        }
    leg = draw_leg(SEED + 1, number, folder)
    if leg is None:
        return {"refused": "no route"}
    return {
        "route": [" ".join(own["contacts"]) for own in leg[0].table["phases"]],
        "places": [list(stop) for stop in leg[1]],
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
    """A problem file with another entry; the message does not name the folder."""
    table = copy.deepcopy(BASE)
    change = change_tree(np.random.default_rng([SEED, number]), table, STRANGE)
    try:
        _read_table(table)
    except wholearm.WholearmError as error:
        return {"change": change, "refused": type(error).__name__, "message": str(error)}
    return {"change": change, "refused": ""}


def _ask(folder: Path, name: str) -> Row:
    try:
        wholearm.solve(_load(folder, "heptagon_four_contacts"), **OPTIONS[name])
    except (wholearm.WholearmError, TypeError) as error:
        text = str(error).replace(str(folder), "F")
        return {"refused": type(error).__name__, "message": mask(text)}
    return {"refused": ""}


def _read_torques(folder: Path, number: int) -> Row:
    """A table of torques with another entry."""
    rng = np.random.default_rng([SEED, number])
    change, content = damage_torques(rng, b"t,tau1,tau2\n0,0,0\n0.5,1,0\n1,0,0\n")
    with tempfile.TemporaryDirectory() as place:
        path = Path(place, "bad.csv")
        path.write_bytes(content)
        try:
            torque = wholearm.read_torque_csv(str(path))
            wholearm.verify(_load(folder, "square"), torque)
        except wholearm.WholearmError as error:
            text = str(error).replace(str(path), "F")
            return {"change": change, "refused": type(error).__name__, "message": text}
    return {"change": change, "refused": ""}


FAMILIES: dict[str, Callable[..., Row]] = {
    "plan": _plan,
    "plan over time": partial(_plan, transcription="time"),
    "variant": _vary,
    "goal": _reach,
    "scene": _scene,
    "leg": _leg,
    "free": _simulate_free,
    "torques": _follow,
    "tune": _tune,
    "predict": _predict,
    "policy": _control,
    "robustness": _assess,
    "compare": _compare,
    "report": _report,
    "map": _draw_map,
    "list": _list,
    "input": _read,
    "option": _ask,
    "torque file": _read_torques,
}
