"""Sweeps: a plan for each point of a grid, or of a Latin hypercube, of parameters of problems.

A row depends on its point alone, not on the process or the order. Rows are computed by an executor
and stored one by one in a `Journal`, like samples of `analysis.robustness`.

Parameters have the short names of `Problem.with_`, and the dotted key of any number in a problem
file, such as ``phases[5].until.phi_deg``.
"""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from .. import __version__
from ..analysis.robustness import draw_cube
from ..common.document import Document, Result, Table, format_csv, show, to_plain
from ..common.errors import (
    InfeasibleError,
    InputError,
    WholearmError,
    name_file,
    require_number,
    suggest,
)
from ..common.fields import POINT, SEED, Field, Range, choice
from ..common.files import number_same
from ..common.parallel import Journal, Processes, run_all
from ..mechanics.limits import make_limits
from ..planning.options import Objective, PlanOptions
from ..planning.result import UNITS, Plan
from ..problem.definition import Problem
from ..problem.read import FINGER, FRICTION, OBJECT, START, TOP, UNTIL, name_keys
from ..problem.table import change_table, describe_scene
from ..scene.model import CORNERS
from ..search import solve

_TABLES = {"object": OBJECT, "friction": FRICTION, "start": START}
_TABLES |= {f"fingers.{number}": FINGER for number in "12"}
_FIELDS = {f"{part}.{key}": field for part, keys in _TABLES.items() for key, field in keys.items()}
_SINGLE = ("epsilon", "gravity", "settle", "settle_gap", "control_period")
_FIELDS |= {name: TOP[name] for name in _SINGLE}
_SKIPPED = re.compile(r"\.flush$|\.guess\[|^uncertainty")  # integers, and numbers without effect


class Parameter(NamedTuple):
    """A number of a problem, or a common value of several keys."""

    name: str
    keys: tuple[str, ...]  # dotted keys of a problem file
    value: float  # NaN if the problem does not have it, or values of its keys differ
    unit: str
    scale: float = 1.0  # the scene's unit of such numbers

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def list_parameters(problem: Problem) -> list[Parameter]:
    """Every number that a problem has, once, by its shortest name."""
    parameters = dict[str, Parameter]()
    for parameter in _find_parameters(problem).values():
        key = parameter.keys[0]
        is_default = not parameter.value and key in _FIELDS and _FIELDS[key].default == 0
        if len(parameter.keys) == 1 and math.isfinite(parameter.value) and not is_default:
            parameters.setdefault(key, parameter)
    return [*parameters.values()]


def find_parameter(problem: Problem, name: str, label: str = "") -> Parameter:
    """The parameter with a name; `label` is the option that has the name.

    InputError, with the most similar name, if the problem has none of this name.
    """
    parameters = _find_parameters(problem)
    if name in parameters:
        return parameters[name]
    names = [p.name for p in list_parameters(problem) if not p.name.startswith("object.")]
    text = f"is no number of a problem; {suggest(name, parameters)}those that this one gives are "
    raise InputError(problem.source, f"{label} {name}".strip(), text + ", ".join(names))


def require_allowed(problem: Problem, name: str, value: Any, label: str) -> None:
    """InputError if no file may have a value; values without a reachable end are allowed."""
    try:
        problem.with_({name: value})
    except InputError as error:
        keys = "", name, *name_keys().get(name, ())
        if any(key.partition("[")[0] == error.key.partition("[")[0] for key in keys):
            raise InputError(problem.source, f"{label} {name}", error.problem) from None


