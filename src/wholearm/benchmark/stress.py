"""The stress study: generated scenes, changed problems and damaged files, counted by kind.

Every plan is replayed and checked at many instants by the laws of Newton, Euler and Coulomb written
out anew, and for overlaps; every refusal by arguments that share nothing with the planner.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import os
import re
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, reduce
from itertools import product
from operator import getitem
from pathlib import Path
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
from .refusals import OVERLAP, clearances, judge
from .scenes import DrawnScene, Random, draw_case, pick
from .study import Case, Findings, Row, Study, group

OBJECTIVES = ("time", "effort", "margin")
SAME = 1e-6  # relative difference of two values that rounding may make
ROUNDING = 1e-6  # what may be left of an equation, a gap or its rate, in the scene's units
STILL = 1e-5  # speed over the scene's own below which friction may point either way
_MASSES = ("mass", "inertia")
_PARTS = ("palm", "finger1", "finger2", "viscous", "dry", "torque_limit")
TRIALS = {"noise": (8, _MASSES, 1e-10), "change": (20, (*_MASSES, *_PARTS), 0.1)}
"""How often a problem's numbers are changed, which, and by how much at most, relative."""

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
    keys = ("part",)
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
        """Scenes, files, and problems."""
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
            for what, (count, *_) in TRIALS.items():
                yield from product(["problem"], options.problems, OBJECTIVES, [what], range(count))

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
        groups, findings, parts = group(rows, "part"), list[Any](), list[str | Table]()
        for row in rows:
            printed = [("warning", f"printed: {row['printed']}")] if "printed" in row else []
            findings += ((row["name"], *finding) for finding in [*row["findings"], *printed])
        findings += compare_values(groups.get("problem", []))
        for part, title, describe in (
            ("scene", "Generated scenes", _describe_scenes),
            ("file", "Damaged files", _describe_files),
            ("problem", "Problems with noise and with other masses and forces", _describe_trials),
        ):
            if part in groups:
                parts += [f"## {title}", *describe(groups[part])]
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
    _, keys, share = TRIALS[what]

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
    table = [
        (kind, len(mine), _count(str(row["status"]) for row in mine))
        for kind, mine in sorted(group(rows, "kind").items())
    ]
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
        # The torques as functions of time are those of the motion, between their steps.
        near = np.abs((start + t)[:, None] - plan.torque.breaks).min(axis=1)
        miss = np.abs(plan.torque.at(start + t) - rows.tau)[near > 1e-9 * plan.duration]
        share = (miss / problem.scene.torque_limit).max(initial=0.0)
        misses = [(share, 1e-4, f"the torque profile is {share:.2g} of the limit off")]
        misses += _list_misses(problem, phase, rows)
        misses += _list_missed_ends(problem, phase, before, rows)
        misses += _list_missed_rates(problem.scene, t, rows, motion.evaluate((t[1:] + t[:-1]) / 2))
        faults += [f"phase {phase.number}: {text}" for size, most, text in misses if size > most]
        before = np.array([rows.z[-1], rows.z_dot[-1]])
    return faults


Miss = tuple[float, float, str]  # an amount, the most that is allowed, and what is wrong beyond it


def _list_misses(problem: Problem, phase: Phase, rows: Samples) -> Iterator[Miss]:
    """Contacts, overlaps, forces and limits of a phase, by `verification.newton_euler`."""
    scene, formation, scales = problem.scene, phase.formation, problem.scene.scales
    residuals = balance(scene, formation.contacts, formation.rolling, rows, STILL)
    size, _, text = residuals.find_worst()
    yield size, ROUNDING, text
    for name, c_n in zip(formation.names, rows.c_n.T, strict=True):
        touch = locate(scene, name, rows.z)
        beyond = -min(touch.low.min(), touch.high.min()) / scales.length
        yield beyond, OVERLAP, f"{name} is {beyond:.2g} of the scene's length beyond its feature"
        # A normal force may lack what `verification.verify` allows.
        lack = problem.epsilon * (1 - 2e-3) - c_n.min()
        yield lack, ROUNDING * scales.force, f"c_n of {name} is {lack:.3g} N short of epsilon"
    for pair, gap in clearances(scene, rows.z).items():
        yield -gap.min(), OVERLAP * scales.length, f"{pair} overlap by {-gap.min():.3g} m"
    for name, flags in zip(
        (*formation.names, "joint 1", "joint 2"), residuals.wrong_sign.T, strict=True
    ):
        yield flags.sum(), 0, f"friction of {name} is not Coulomb's for its sliding"
    for text, values, limits in (
        ("tau_{} exceeds its limit by {:.2g} of it", rows.tau, scene.torque_limit),
        ("joint {} exceeds its speed by {:.2g} of it", rows.z_dot[:, 3:], scene.speed_limit),
    ):
        for j, share in enumerate(np.abs(values).max(axis=0) / limits - 1, start=1):
            yield share, 1e-5, text.format(j, share)


