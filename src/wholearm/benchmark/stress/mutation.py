"""Problem, torque and trajectory files with something wrong in them, from a seeded generator."""

from __future__ import annotations

import copy
import json
import os
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ...planning.plan import solve
from ...problem.definition import Problem
from ...problem.read import build_problem
from .archives import mutate_archive, pack
from .toml import to_toml
from .trees import change_tree, pick

BASE: dict[str, Any] = {
    "name": "square",
    "epsilon": 0.05,
    "gravity": 9.81,
    "fingers_collide": True,
    "object": {
        "vertices": [[-0.035, -0.035], [0.035, -0.035], [0.035, 0.035], [-0.035, 0.035]],
        "mass": 0.2,
    },
    "fingers": {
        key: {
            "base": [side * 0.08, -0.01],
            "length": 0.11,
            "radius": 0.005,
            "inertia": 0.005,
            "viscous": 0.01,
            "dry": 0.01,
            "torque_limit": 2.0,
            "speed_limit": 30.0,
        }
        for key, side in (("1", 1.0), ("2", -1.0))
    },
    "friction": {"palm": 0.1, "finger1": 0.1, "finger2": 0.1},
    "start": {"flush": 0, "x": 0.02},
    "phases": [
        {
            "contacts": ["v0-palm", "v1-palm", "v2-finger1", "v3-finger2"],
            "until": {"x": 0.005},
        },
        {
            "contacts": ["v0-palm", "v1-palm", "v2-finger1", "v3-finger2"],
            "until": {"x": -0.01},
        },
    ],
}
"""A problem that is planned quickly: a square that slides to the left in two phases."""

DAMAGE = (
    "truncated", "flipped", "inserted", "cut out", "repeated", "empty", "folder", "noise", "utf-16",
    "latin-1", "bom", "crlf", "zeros", "reversed", "twice",
)  # fmt: skip
"""Kinds of damage to bytes whatever the format."""
ROW_DAMAGE = (
    "cell", "cell", "cell", "cell", "header", "delete", "repeat", "thrice", "swap", "short", "long",
    "column", "semicolon", "quote", "scale", "scale", "few", "blank", "field",
)  # fmt: skip
"""Kinds of damage to rows of torques."""


class Mutant(NamedTuple):
    """A file with something wrong in it.

    Attributes
    ----------
    kind : {"problem", "torque", "trajectory"}
    what : str
        What was done.
    ending : str
        Of the file's name.
    content : bytes or None
        None stands for a folder.
    """

    kind: str
    what: str
    ending: str
    content: bytes | None


@lru_cache(maxsize=1)
def base_problem() -> Problem:
    """The problem that all files start from."""
    return build_problem(BASE)


@lru_cache(maxsize=1)
def base_files() -> tuple[bytes, bytes, bytes]:
    """A valid problem file, torque file and trajectory file of the same plan."""
    import tempfile

    plan = solve(base_problem(), intervals=20, samples=21)
    with tempfile.TemporaryDirectory() as folder:
        npz, table = os.path.join(folder, "a.npz"), os.path.join(folder, "a.csv")
        plan.save(npz)
        plan.save_torques(table)
        with np.load(npz) as data:
            arrays = {name: data[name] for name in data.files}
        with open(table, "rb") as stream:
            torques = stream.read()
    # Timings and dates would make every run's files different.
    meta = json.loads(str(arrays["meta"]))
    none = [0.0] * len(meta["solves"])
    told = {"timings": {}, "build_times": none, "solve_times": none}
    arrays["meta"] = np.array(json.dumps(meta | told))
    return to_toml(BASE).encode(), torques, pack(arrays)


def draw_mutant(seed: int, number: int) -> Mutant:
    """Draw file `number` of a seed."""
    rng = np.random.default_rng([seed, number, 1])
    kind = ("problem", "problem", "torque", "trajectory", "trajectory")[number % 5]
    problem, torques, trajectory = base_files()
    if kind == "problem":
        ending, base, own = ".toml", problem, _mutate_problem
    elif kind == "torque":
        ending, base, own = ".csv", torques, _mutate_torques
    else:
        ending, base, own = ".npz", trajectory, lambda rng: mutate_archive(rng, trajectory)
    if rng.uniform() < 0.25:
        what, content = _mutate_bytes(rng, base)
    else:
        what, content = own(rng)
    if rng.uniform() < 0.01:
        ending = str(rng.choice([".TOML", ".txt", "", ".npy", ".CSV", ".npz.csv"]))
    return Mutant(kind, what, ending, content)


