"""Files with something wrong in them, through the command line."""

from __future__ import annotations

import contextlib
import io
import os
import re
import tempfile
import traceback
import warnings
from typing import Any

import numpy as np

from .mutation import Mutant, base_files, draw_mutant

STATUSES = (0, 1, 2)
LONGEST = 2000
"""Longest line on stderr that still counts as clear."""
PROGRESS = re.compile(r"wholearm: \d+ s: ")
"""Lines that tell how long work goes on already."""


def run_file(seed: int, number: int) -> dict[str, Any]:
    """Run one damaged file, and return what came of it as plain data."""
    mutant = draw_mutant(seed, number)
    rng = np.random.default_rng([seed, number, 2])
    with tempfile.TemporaryDirectory() as folder:
        command = write_case(mutant, folder, rng)
        status, findings = run_command(command, folder)
    return {
        "kind": mutant.kind,
        "what": mutant.what,
        "command": " ".join([command[0], *map(os.path.basename, command[1:])]),
        "status": status,
        "findings": findings,
    }


def write_case(mutant: Mutant, folder: str, rng: np.random.Generator) -> list[str]:
    """Write a mutant and what its command needs into a folder; return the command's arguments."""
    path = os.path.join(folder, f"mutant{mutant.ending}")
    if mutant.content is None:
        os.mkdir(path)
    else:
        _write(path, mutant.content)
    problem, torques, _ = base_files()
    own = os.path.join(folder, "problem.toml")
    _write(own, problem)
    share, out = float(rng.uniform()), os.path.join(folder, "out")
    if mutant.kind == "problem":
        if share < 0.6:
            extra = ["--torques", f"{out}.csv"] if share < 0.2 else []
            return ["solve", path, "-o", f"{out}.npz", "--intervals", "20", *extra]
        if share < 0.8:
            table = os.path.join(folder, "torques.csv")
            _write(table, torques)
            return ["verify", path, table]
        if share < 0.97:
            return ["map", path, "--list", "0.02,0", "-0.01,0"]
        return ["map", path, "-o", f"{out}.png", "--phi=-10,10"]
    if mutant.kind == "torque" or share < 0.75:
        return ["verify", own, path, *(["--json"] if share < 0.1 else [])]
    if share < 0.9:
        return ["plot", path, "-o", f"{out}.png", "--simulate"]
    if share < 0.97:
        return ["plot", path, "-o", f"{out}.svg"]
    return ["map", own, "--plan", path, "-o", f"{out}.png", "--phi=-10,10"]


def _write(path: str, content: bytes) -> None:
    with open(path, "wb") as stream:
        stream.write(content)


def run_command(command: list[str], folder: str) -> tuple[int | None, list[tuple[str, str]]]:
    """Run the command line in this process, warnings being errors, and look at what it leaves."""
    from ...__main__ import start

    before = set(os.listdir(folder))
    out, err = io.StringIO(), io.StringIO()
    status: int | None = None
    try:
        with (
            warnings.catch_warnings(),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            warnings.simplefilter("error")
            status = start(command)
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else None
    except Exception as error:
        kind = "warning" if isinstance(error, Warning) else "traceback"
        return None, [(kind, "".join(traceback.format_exception(error)[-4:]).strip())]
    written = set(os.listdir(folder)) - before
    return status, look(command, status, out.getvalue(), err.getvalue(), written)


def look(
    command: list[str], status: int | None, out: str, err: str, written: set[str]
) -> list[tuple[str, str]]:
    """What is wrong with how a command ended."""
    texts = []
    lines = [line for line in err.splitlines() if not PROGRESS.match(line)]
    if status not in STATUSES:
        texts.append(f"exit status {status}")
    if status == 0 and lines:
        texts.append(f"exit status 0 with {lines[0][:80]!r} on stderr")
    # A report on torques that fail goes to stdout; everything else fails with one line.
    reported = command[0] == "verify" and status == 1 and bool(out.strip())
    if status in (1, 2) and not reported:
        if len(lines) != 1 or not lines[0].startswith("wholearm: "):
            texts.append(f"{len(lines)} lines on stderr, beginning {err[:80]!r}")
        elif len(lines[0]) > LONGEST:
            texts.append(f"a line of {len(lines[0])} characters on stderr")
        if out.strip():
            texts.append(f"exit status {status} with output {out[:80]!r}")
    if status == 2 and not any("mutant" in line for line in lines):
        texts.append(f"the file is not named in {err[:120]!r}")
    partial = sorted(name for name in written if name.endswith(".part"))
    if partial or (status in (1, 2) and written):
        texts.append(f"exit status {status} and {', '.join(sorted(written))} left behind")
    return [("unclear end", text) for text in texts]