def _list_missed_rates(scene: Scene, t: Array, rows: Samples, middles: Samples) -> Iterator[Miss]:
    """Whether z' is the derivative of z, and z'' that of z', as well as samples can tell.

    Simpson's rule takes instants, at `rows`, and those halfway between, at `middles`. A step of the
    acceleration there, or a kink, changes what it gives by no more than what the instants about it
    show: with the ends alone, a kink and a curvature could cancel in them.
    """
    h, unit = np.diff(t)[:, None], np.array([1.0, 1.0, *[1.0 / scene.scales.length] * 3])
    yield (h <= 0).sum(), 0, "instants of a phase without a duration"
    for what, value, rate, middle in (
        ("z", rows.z, rows.z_dot, middles.z_dot),
        ("z'", rows.z_dot, rows.z_ddot, middles.z_ddot),
    ):
        miss = np.abs(np.diff(value, axis=0) - h * (rate[1:] + 4 * middle + rate[:-1]) / 6)
        # How much the rate changes over each interval and those beside it.
        every = np.insert(rate, range(1, len(rate)), middle, axis=0)
        every = np.pad(every, ((2, 2), (0, 0)), "edge")
        span = np.ptp(sliding_window_view(every, 7, axis=0)[::2], axis=2)
        excess = miss - h * span - 1e-7 * unit * float((np.abs(value) / unit).max())
        excess = np.nan_to_num(excess, nan=-np.inf)
        at, k = np.unravel_index(int(excess.argmax()), excess.shape)
        text = f"{what} and its rate differ by {miss[at, k]:.3g} in row {k}"
        yield excess.max(), 0, text


def _list_missed_ends(
    problem: Problem, phase: Phase, before: Array | None, rows: Samples
) -> Iterator[Miss]:
    """Whether a phase goes on from where the one before ended, and ends as it has to."""
    scene, until = problem.scene, phase.until
    size, z, offs = scene.scales.length, rows.z[-1], [0.0]
    fastest, speed = float(np.abs(rows.z_dot).max()), scene.scales.speed
    if before is not None:
        away, most = np.abs(rows.z[0] - before[0]).max(), 1e-6 * max(1.0, size)
        yield away, most, "starts somewhere else than the phase before ends"
        if problem.phases[phase.index - 1].end is not End.IMPACT:
            step = np.abs(rows.z_dot[0] - before[1])[:2].max()
            text = f"velocity steps by {step:.3g} m/s at the start"
            yield step, 1e-5 * max(speed, fastest), text
    if until.contact is not None:
        offs.append(float(np.abs(locate(scene, until.contact.name, rows.z[-1:]).gap[0])) / size)
    offs += [abs(z[row] - value) / (1.0 if row else size) for row, value in until.poses]
    yield max(offs), 1e-5, f"ends {max(offs):.3g} from {until}"
    if phase.end is End.REST:
        left = (np.abs(rows.z_dot[-1]) * np.array([1.0, 1.0, size, size, size])).max()
        yield left, 1e-5 * max(speed, fastest * size), f"ends at {left:.3g} m/s, not at rest"