def _mutate_bytes(rng: np.random.Generator, base: bytes) -> tuple[str, bytes | None]:
    """Damage that knows nothing of the format."""
    what = str(rng.choice(DAMAGE))
    size = len(base)
    at = int(rng.integers(size))
    length = int(min(size - at, 10.0 ** rng.uniform(0, 3)))
    if what == "truncated":
        return what, base[:at]
    if what == "flipped":
        array = np.frombuffer(base, dtype=np.uint8).copy()
        where = rng.integers(size, size=int(10.0 ** rng.uniform(0, 2)))
        array[where] ^= rng.integers(1, 256, size=len(where)).astype(np.uint8)
        return what, array.tobytes()
    noise = rng.integers(0, 256, size=length).astype(np.uint8).tobytes()
    changed: dict[str, bytes | None] = {
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
    return what, changed[what]


def _mutate_problem(rng: np.random.Generator) -> tuple[str, bytes]:
    what = str(rng.choice(["tree", "tree", "tree", "tree", "tree", "line", "text"]))
    if what == "tree":
        table = copy.deepcopy(BASE)
        done = [change_tree(rng, table) for _ in range(int(rng.integers(1, 3)))]
        return "; ".join(done), to_toml(table).encode("utf-8", "surrogatepass")
    lines = base_files()[0].decode().split("\n")
    at = int(rng.integers(len(lines)))
    if what == "line":
        other = int(rng.integers(len(lines)))
        how = str(rng.choice(["delete", "repeat", "move", "comment", "unclosed"]))
        if how == "repeat":
            lines.insert(other, lines[at])
        elif how == "move":
            lines.insert(other, lines.pop(at))
        elif how == "delete":
            del lines[at]
        else:
            lines[at] = "# " + lines[at] if how == "comment" else lines[at] + " [ { \" '"
        return f"{how} line {at}", "\n".join(lines).encode()
    deep = int(10.0 ** rng.uniform(1, 5))
    text = pick(
        rng,
        [
            "a = " + "[" * deep, "a = " + "[" * deep + "]" * deep,
            "[" + ".".join(["a"] * deep) + "]",
            "a = " + "{ b = " * min(deep, 2000) + "1" + " }" * min(deep, 2000),
            "a = " + "9" * deep, "a = 1e" + "9" * min(deep, 50), "name = \"" + "x" * deep + "\"",
            "phases = [" + "{}," * deep + "]", "a = 2020-01-01", "\x00", "name = '''", "\ufeff",
            "object.vertices = 1", "[object]\n[object]", "[[object]]", "epsilon = 0x1F",
            "epsilon = 1_0.0_1", "start = { flush = 0, x = 1979-05-27T07:32:00Z }",
        ],
    )  # fmt: skip
    where = pick(rng, [0, len(lines)])
    lines.insert(where, text)
    return f"line {where} is {text[:30]!r} of {len(text)}", "\n".join(lines).encode()


def _mutate_torques(rng: np.random.Generator) -> tuple[str, bytes]:
    rows = [line.split(",") for line in base_files()[1].decode().strip().split("\n")]
    rows = rows[:1] + rows[1 :: max(1, len(rows) // 40)]
    at, column = int(rng.integers(len(rows))), int(rng.integers(3))
    how = str(rng.choice(ROW_DAMAGE))
    if how == "cell":
        cells = ["nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-1", "", "text", "1,5"]
        cells += ["0x10", "1_0", "\u0661", " 1 ", '"1"', "1e999", "--1", "True", "\x00", "1" * 5000]
        rows[at][column] = pick(rng, cells)
    elif how == "header":
        rows[0] = pick(
            rng, [["t", "tau1"], ["T", "tau1", "tau2"], ["t", "t", "t"], ["tau2", "tau1", "t"], []]
        )
    elif how == "delete":
        del rows[at]
    elif how in ("repeat", "thrice"):
        rows[at:at] = [list(rows[at]) for _ in range(1 if how == "repeat" else 2)]
    elif how == "swap":
        other = int(rng.integers(len(rows)))
        rows[at], rows[other] = rows[other], rows[at]
    elif how == "short":
        rows[at] = rows[at][:column]
    elif how == "long":
        rows[at] = rows[at] * int(10.0 ** rng.uniform(0, 3))
    elif how == "column":
        rows = [row[:column] + row[column + 1 :] for row in rows]
    elif how == "scale":
        factor = pick(rng, [1e-320, 1e-100, 1e-12, 1e-6, 0.1, 10.0, 1e3, 1e6, 1e100, 1e300, -1.0])
        for row in rows[1:]:
            row[column] = repr(float(row[column]) * factor)
    elif how == "few":
        rows = rows[: int(rng.integers(1, 4))]
    elif how == "blank":
        rows[at:at] = [[""]] * int(10.0 ** rng.uniform(0, 3))
    elif how == "field":
        rows[at][column] = "1" * 200_000
    text = "\n".join((";" if how == "semicolon" else ",").join(row) for row in rows) + "\n"
    if how == "quote":
        where = int(rng.integers(len(text)))
        text = text[:where] + '"' + text[where:]
    return f"{how} in row {at}, column {column}", text.encode("utf-8", "surrogatepass")
