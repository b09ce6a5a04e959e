"""Damaged problem, torque and trajectory files through the command line.

Files have something wrong in them, drawn by a seeded generator. Whatever it is, a command ends with
an exit status of its own, one clear line, and nothing left behind.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import os
import re
import tempfile
import traceback
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, reduce
from operator import getitem
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ..planning.plan import solve
from ..problem.read import build_problem
from ..problem.table import write_toml

Random = np.random.Generator
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
METAS = (
    "", "null", "[]", "{}", "1", '"text"', "{" * 5000, "[" * 100_000, '{"problem": {}}',
    '{"rolling": [[]]}', "NaN", '{"epsilon": NaN}',
)  # fmt: skip
"""What takes the place of a trajectory's `meta`."""


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
    told = {"timings": {}, "build_times": none, "solve_times": none}
    arrays["meta"] = np.array(json.dumps(meta | told))
    return write_toml(BASE).encode(), torques, _pack(arrays)


def pick(rng: Random, options: Sequence[Any]) -> Any:
    """One of some options."""
    return options[int(rng.integers(len(options)))]


def _damage_bytes(rng: Random, base: bytes) -> tuple[str, bytes | None]:
    """Damage that knows nothing of the format."""
    at, length = int(rng.integers(len(base))), int(10.0 ** rng.uniform(0, 3))
    noise = rng.integers(0, 256, size=length).astype(np.uint8).tobytes()
    changed: dict[str, bytes | None] = {
        "truncated": base[:at],
        "overwritten": base[:at] + noise + base[at + length :],
        "inserted": base[:at] + noise + base[at:],
        "cut out": base[:at] + base[at + length :],
        "repeated": base[: at + length] + base[at:],
        "empty": b"",
        "folder": None,
        "noise": noise,
        "utf-16": base.decode("latin-1").encode("utf-16"),
        "latin-1": base[:at] + "\u00e9\u00fc\u00df".encode("latin-1") + base[at:],
        "bom": b"\xef\xbb\xbf" + base,
        "crlf": base.replace(b"\n", b"\r\n"),
        "zeros": bytes(length),
        "reversed": base[::-1],
        "twice": base + base,
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


def _damage_problem(rng: Random, base: bytes) -> tuple[str, bytes]:
    if rng.uniform() < 0.7:
        table = copy.deepcopy(BASE)
        done = [change_tree(rng, table, STRANGE) for _ in range(int(rng.integers(1, 3)))]
        return "; ".join(done), write_toml(table).encode("utf-8", "surrogatepass")
    lines = base.decode().split("\n")
    at, deep = int(rng.integers(len(lines))), int(10.0 ** rng.uniform(1, 5))
    texts = [
        lines[at], lines[at] + " [ { \" '", "a = " + "[" * deep, "a = " + "[" * deep + "]" * deep,
        "[" + ".".join(["a"] * deep) + "]", "a = " + "9" * deep, 'name = "' + "x" * deep + '"',
        "phases = [" + "{}," * deep + "]", "a = 2020-01-01", "\x00", "name = '''", "\ufeff",
        "object.vertices = 1", "[object]\n[object]", "[[object]]", "epsilon = 1_0.0_1",
        "start = { flush = 0, x = 1979-05-27T07:32:00Z }", "",
    ]  # fmt: skip
    text = pick(rng, texts)
    lines[pick(rng, [0, at, -1])] = text
    return f"line {at} is {text[:30]!r} of {len(text)}", "\n".join(lines).encode()


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
    """A trajectory file with one array or its `meta` changed, or with another member."""
    with np.load(io.BytesIO(base)) as data:
        arrays: dict[str, Any] = {name: data[name] for name in data.files}
    name = pick(rng, list(arrays))
    how = pick(rng, ["array", "array", "array", "meta", "meta", "header", "rename"])
    if how == "meta":
        meta = json.loads(str(arrays["meta"]))
        what, text = change_tree(rng, meta, STRANGE), pick(rng, METAS)
        if rng.uniform() < 0.8:
            text = json.dumps(meta)
        arrays["meta"] = np.array(text)
        return f"meta: {what} or {text[:20]!r}", _pack(arrays)
    if how == "array":
        arrays[name] = made = _change_array(rng, arrays[name])
        return f"{made.dtype.str} of shape {made.shape} for {name}", _pack(arrays)
    if how == "rename":
        new = pick(rng, ["x", "T", "tau", "", "a/b/t", "../t"])
        arrays[new] = arrays.pop(name)
        return f"{name} is called {new!r}", _pack(arrays)
    shape = pick(rng, [(10**12,), (10**6, 10**6), (2**62, 4), (-1,), (10**9, 3), (3, 2**40)])
    kind = pick(rng, ["<f8", "<i8", "<U1000000", "|O", "<f4", ">f8", "|V1000000000", "<M8[s]"])
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    del arrays[name]
    raw = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 64
    return f"{name} claims {shape} of {kind}", _pack(arrays, {name: raw})


def _change_array(rng: Random, array: Any) -> Any:
    if array.dtype.kind in "iuf" and array.size and rng.uniform() < 0.5:
        new = pick(rng, [np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, -1.0, 1e30, 1e-30, 7.0])
        changed = array.astype(float)
        count = pick(rng, [1, 1, max(1, array.size // 10), array.size])
        changed.flat[rng.integers(array.size, size=count)] = new
        return changed
    makers: list[Callable[[], Any]] = [
        lambda: array.astype(pick(rng, [str, object, "S8"])),
        lambda: np.zeros(array.shape, pick(rng, [complex, bool, "M8[s]", "f2", ">f8", "f8,f8"])),
        lambda: np.array({"a": 1}, dtype=object), lambda: np.array("text"),
        lambda: np.array([array, array]), lambda: array[None], lambda: array[..., None],
        lambda: array.T, lambda: array.ravel()[::-1], lambda: array.ravel()[:1],
        lambda: array.ravel()[:0], lambda: array.ravel()[:-1], lambda: np.zeros((0, 0)),
    ]  # fmt: skip
    return pick(rng, makers)()


def _pack(arrays: Mapping[str, Any], others: Mapping[str, bytes] = MappingProxyType({})) -> bytes:
    """The arrays as an archive, with further members as they are."""
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.savez_compressed(stream, **arrays)
    with zipfile.ZipFile(stream, "a") as archive:
        for name, raw in others.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), raw, zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def run_file(seed: int, number: int) -> dict[str, Any]:
    """Run the command line on a file of a seed in this process, and look at what it leaves."""
    from ..__main__ import start

    rng, k = np.random.default_rng([seed, number, 1]), (0, 0, 1, 2, 2)[number % 5]
    kind, ending = ("problem", "torque", "trajectory")[k], (".toml", ".csv", ".npz")[k]
    ways: tuple[Callable[[Random, bytes], tuple[str, bytes | None]], ...]
    ways = _damage_problem, damage_torques, _damage_archive, _damage_bytes
    what, content = ways[-1 if rng.uniform() < 0.25 else k](rng, base_files()[k])
    if rng.uniform() < 0.01:
        ending = pick(rng, [".TOML", ".txt", "", ".npy", ".CSV", ".npz.csv"])
    rng, (problem, torques, _) = np.random.default_rng([seed, number, 2]), base_files()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        file, valid, table = (folder / n for n in (f"mutant{ending}", "own.toml", "own.csv"))
        valid.write_bytes(problem)
        table.write_bytes(torques)
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
    answer = {"command": text, "status": status, "findings": findings}
    return {"kind": kind, "what": what, **answer}


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
        if out.strip():
            texts.append(f"exit status {status} with output {out[:80]!r}")
    if status == 2 and not any("mutant" in line for line in lines):
        texts.append(f"the file is not named in {err[:120]!r}")
    partial = sorted(name for name in written if name.endswith(".part"))
    if partial or (status in (1, 2) and written):
        texts.append(f"exit status {status} and {', '.join(sorted(written))} left behind")
    return [("unclear end", text) for text in texts]