_LINK = {"length": 0.11, "radius": 0.005, "inertia": 0.005, "viscous": 0.01, "dry": 0.01}
_LINK |= {"torque_limit": 2.0, "speed_limit": 30.0}
_CONTACTS = ("v0-palm", "v1-palm", "v2-finger1", "v3-finger2")
_CORNERS = ((-0.035, -0.035), (0.035, -0.035), (0.035, 0.035), (-0.035, 0.035))
BASE: dict[str, Any] = {
    "name": "square", "epsilon": 0.05, "gravity": 9.81, "fingers_collide": True,
    "object": {"vertices": [*map(list, _CORNERS)], "mass": 0.2},
    "fingers": {"1": {"base": [0.08, -0.01], **_LINK}, "2": {"base": [-0.08, -0.01], **_LINK}},
    "friction": {"palm": 0.1, "finger1": 0.1, "finger2": 0.1},
    "start": {"flush": 0, "x": 0.02},
    "phases": [{"contacts": [*_CONTACTS], "until": {"x": x}} for x in (0.005, -0.01)],
}  # fmt: skip
"""A problem that is planned quickly: a square that slides to the left in two phases."""
STRANGE: tuple[Any, ...] = (
    float("nan"), float("inf"), float("-inf"), 0, -0.0, -1, 2**63, 10**400, 1e308, 5e-324, 1e-30,
    True, "", "text", "v99-palm", "e1-tip1", "v0-palm rolling", "smooth", "impact",
    "\u4e2d\U0001f600", "a\\u0000b", [], [[]], [1, 2, 3], ["v0-palm"], [["a", "b"]],
    [float("nan")], {}, {"x": "y"}, {"a": {"b": {}}}, {"phi_deg": 1e9}, {"x": 0.0, "phi_deg": 1.0},
)  # fmt: skip
"""Values that take the place of others."""
CELLS = (
    "nan", "-inf", "1e308", "1e-320", "-1", "", "text", "1,5", "0x10", "1_0", "\u0661", " 1 ",
    '"1"', "1e999", "--1", "True", "\x00", "1" * 5000, "1" * 200_000,
)  # fmt: skip
"""What takes the place of a number in a table of torques."""


@lru_cache(maxsize=1)
def base_files() -> tuple[bytes, bytes, bytes]:
    """A valid problem file, torque file and trajectory file of the same plan."""
    plan = solve(build_problem(BASE), intervals=20, samples=21)
    with tempfile.TemporaryDirectory() as folder:
        npz, table = os.path.join(folder, "a.npz"), os.path.join(folder, "a.csv")
        plan.save(npz)
        plan.save_torques(table)
        with np.load(npz) as data:
            arrays = {name: data[name] for name in data.files}
        torques = Path(table).read_bytes()
    # Timings and dates would make every run's files different.
    meta = json.loads(str(arrays["meta"]))
    none = [0.0] * len(meta["solves"])
    meta |= {"timings": {}, "build_times": none, "solve_times": none}
    return write_toml(BASE).encode(), torques, _pack(arrays | {"meta": meta})


def _damage_bytes(rng: Random, base: bytes) -> tuple[str, bytes | None]:
    """Damage that knows nothing of the format."""
    at, length = int(rng.integers(len(base))), int(10.0 ** rng.uniform(0, 3))
    noise = rng.bytes(length)
    changed: dict[str, bytes | None] = {
        "truncated": base[:at],
        "overwritten": base[:at] + noise + base[at + length :],
        "inserted": base[:at] + noise + base[at:],
        "cut out": base[:at] + base[at + length :],
        "repeated": base[: at + length] + base[at:],
        "empty": b"",
        "folder": None,
        "utf-16": base.decode("latin-1").encode("utf-16"),
        "bom": b"\xef\xbb\xbf" + base,
        "crlf": base.replace(b"\n", b"\r\n"),
    }
    what = pick(rng, list(changed))
    return what, changed[what]