def _find_parameters(problem: Problem) -> dict[str, Parameter]:
    """All parameters by their names, short ones first."""
    scene, scales = problem.scene, problem.scene.scales
    numbers = dict(_list_numbers(describe_scene(scene) | {"object.inertia": scene.polygon.inertia}))
    numbers |= dict(_list_numbers(problem.table))
    parameters = dict[str, Parameter]()
    short_names = {name: keys for name, keys in name_keys().items() if _find_field(keys[0])}
    for name, keys in (short_names | {key: (key,) for key in numbers}).items():
        field, values = _find_field(keys[0]), {numbers.get(key, math.nan) for key in keys}
        is_table = field is None or (field.kind in (POINT, CORNERS) and "[" not in keys[0])
        if _SKIPPED.search(keys[0]) or (is_table and keys[0] not in numbers):
            continue
        unit = (field.unit, getattr(scales, field.scale or "_", 1.0)) if field else ("", 1.0)
        value = values.pop() if len(values) == 1 else math.nan
        parameters[name] = Parameter(name, keys, value, *unit)
    return parameters


def _find_field(key: str) -> Field | None:
    """The declaration of a dotted key."""
    of_end, of_scene = re.sub(r".*until\.|goal(\[\d+\])?\.", "", key), key.partition("[")[0]
    return UNTIL.get(of_end) if of_end != key else _FIELDS.get(of_scene)


