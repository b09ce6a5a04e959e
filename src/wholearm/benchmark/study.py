"""A study: cases, what comes of each, and a table of all.

`run_study` runs the cases in processes, each within its processor time, keeps what comes of them
as they end, goes on where it was stopped, and writes the table with versions and machine.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..common.document import Document, Table, format_csv
from ..common.files import digest_package, make_folder, together, write_text
from ..common.parallel import Journal, Processes, run_all

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Case = tuple[Any, ...]  # plain values that say what is run: the name of its record, too
Row = dict[str, Any]
"""What came of a case, as plain values; `findings` is what must not be.

Added are `case`, the entries that have names, `name`, the `seconds` of processor time, and
`memory`, by which it has raised the peak of its process [MB].
"""
Findings = tuple[Sequence[str | Table], list[str]]
PACKAGES = ("casadi", "numpy", "scipy", "toppra", "yapss")  # those that are there are stated


class Study:
    """Cases, a run of one of them, and a table."""

    name = title = ""  # of its files, ``bench_NAME.jsonl``, ``.md`` and ``.csv``; of the table
    folder = "results"  # where, if the command line does not say
    timed = alone = False  # whether cases are run one at a time, and each in a process of its own
    strict = False  # whether warnings are errors
    shipped = seeded = False  # whether it reads problem files; whether cases are drawn from a seed
    keys: tuple[str, ...] = ()  # names of the first entries of cases, as rows have them
    columns: tuple[str, ...] = ()  # entries of rows that are written as CSV; none for no such file
    options = ""  # table of options beside those that every study has, as of `read_options`

    def list_options(self) -> str:
        """The table of all options."""
        parts = {
            self.options: True,
            "--jobs N  processes (as many as cores) in 1..256\n": not self.timed,
            "--problems DIR  folder of problem files = problems\n": self.shipped,
            f"--seed K  of everything drawn = 0 in 0..{2**63}\n": self.seeded,
            "--fresh  run all cases anew, whatever records the folder has\n": True,
            "--again  run again the cases that had findings\n": True,
            f"-o --output DIR  folder for records and tables = {self.folder}\n": True,
        }
        return "".join(text for text, has in parts.items() if has)

    def stamp(self, options: argparse.Namespace) -> dict[str, Any]:
        """What records belong to, beside study and version: a seed, for example."""
        return {}

    def list_cases(self, options: argparse.Namespace) -> Iterable[Case]:
        """All cases."""
        raise NotImplementedError

    def run(self, case: Case) -> Row:
        """Run one case, in another process."""
        raise NotImplementedError

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        """Texts and tables, and what must not be; cases that have failed are not in `rows`."""
        raise NotImplementedError

    def draw(self, rows: Sequence[Row]) -> Figure | None:
        """The figure, if there is one."""
        return None

    def limit(self, case: Case) -> float:
        """Processor time that a case may take [s]."""
        return 60.0


def name_case(case: Iterable[Any]) -> str:
    """A case in words."""
    return " ".join(map(str, case))


def group(rows: Iterable[Row], *keys: str) -> dict[Any, list[Row]]:
    """Rows by one of their entries, or by several, in the order in which these come first."""
    groups, find = dict[Any, list[Row]](), itemgetter(*keys)
    for row in rows:
        groups.setdefault(find(row), []).append(row)
    return groups


def run_study(
    study: Study, options: argparse.Namespace, progress: Callable[[str], None] = lambda text: None
) -> tuple[str, list[str], list[str]]:
    """Run a study, or what is left of it, and write its table.

    Returns its text, what must not be, and the files it has written.
    """
    cases = list(dict.fromkeys(study.list_cases(options)))
    make_folder(options.output)
    stem = os.path.join(options.output, f"bench_{study.name}")
    stamp = {"study": study.name, "version": __version__, **study.stamp(options)}
    with Journal(f"{stem}.jsonl", stamp, options.fresh, options.again) as journal:
        done = {json.dumps(row["case"]): row for row in journal.records}
        left = [case for case in cases if json.dumps(case) not in done]
        wall_start, wrong = time.monotonic(), 0
        # Each process has one thread of OpenBLAS.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        jobs = min(1 if study.timed else options.jobs or os.cpu_count() or 1, len(left) or 1)
        pool = Processes(jobs, study.limit, study.alone)
        answers = run_all(partial(measure_case, study), left, pool, jobs)
        for count, (case, answer) in enumerate(answers, start=1):
            row = _fail(str(answer)) if isinstance(answer, Exception) else answer
            done[json.dumps(case)] = row = {"case": list(case), **row}
            journal.add(row)
            wrong += bool(row.get("findings"))
            ahead = (time.monotonic() - wall_start) / count * (len(left) - count) / 60
            text = f"{study.name}: {len(cases) - len(left) + count} of {len(cases)} cases"
            progress(f"{text}, {wrong} with findings, {ahead:.0f} min left")
    rows = [
        dict(zip(study.keys, case, strict=False), name=name_case(case)) | done[json.dumps(case)]
        for case in cases
    ]
    good = [row for row in rows if "failed" not in row]
    parts, violations = study.report(good, options)
    findings = [f"{row['name']}: {row['failed']}" for row in rows if "failed" in row]
    findings += violations
    parts = [describe_machine(), *parts]
    if findings:
        parts += ["## Findings", "\n".join(f"* {text}" for text in findings)]
    text = Document(study.title, parts=parts).to_markdown()
    written = [f"{stem}.md"]
    with together():
        write_text(written[0], text)
        if study.columns:
            written.append(f"{stem}.csv")
            write_text(written[-1], format_csv(rows, study.columns))
        figure = study.draw(good)
        if figure is not None:
            from ..figures.plots import save

            written.append(f"{stem}.png")
            save(figure, written[-1])
    return text, findings, written


def describe_machine() -> str:
    """Versions, processor and cores, in a line."""
    parts = [f"wholearm {__version__}", f"Python {platform.python_version()}"]
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            parts.append(f"{name} {version(name)}")
    processor = platform.processor() or platform.machine()
    with suppress(OSError):
        match = re.search(r"^model name\s*:(.*)$", Path("/proc/cpuinfo").read_text("utf-8"), re.M)
        processor = match[1].strip() if match else processor
    return ", ".join([*parts, processor, f"{os.cpu_count()} cores"])


def digest_source(inputs: Iterable[Path] = ()) -> str:
    """A digest of the source code of the package, the machine, its packages and further files."""
    digest = hashlib.sha256(f"{describe_machine()} {digest_package()}".encode())
    for path in inputs:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def measure_case(study: Study, case: Case) -> Row:
    """Run a case in a process of a study, with what that took."""
    with tempfile.TemporaryFile() as printed:
        # Libraries print there, too.
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        peak, started, wall_start = find_peak(), time.process_time(), time.monotonic()
        try:
            with warnings.catch_warnings():
                if study.strict:
                    warnings.simplefilter("error")
                row = dict(study.run(case))
        except Exception:
            text = traceback.format_exc().strip()[-1500:]
            row = _fail(f"traceback after {time.monotonic() - wall_start:.0f} s: {text}")
        seconds, memory = time.process_time() - started, find_peak() - peak
        sys.stdout.flush()
        sys.stderr.flush()
        printed.seek(0)
        if text := printed.read().decode(errors="replace").strip():
            row["printed"] = text[:500]
    return row | {"seconds": round(seconds, 4), "memory": round(memory, 2)}


def _fail(text: str) -> Row:
    return {"failed": text, "findings": [text]}


def find_peak() -> float:
    """Peak of the memory that this process has had in use [MB]."""
    with suppress(OSError):
        # Where there is `/proc`, the other figure starts from that of the parent.
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