def change_tree(rng: Random, tree: Any, strange: Sequence[Any]) -> str:
    """Change one value or key of nested tables and lists in place; says what."""
    *way, key = path = pick(rng, _list_places(tree))
    parent = reduce(getitem, way, tree)
    value, name = parent[key], ".".join(map(str, path))
    what = pick(rng, ["delete", "rename", "replace", "replace", "replace", "scale", "double"])
    if what == "delete":
        del parent[key]
    elif what == "rename" and isinstance(parent, dict):
        new = pick(rng, [f"{key}s", str(key).upper(), "", "x y", "\u00e9", "mass"])
        parent[new] = parent.pop(key)
    elif what == "scale" and isinstance(value, int | float) and not isinstance(value, bool):
        factors = [-1.0, 0.5, 1e3, 1e-3, 1e6, 1e-6, 1e12, 1e-12, 1e-320, 1e300]
        parent[key] = value * pick(rng, factors)
    elif what == "double" and isinstance(parent, list):
        at = int(rng.integers(len(parent) + 1))
        parent[at:at] = [copy.deepcopy(value)] * pick(rng, [1, 2, 100])
    else:
        parent[key] = new = copy.deepcopy(pick(rng, strange))
        return f"{name} becomes {str(new)[:40]}"
    return f"{what} {name}"