def _list_numbers(value: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """Dotted keys of all numbers in nested tables."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _list_numbers(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list):
        for k, item in enumerate(value, start=1):
            yield from _list_numbers(item, f"{key}[{k}]")
    elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        yield key, float(value)


Point = tuple[Any, ...]  # index of a problem, and the value of each parameter
Row = dict[str, Any]  # results of a point, as plain values; see `Sweep`
CHECKS = ("verify", "free", "policy")
"""Simulations of plans: with prescribed contacts, without, and with a policy."""
ACTIVE = 1e-3  # largest slack of an active limit, over the unit of its shortfalls


@dataclass(frozen=True)
class Planner:
    """Plans problems with other values of parameters."""

    problems: tuple[Problem, ...]
    names: tuple[str, ...]  # of the parameters, as of `Problem.with_`
    options: Mapping[str, Any]  # of `solve`
    checks: tuple[str, ...] = ()  # of `CHECKS`

    def run(self, task: tuple[int, Point]) -> Row:
        """The row of a numbered point."""
        index, *values = task[1]
        changes = dict(zip(self.names, values, strict=True))
        try:
            plan = solve(self.problems[index].with_(changes), **self.options)
        except WholearmError as error:
            return describe_failure(error)
        limit, share = find_limit(plan)
        margin = min(plan.trajectory.least_forces)[0] - plan.problem.epsilon
        row = {"status": "planned", "value": plan.value, "margin": margin}
        row |= {"limit": limit, "share": share}
        row |= {f"duration{phase.number}": phase.duration for phase in plan.phases}
        return row | {check: _try(plan, check) for check in self.checks}


def find_limit(plan: Plan) -> tuple[str, float]:
    """The limit that is active for the longest time, and its fraction of the duration.

    The bound on normal forces is the least one of the plan, as the objective margin raises it.
    """
    motion = plan.trajectory
    least, contact = min(motion.least_forces)
    # The least force may be that of an instant between samples.
    times = {f"c_n of {contact}": 0.0}
    weight = (np.diff(motion.t, prepend=0.0) + np.diff(motion.t, append=motion.t[-1])) / 2
    for phase in plan.problem.phases:
        rows, formation = motion.phase == phase.index, phase.formation
        limits = make_limits(formation, least)
        columns = [motion.contacts.index(name) for name in formation.names]
        c_t = motion.c_t[rows][:, columns][:, formation.rolling_rows]
        forces = [motion.c_n[rows][:, columns], c_t, motion.tau[rows], motion.theta_dot[rows]]
        slack, sides = limits.find_slack(np.hstack(forces) @ limits.rows.T), limits.sides[0]
        active_times = weight[rows] @ (slack <= ACTIVE * limits.scales[sides])
        for owner, duration in zip(limits.owners[sides], active_times.tolist(), strict=True):
            name = name_limit(limits.limits[owner].text)
            times[name] = times.get(name, 0.0) + duration
    limit = max(times, key=lambda name: times[name])
    return limit, times[limit] / motion.duration


def name_limit(limit: str) -> str:
    """Name of a limit, without its value."""
    return re.split(r" >?= |, ", limit, maxsplit=1)[0]


def _try(plan: Plan, check: str) -> str:
    """Result of a check of a plan: "ok", or the failure."""
    from ..policy.make import make_policy
    from ..verification.free import verify_free, verify_policy
    from ..verification.verify import verify

    try:
        if check == "policy":
            policy = make_policy(plan.problem, plan)
            report: Any = verify_policy(plan.problem, plan, policy)
        else:
            report = (verify_free if check == "free" else verify)(plan.problem, plan)
    except WholearmError as error:
        return str(error)
    return "ok" if report.ok else str(report.reason)


def describe_failure(error: Exception) -> Row:
    """The row of a point without a plan."""
    status, text = "infeasible" if isinstance(error, InfeasibleError) else "failed", str(error)
    if isinstance(error, InputError):
        status = "impossible"
        text = ": ".join(filter(None, (error.key, error.problem)))
    # Without numbers and places, which differ from point to point.
    reason = re.split(r"; |: going | at [xt] = ", re.sub(r" \(.*?\)", "", text), maxsplit=1)[0]
    reason = re.sub(r"(?<== )-?\d\S*|-?\d+\.\d\S*", "\u2026", reason)
    for shortfall in getattr(error, "shortfalls", ())[:1]:
        reason = f"{name_limit(shortfall.limit)} in phase {shortfall.place.phase}"
    changes = sorted(getattr(error, "changes", ()), key=lambda change: change.relative)
    change = str(changes[0]) if changes else ""
    return {"status": status, "value": None, "reason": reason, "change": change, "message": text}


@dataclass(frozen=True, eq=False, repr=False)
class Sweep(Result):
    """Rows of all points, in their order.

    A row has `problem`, the parameters by name, and `status`. With a plan: the `value` of the
    objective; `margin`, the least normal force beyond epsilon [N]; the `limit` that is active for
    the longest time, and its `share` of the duration; `duration1`, ... of the phases [s]; for each
    check "ok" or the failure. Without one: its `reason` in a few words, equal for similar points;
    the smallest `change` of one number with which the phase has a plan, if one was found; the
    whole `message`.
    """

    derived = ("reasons", "best")
    problems: tuple[str, ...]  # their files, or names
    objective: Objective
    vary: Mapping[str, tuple[Any, ...]]  # values of the parameters; of samples the first and last
    samples: int  # size of the Latin hypercube; 0 for a grid
    rows: tuple[Row, ...]
    titles: Mapping[str, str]  # of the parameters, with units
    checks: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Objective and its unit."""
        return f"{self.objective.value} [{UNITS[self.objective]}]"

    @property
    def ok(self) -> bool:
        """Whether any point has a plan."""
        return self.best is not None

    @property
    def reasons(self) -> dict[str, int]:
        """Numbers of points without a plan, by reason, the most frequent first."""
        return dict(Counter(r["reason"] for r in self.rows if "reason" in r).most_common())

    @property
    def best(self) -> int | None:
        """Index of the row with the best value; None without a plan."""
        sign = -1 if self.objective is Objective.MARGIN else 1
        values = {k: row["value"] for k, row in enumerate(self.rows) if row["value"] is not None}
        return min(values, key=lambda k: sign * values[k], default=None)

    @property
    def document(self) -> Document:
        """All rows, reasons of missing plans with counts, and the best row."""
        names = {"problem": "problem"} if len(self.problems) > 1 else {}
        names |= {name: f"{title}:.6g" for name, title in self.titles.items()}
        columns = names | {"status": "status", "value": f"{self.label}:.6g"}
        columns |= {"phases": "phases [s]:.4g", "margin": "c_n beyond epsilon [N]:.3g"}
        columns |= dict(zip(self.checks, self.checks, strict=True))
        columns |= {"reason": "limited by, or reason", "change": "feasible with"}
        rows, reasons, best = list[list[Any]](), self.reasons, self.best
        for row in self.rows:
            cells: Row = {"phases": [row[key] for key in row if key.startswith("duration")] or None}
            if "limit" in row:
                cells["reason"] = f"{row['limit']} ({100 * row['share']:.0f} % of the time)"
            rows.append([(row | cells).get(key) for key in columns])
        summary = f"no point has a plan, most often because of: {next(iter(reasons), '')}"
        if best is not None:
            place = [f"{name} = {show(self.rows[best][name], '.6g')}" for name in names]
            summary = ", ".join([f"best: {self.label} = {self.rows[best]['value']:.6g}", *place])
        table = Table([*columns.values()], rows, max_rows=100)
        causes = Table(["without a plan, by reason", "points:d"], [*reasons.items()])
        reason = f"{len(rows) - sum(reasons.values())} of {len(rows)} points planned"
        return Document(", ".join(self.problems), reason=reason, parts=[table, causes, summary])

    def to_csv(self) -> str:
        """All rows as CSV, with all digits."""
        keys = (key for row in sorted(self.rows, key=len)[::-1] for key in row)
        return format_csv(self.rows, dict.fromkeys(keys))


def require_table(path: str) -> None:
    """InputError if a file exists, is not empty, and is no table of a sweep."""
    if os.path.isfile(path):
        with name_file(path), open(path, "rb") as stream:
            head = stream.readline()
        if head and not re.match(rb"problem,(.*,)?status,value,", head):
            text = "holds no table of a sweep; --fresh replaces it, or choose another with -o"
            raise InputError(path, "", text)


def read_vary(
    texts: Sequence[str], samples: int = 0, option: str = "--vary"
) -> dict[str, tuple[Any, ...]]:
    """Values of parameters from ``NAME=LOW:HIGH:COUNT`` or ``NAME=VALUE,VALUE``.

    Samples take ``NAME=LOW:HIGH``. Values that are no numbers are words.

    InputError if a text is none of these, or a name is given twice.
    """
    vary = dict[str, tuple[Any, ...]]()
    form = "NAME=LOW:HIGH" if samples else "NAME=LOW:HIGH:COUNT or NAME=VALUE,VALUE"
    for text in texts:
        name, _, values = text.partition("=")
        parts: list[Any] = [_parse(part) for part in re.split("[:,]", values)]
        is_list = ":" not in values and not samples
        if is_list and name and values and name not in vary:
            vary[name] = tuple(parts)
            continue
        numbers = all(isinstance(part, Real) and math.isfinite(part) for part in parts)
        malformed = is_list or "," in values or name in vary or len(parts) != 3 - bool(samples)
        if malformed or not numbers or parts[0] >= parts[1]:
            text = f"{text!r} given; {form} is needed, LOW below HIGH and each name once"
            raise InputError("", option, text)
        count = Range(2, 10**6).read((*parts, 2)[2], f"{option} {name}: COUNT")
        vary[name] = tuple(np.linspace(parts[0], parts[1], count).tolist())
    return vary


def _parse(text: str) -> Any:
    for read in (json.loads, float):
        with suppress(ValueError):
            return read(text)
    return text


def sweep(
    problems: Problem | Sequence[Problem],
    vary: Mapping[str, Sequence[Any]],
    objective: str = "time",
    *,
    samples: int = 0,
    seed: int = 0,
    checks: Sequence[str] = (),
    time_limit: float | None = None,
    path: str | os.PathLike[str] | None = None,
    fresh: bool = False,
    start: Callable[[], Executor] | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Sweep:
    """Plan problems for many values of parameters.

    Parameters
    ----------
    problems         one or several, with phases or goals
    vary             values of parameters by the names of `Problem.with_`: all their combinations
    objective        of the plans, as of `wholearm.solve`
    samples          size of a Latin hypercube, from the first to the last of the values, in place
                     of the grid; 0 for the grid
    seed             of the samples
    checks           of "verify", "free" and "policy": simulations of plans besides the replay that
                     is part of planning
    time_limit : [s] for planning one point
    path, fresh      file to which rows are written one by one, and whether it is overwritten
    start            makes an executor; these three as of `assess_robustness`
    progress         called with a text on finished points and the remaining time
    **options        as `wholearm.solve` takes them

    InputError if a problem lacks a parameter, no file may have one of its values, or the file holds
    another sweep or anything else.
    """
    listed = (problems,) if isinstance(problems, Problem) else tuple(problems)
    Range(1, 10**5).read(len(listed), "problems: COUNT")
    samples, seed = Range(0, 10**6).read(samples, "samples"), SEED.read(seed, "seed")
    if seed and not samples:
        raise InputError("", "seed", f"{seed} given; needs --samples")
    for check in checks:
        choice(*CHECKS).read(check, "--with")
    chosen = {"objective": objective, **options}
    goal = PlanOptions(**chosen).goal
    axes = {name: tuple(to_plain(list(values))) for name, values in vary.items()}
    titles = dict[str, str]()
    for problem, (name, candidates) in product(listed[::-1], vary.items()):
        Range(1, 10**6).read(len(candidates), f"--vary {name}: COUNT")
        numbers = all(isinstance(value, Real) and math.isfinite(value) for value in candidates)
        for value in (min(candidates), max(candidates)) if numbers else candidates:
            require_allowed(problem, name, value, "--vary")
        titles[name] = name
        with suppress(InputError):
            titles[name] = find_parameter(problem, name).title
    for problem in listed:
        # Two names may not change the same number.
        change_table(problem.table, {name: values[0] for name, values in axes.items()}, name_keys())
    names = number_same([problem.source or problem.name for problem in listed], "{} ({})")
    combinations: Iterable[Point] = product(*axes.values())
    if samples:
        low, high = (
            np.array([require_number(values[k], f"--vary {name}") for name, values in axes.items()])
            for k in (0, -1)
        )
        cube = draw_cube(samples, len(axes), seed)
        combinations = (low + cube * (high - low)).tolist()
    points = [(index, *values) for index, values in product(range(len(listed)), combinations)]
    planner = Planner(listed, tuple(vary), chosen | {"time_limit": time_limit}, tuple(checks))
    stamp = {
        "study": "sweep", "version": __version__, "problems": [p.table for p in listed],
        "vary": axes, "samples": samples, "seed": seed,
        "options": to_plain(planner.options), "checks": checks,
    }  # fmt: skip
    with Journal(os.fspath(path or os.devnull), stamp, fresh) as journal:
        rows = {record["point"]: record["row"] for record in journal.records}
        tasks = [(k, point) for k, point in enumerate(points) if k not in rows]
        began, n_stored = time.monotonic(), len(rows)
        for (number, _), answer in run_all(planner.run, tasks, (start or Processes)()):
            if isinstance(answer, Exception):
                # Not stored: the next run may succeed where a process died.
                rows[number] = describe_failure(answer)
            else:
                rows[number] = answer
                journal.add({"point": number, "row": answer})
            if progress is not None:
                done, count = len(rows), len(points)
                seconds = (time.monotonic() - began) / max(done - n_stored, 1) * (count - done)
                time_left = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
                bar = f"[{'#' * (20 * done // count):.<20}]"
                progress(f"{bar} {done} of {count} points, {time_left} left")
    all_rows = (
        {"problem": names[index], **dict(zip(axes, values, strict=True)), **rows[k]}
        for k, (index, *values) in enumerate(points)
    )
    return Sweep(tuple(names), goal, axes, samples, tuple(all_rows), titles, tuple(checks))
