"""Tables of the stress study."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from .plans import KINDS, Finding

FILE_KINDS = ("traceback", "warning", "hang", "crash", "unclear end")
PROBLEM_KINDS = (
    "traceback", "warning", "hang", "crash", "plan refuted by replay", "plan refuted by residual",
    "no plan for a shipped problem",
)  # fmt: skip
SHOWN = 300
"""Longest text of a finding that is shown."""


def stamp_machine(jobs: int) -> dict[str, Any]:
    """Versions and processor."""
    return {
        "casadi": ca.__version__,
        "numpy": np.__version__,
        "Python": platform.python_version(),
        "processor": _name_processor(),
        "cores": os.cpu_count(),
        "jobs": jobs,
    }


def _name_processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as stream:
            for line in stream:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def format_summary(
    records: Sequence[Mapping[str, Any]], noise: Sequence[Finding], stamp: Mapping[str, Any]
) -> tuple[str, int]:
    """Tables as Markdown, and how many findings there are."""
    lines = ["# Stress study", ""]
    lines += [", ".join(f"{key} {value}" for key, value in stamp.items() if key != "study"), ""]
    count = len(noise)
    listed: list[str] = []
    for key, kinds, title in (
        ("scene", KINDS, "Generated scenes"),
        ("file", FILE_KINDS, "Damaged files"),
        ("problem", PROBLEM_KINDS, "Problems with noise and with other masses and forces"),
    ):
        mine = [record for record in records if key in record]
        if not mine:
            continue
        found = [(record[key], *finding) for record in mine for finding in record["findings"]]
        extra = [("all", *finding) for finding in noise] if key == "problem" else []
        count += len(found)
        lines += [f"## {title}", ""]
        lines += {"scene": _describe_scenes, "file": _describe_files, "problem": _describe_trials}[
            key
        ](mine)
        lines += ["", "| finding | number |", "|---|---:|"]
        counted = Counter(kind for _, kind, _ in [*found, *extra])
        names = dict.fromkeys([*kinds, *counted])
        lines += [f"| {kind} | {counted[kind]} |" for kind in names]
        lines.append("")
        listed += [
            f"| {key} {_name(name)} | {kind} | {_shorten(text)} |"
            for name, kind, text in [*found, *extra]
        ]
    if listed:
        lines += ["## Findings", "", "| where | kind | what |", "|---|---|---|", *listed, ""]
    return "\n".join(lines), count


def _name(name: Any) -> str:
    return " ".join(map(str, name)) if isinstance(name, list | tuple) else str(name)


def _shorten(text: str) -> str:
    line = " ".join(text.split()).replace("|", "\\|")
    return line if len(line) <= SHOWN else f"{line[: SHOWN // 2]} ... {line[-SHOWN // 2 :]}"


def _count(pairs: Iterable[str]) -> str:
    return ", ".join(f"{number} {name}" for name, number in sorted(Counter(pairs).items()))


def _describe_scenes(records: Sequence[Mapping[str, Any]]) -> list[str]:
    known = [record for record in records if "outcome" in record]
    verdicts = [r["verdict"] or "not judged" for r in known if r["outcome"] == "refused"]
    lines = [
        "| | |",
        "|---|---|",
        f"| scenes | {len({record['scene'][0] for record in records})} |",
        f"| answers, one for each objective | {_count(record['outcome'] for record in known)} |",
        f"| refusals, looked at a second time | {_count(verdicts)} |",
    ]
    seconds = np.array([r["seconds"] for r in known if r["seconds"]])
    if seconds.size:
        middle, most = np.percentile(seconds, [50, 95])
        share = float((seconds <= 5.0).mean())
        text = f"median {middle:.2f} s, 95 % within {most:.2f} s, longest {seconds.max():.2f} s"
        lines.append(f"| processor time of an answer | {text}; {share:.1%} within 5 s |")
    lines += ["", "| kind of scene | planned | refused | failed |", "|---|---:|---:|---:|"]
    for kind in sorted({record["kind"] for record in known}):
        own = Counter(record["outcome"] for record in known if record["kind"] == kind)
        lines.append(f"| {kind} | {own['planned']} | {own['refused']} | {own['failed']} |")
    return lines


def _describe_files(records: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = ["| files | number | exit status |", "|---|---:|---|"]
    for kind in sorted({record.get("kind", "unknown") for record in records}):
        mine = [record for record in records if record.get("kind", "unknown") == kind]
        lines.append(f"| {kind} | {len(mine)} | {_status(mine)} |")
    return lines


def _status(records: Sequence[Mapping[str, Any]]) -> str:
    counted = Counter(str(record.get("status")) for record in records)
    return ", ".join(f"{status}: {number}" for status, number in sorted(counted.items()))


def _describe_trials(records: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = ["| problem | objective | trials | without a finding | values apart under noise |"]
    lines.append("|---|---|---:|---:|---:|")
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for record in records:
        path, objective = record["problem"][:2]
        groups.setdefault((os.path.basename(path), objective), []).append(record)
    for (name, objective), mine in groups.items():
        good = sum(not record["findings"] for record in mine)
        values = [r["value"] for r in mine if r["problem"][2] == "noise" and r.get("value")]
        apart = f"{(max(values) - min(values)) / max(map(abs, values)):.1e}" if values else ""
        lines.append(f"| {name} | {objective} | {len(mine)} | {good} | {apart} |")
    return lines