def _list_places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every path into nested tables and lists."""
    items: Any = value.items() if isinstance(value, dict) else ()
    items = enumerate(value) if isinstance(value, list) else items
    return [at for key, part in items for at in ((*path, key), *_list_places(part, (*path, key)))]


def _damage_problem(rng: Random, _: bytes) -> tuple[str, bytes]:
    table = copy.deepcopy(BASE)
    done = [change_tree(rng, table, STRANGE) for _ in range(int(rng.integers(1, 3)))]
    return "; ".join(done), write_toml(table).encode("utf-8", "surrogatepass")


def damage_torques(rng: Random, base: bytes) -> tuple[str, bytes]:
    """What was done to a table of torques, and its text afterwards."""
    head, *lines = base.decode().strip().split("\n")
    rows: list[Any] = [[float(cell) for cell in line.split(",")] for line in lines]
    rows = [head.split(","), *rows[:: max(1, len(rows) // 40)]]
    what = change_tree(rng, rows, CELLS)
    separator = ";" if rng.uniform() < 0.05 else ","
    cells = [map(str, row) if isinstance(row, list) else [str(row)] for row in rows]
    text = "\n".join(map(separator.join, cells)) + "\n"
    return what, text.encode("utf-8", "surrogatepass")


def _damage_archive(rng: Random, base: bytes) -> tuple[str, bytes]:
    """A trajectory file with an array in another form, or with a change in it or in `meta`."""
    with np.load(io.BytesIO(base)) as data:
        arrays: dict[str, Any] = {name: data[name] for name in data.files}
    name = pick(rng, ["meta", *arrays])
    array = np.atleast_1d(arrays.pop(name))
    if rng.uniform() < 0.4:
        forms = [array.T, array[None], array[..., None], array.ravel()[:-1], array[:0]]
        kinds = (complex, bool, object, "S8", "M8[s]", "f2", ">f8", "f8,f8")
        form = pick(rng, [*forms, *(np.zeros(array.shape, kind) for kind in kinds)])
        return f"{name} is {form.dtype.str} of shape {form.shape}", _pack(arrays | {name: form})
    tree = {name: json.loads(array[0]) if name == "meta" else array.tolist()}
    what = change_tree(rng, tree, STRANGE)
    return what, _pack(arrays | tree)


def _pack(members: Mapping[str, Any]) -> bytes:
    """An archive of arrays and lists, and of tables as JSON."""
    stream, arrays = io.BytesIO(), dict[str, Any]()
    for name, value in members.items():
        try:
            arrays[name] = np.asarray(json.dumps(value) if isinstance(value, dict) else value)
        except (ValueError, OverflowError):  # rows of several lengths, integers beyond all types
            arrays[name] = np.array(value, dtype=object)
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def run_file(seed: int, number: int) -> dict[str, Any]:
    """Run the command line on a file of a seed in this process, and look at what it leaves."""
    from ..__main__ import start

    rng, k = np.random.default_rng([seed, number]), (0, 0, 1, 2, 2)[number % 5]
    kind, ending = ("problem", "torque", "trajectory")[k], (".toml", ".csv", ".npz")[k]
    ways: tuple[Callable[[Random, bytes], tuple[str, bytes | None]], ...]
    ways = _damage_problem, damage_torques, _damage_archive, _damage_bytes
    what, content = ways[-1 if rng.uniform() < 0.25 else k](rng, base_files()[k])
    if rng.uniform() < 0.01:
        ending = pick(rng, [".TOML", ".txt", "", ".npy", ".CSV", ".npz.csv"])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        file, valid, table = (folder / n for n in (f"mutant{ending}", "own.toml", "own.csv"))
        for path, own in zip((valid, table), base_files(), strict=False):
            path.write_bytes(own)
        if content is None:
            file.mkdir()
        else:
            file.write_bytes(content)
        command = pick(rng, _list_commands(kind, str(file), str(valid), str(folder / "out")))
        before, out, err = set(folder.iterdir()), io.StringIO(), io.StringIO()
        status: int | None = None
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                status = start(command)
            written = {path.name for path in {*folder.iterdir()} - before}
            findings = look(command, status, out.getvalue(), err.getvalue(), written)
        except Exception as error:
            findings = [describe_error(error)]
    text = " ".join([command[0], *map(os.path.basename, command[1:])])
    found = {"status": status, "findings": findings}
    return {"kind": kind, "what": what, "command": text, **found}


def _list_commands(kind: str, path: str, own: str, out: str) -> list[list[str]]:
    """Commands that read a file, as often as they are drawn."""
    narrow = ["-o", f"{out}.png", "--phi=-10,10"]
    if kind == "problem":
        solving = ["solve", path, "-o", f"{out}.npz", "--intervals", "20"]
        asking = [["verify", path, f"{own[:-5]}.csv"], ["map", path, "--list", "0.02,0", "-0.01,0"]]
        asking.append([*solving, "--torques", f"{out}.csv"])
        return [*4 * [solving], *2 * asking, ["map", path, *narrow]]
    checking = 14 * [["verify", own, path]] + 2 * [["verify", own, path, "--json"]]
    if kind == "torque":
        return checking
    drawing = 3 * [["plot", path, "-o", f"{out}.png", "--simulate"]]
    drawing += [["plot", path, "-o", f"{out}.svg"], ["map", own, "--plan", path, *narrow]]
    return checking + drawing


def describe_error(error: BaseException) -> tuple[str, str]:
    """The finding of an exception that nobody meant to raise."""
    kind = "warning" if isinstance(error, Warning) else "traceback"
    return kind, "".join(traceback.format_exception(error)[-4:]).strip()


def look(
    command: list[str], status: int | None, out: str, err: str, written: set[str]
) -> list[tuple[str, str]]:
    """What is wrong with how a command ended."""
    texts = []
    # Lines that tell how long work goes on already do not count.
    lines = [line for line in err.splitlines() if not re.match(r"wholearm: \d+ s: ", line)]
    if status not in (0, 1, 2):
        texts.append(f"exit status {status}")
    if status == 0 and lines:
        texts.append(f"exit status 0 with {lines[0][:80]!r} on stderr")
    # A report on torques that fail goes to stdout; everything else fails with one line.
    reported = command[0] == "verify" and status == 1 and bool(out.strip())
    if status in (1, 2) and not reported:
        if len(lines) != 1 or not lines[0].startswith("wholearm: "):
            texts.append(f"{len(lines)} lines on stderr, beginning {err[:80]!r}")
        elif len(lines[0]) > 2000:
            texts.append(f"a line of {len(lines[0])} characters on stderr")
        told = "--json" in command and out.strip() and json.loads(out)["status"] == status
        if out.strip() and not told:
            texts.append(f"exit status {status} with output {out[:80]!r}")
    if status == 2 and not any("mutant" in line for line in lines):
        texts.append(f"the file is not named in {err[:120]!r}")
    partial = sorted(name for name in written if name.endswith(".part"))
    if partial or (status in (1, 2) and written):
        texts.append(f"exit status {status} and {', '.join(sorted(written))} left behind")
    return [("unclear end", text) for text in texts]
