"""The stress study: generated scenes, changed problems and damaged files, counted by kind.

Every plan is replayed and checked at many instants by the laws of Newton, Euler and Coulomb written
out anew, and for overlaps; every refusal by arguments that share nothing with the planner.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..common.arrays import Array
from ..common.document import Table
from ..common.errors import ReplayError, SolverError, WholearmError
from ..common.files import make_folder, write_text
from ..geometry.tracing import check_phases, load
from ..planning.plan import solve
from ..problem.definition import End, Phase, Problem
from ..problem.read import build_problem, read_problem
from ..problem.table import write_toml
from ..results.trajectory import Samples, Trajectory
from ..scene.model import Scene
from ..verification.newton_euler import balance, locate
from ..verification.verify import verify
from .damage import describe_error, run_file
from .refusals import OVERLAP, clearances, judge
from .scenes import DrawnScene, draw_case
from .study import Case, Findings, Row, Study, name_case

OBJECTIVES = ("time", "effort", "margin")
SAME = 1e-6  # relative difference of two values that rounding may make
ROUNDING = 1e-6  # what may be left of an equation, a gap or its rate, in the scene's units
STILL = 1e-5  # speed over the scene's own below which friction may point either way
TRIALS = {"noise": 8, "change": 20}
"""Times that noise is added to the masses, and that masses, friction, drag and limits change."""
_PARTS = ("palm", "finger1", "finger2", "viscous", "dry", "torque_limit")
CHANGES = {"noise": (("mass", "inertia"), 1e-10), "change": (("mass", "inertia", *_PARTS), 0.1)}
"""Numbers that each of them changes, and by how much at most, relative."""

Finding = tuple[str, str]  # the kind of something that must not happen, and a text
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

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """Tables of each part, and every finding."""
        findings = [(name_case(row), *finding) for row in rows for finding in row["findings"]]
        findings += [
            (name_case(row), "warning", f"printed: {row['printed']}")
            for row in rows
            if "printed" in row
        ]
        findings += compare_values([row for row in rows if row["case"][0] == "problem"])
        parts = list[str | Table]()
        for kind, title, describe in (
            ("scene", "Generated scenes", _describe_scenes),
            ("file", "Damaged files", _describe_files),
            ("problem", "Problems with noise and with other masses and forces", _describe_trials),
        ):
            mine = [row for row in rows if row["case"][0] == kind]
            if mine:
                parts += [f"## {title}", *describe(mine)]
        counted = Counter(kind for _, kind, _ in findings)
        kinds = dict.fromkeys([*KINDS, *counted])
        parts.append(Table(["finding", "number:d"], [(kind, counted[kind]) for kind in kinds]))
        return parts, [f"{where}: {kind}: {text}" for where, kind, text in findings]


STUDY = Stress()


def _plan(table: Mapping[str, Any], objective: str, scene: DrawnScene | None = None) -> Row:
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
        if faults := check_plan(problem, plan.trajectory):
            findings.append(("plan refuted by residual", "; ".join(faults[:3])))
    except WholearmError as error:
        row["text"] = str(error)
        if row["outcome"] == "planned" or isinstance(error, ReplayError):
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
    row["verdict"] = kind
    kinds = {"refuted": "refusal where a motion exists", "failed": "check that failed"}
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
            return {name: vary(name, entry) for name, entry in value.items()}
        return value * (1 + share * float(rng.uniform(-1, 1))) if key in keys else value

    return dict(vary("", table))


def compare_values(rows: Iterable[Row]) -> list[tuple[str, str, str]]:
    """Optima of one problem and objective that differ under noise."""
    groups: dict[str, list[float]] = {}
    for row in rows:
        _, path, objective, what, _ = row["case"]
        if what == "noise" and row["value"] is not None:
            groups.setdefault(f"{path}, {objective}", []).append(row["value"])
    findings = []
    for name, values in groups.items():
        apart = np.ptp(values) / np.abs(values).max()
        if apart > SAME:
            text = f"{min(values):.9g} to {max(values):.9g}, {apart:.2g} apart"
            findings.append((name, "optimum that differs under noise", text))
    return findings


def _describe_scenes(rows: Sequence[Row]) -> list[Table]:
    verdicts = [row["verdict"] or "not judged" for row in rows if row["outcome"] == "refused"]
    seconds = np.array([row["seconds"] for row in rows])
    middle, most = np.percentile(seconds, [50, 95])
    text = f"median {middle:.2f} s, 95 % within {most:.2f} s, longest {seconds.max():.2f} s"
    about = [
        ("scenes", str(len({row["case"][2] for row in rows}))),
        ("answers, one for each objective", _count(row["outcome"] for row in rows)),
        ("refusals, looked at a second time", _count(verdicts)),
        ("processor time of an answer, planned twice and checked", text),
    ]
    outcomes = ("planned", "refused", "failed")
    kinds = Counter((row["kind"], row["outcome"]) for row in rows)
    names = sorted({row["kind"] for row in rows})
    counts = [(kind, *(kinds[kind, outcome] for outcome in outcomes)) for kind in names]
    heads = ["kind of scene", *(f"{outcome}:d" for outcome in outcomes)]
    return [Table(["", ""], about), Table(heads, counts)]


def _describe_files(rows: Sequence[Row]) -> list[Table]:
    kinds = sorted({row["kind"] for row in rows})
    statuses = [[str(row["status"]) for row in rows if row["kind"] == kind] for kind in kinds]
    table = [(kind, len(mine), _count(mine)) for kind, mine in zip(kinds, statuses, strict=True)]
    return [Table(["files", "number:d", "exit status"], table)]


def _describe_trials(rows: Sequence[Row]) -> list[Table]:
    table = []
    for path, objective in dict.fromkeys(tuple(row["case"][1:3]) for row in rows):
        mine = [row for row in rows if row["case"][1:3] == [path, objective]]
        good = sum(not row["findings"] for row in mine)
        values = [row["value"] for row in mine if row["case"][3] == "noise" and row["value"]]
        apart = np.ptp(values) / np.abs(values).max() if values else None
        table.append((os.path.basename(path), objective, len(mine), good, apart))
    heads = ["problem", "objective", "trials:d", "without a finding:d"]
    return [Table([*heads, "values apart under noise:.1e"], table)]


def _count(names: Iterable[str]) -> str:
    return ", ".join(f"{number} {name}" for name, number in sorted(Counter(names).items()))


def check_plan(problem: Problem, plan: Trajectory) -> list[str]:
    """Sentences on what is wrong with a plan; none if nothing is."""
    faults: list[str] = []
    before: Array | None = None
    for phase, motion, start in zip(problem.phases, plan.motions, plan.phase_starts, strict=False):
        # Some of the instants are in pieces of the torques that are short.
        breaks, duration = plan.torque.breaks - start, motion.duration
        ends = np.concatenate([[0.0], breaks[(breaks > 0.0) & (breaks < duration)], [duration]])
        runs = np.diff(ends)
        short = (runs > 1e-6 * duration) & (runs < duration / 200)
        inside = ends[:-1][short, None] + runs[short, None] * np.array([0.1, 0.5, 0.9])
        t = np.unique(np.concatenate([np.linspace(0.0, duration, 401), inside.ravel()]))
        rows = motion.evaluate(t)
        texts = _check_phase(problem, phase, rows)
        middles = motion.evaluate((t[1:] + t[:-1]) / 2)
        texts += check_rates(problem.scene, t, rows, middles)
        # The torques as functions of time are those of the motion, between their steps.
        near = np.abs((start + t)[:, None] - plan.torque.breaks).min(axis=1)
        miss = np.abs(plan.torque.at(start + t) - rows.tau)[near > 1e-9 * plan.duration]
        share = (miss / problem.scene.torque_limit).max(initial=0.0)
        texts += [f"the torque profile is {share:.2g} of the limit off"] if share > 1e-4 else []
        texts += _check_ends(problem, phase, before, rows)
        before = np.array([rows.z[-1], rows.z_dot[-1]])
        faults += [f"phase {phase.number}: {text}" for text in texts]
    return faults


def _check_phase(problem: Problem, phase: Phase, rows: Samples) -> list[str]:
    """Contacts, overlaps, forces and limits of a phase, by `verification.newton_euler`."""
    scene, formation, scales = problem.scene, phase.formation, problem.scene.scales
    residuals = balance(scene, formation.contacts, formation.rolling, rows, STILL)
    size, _, text = residuals.find_worst()
    texts = [text] if size > ROUNDING else []
    for k, name in enumerate(formation.names):
        touch = locate(scene, name, rows.z)
        beyond = -min(touch.low.min(), touch.high.min()) / scales.length
        if beyond > OVERLAP:
            texts.append(f"{name} is {beyond:.2g} of the scene's length beyond its feature")
        # A normal force may lack what `verification.verify` allows.
        lack = problem.epsilon * (1 - 2e-3) - rows.c_n[:, k].min()
        if lack > ROUNDING * scales.force:
            texts.append(f"c_n of {name} is {lack:.3g} N short of epsilon")
    for pair, gap in clearances(scene, rows.z).items():
        if gap.min() < -OVERLAP * scales.length:
            texts.append(f"{pair} overlap by {-gap.min():.3g} m")
    turned = zip((*formation.names, "joint 1", "joint 2"), residuals.against.T, strict=True)
    texts += [
        f"friction of {name} is not Coulomb's for its sliding"
        for name, flags in turned
        if flags.any()
    ]
    for text, values, limits in (
        ("tau_{} exceeds its limit by {:.2g} of it", rows.tau, scene.torque_limit),
        ("joint {} exceeds its speed by {:.2g} of it", rows.z_dot[:, 3:], scene.speed_limit),
    ):
        share = np.abs(values).max(axis=0) / limits - 1
        texts += [text.format(j + 1, share[j]) for j in (0, 1) if share[j] > 1e-5]
    return texts


def check_rates(scene: Scene, t: Array, rows: Samples, middles: Samples) -> list[str]:
    """Whether z' is the derivative of z, and z'' that of z', as well as samples can tell.

    Simpson's rule takes instants, at `rows`, and those halfway between, at `middles`. A step of the
    acceleration there, or a kink, changes what it gives by no more than what the instants about it
    show: with the ends alone, a kink and a curvature could cancel in them.
    """
    texts, h = [], np.diff(t)[:, None]
    if not (h > 0).all():
        return ["instants of a phase without a duration"]
    unit = np.array([1.0, 1.0, *[1.0 / scene.scales.length] * 3])
    for what, value, rate, middle in (
        ("z", rows.z, rows.z_dot, middles.z_dot),
        ("z'", rows.z_dot, rows.z_ddot, middles.z_ddot),
    ):
        miss = np.abs(np.diff(value, axis=0) - h * (rate[1:] + 4 * middle + rate[:-1]) / 6)
        # How much the rate changes over each interval and those beside it.
        every = np.insert(rate, range(1, len(rate)), middle, axis=0)
        every = np.pad(every, ((2, 2), (0, 0)), "edge")
        span = np.ptp(sliding_window_view(every, 7, axis=0)[::2], axis=2)
        tiny = 1e-7 * unit * float((np.abs(value) / unit).max())
        excess = miss - (h * span + tiny)
        if (excess > 0).any():
            at, k = np.unravel_index(int(excess.argmax()), excess.shape)
            texts.append(f"{what} and its rate differ by {miss[at, k]:.3g} in row {k}")
    return texts


def _check_ends(problem: Problem, phase: Phase, before: Array | None, rows: Samples) -> list[str]:
    """Whether a phase goes on from where the one before ended, and ends as it has to."""
    scene, until, texts = problem.scene, phase.until, []
    size, z, offs = scene.scales.length, rows.z[-1], [0.0]
    fastest, speed = float(np.abs(rows.z_dot).max()), scene.scales.speed
    if before is not None:
        if np.abs(rows.z[0] - before[0]).max() > 1e-6 * max(1.0, size):
            texts.append("starts somewhere else than the phase before ends")
        step = np.abs(rows.z_dot[0] - before[1])[:2].max()
        struck = problem.phases[phase.index - 1].end is End.IMPACT
        if not struck and step > 1e-5 * max(speed, fastest):
            texts.append(f"velocity steps by {step:.3g} m/s at the start")
    if until.contact is not None:
        offs.append(float(np.abs(locate(scene, until.contact.name, rows.z[-1:]).gap[0])) / size)
    offs += [abs(z[row] - value) / (1.0 if row else size) for row, value in until.poses]
    if max(offs) > 1e-5:
        texts.append(f"ends {max(offs):.3g} from {until}")
    if phase.end is End.REST:
        left = np.abs(rows.z_dot[-1]) * np.array([1.0, 1.0, size, size, size])
        if left.max() > 1e-5 * max(speed, fastest * size):
            texts.append(f"ends at {left.max():.3g} m/s, not at rest")
    return texts
