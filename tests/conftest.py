from __future__ import annotations

import gc
import math
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import alone  # noqa: F401 -- before NumPy
from once import STORE

# The process that leads the workers has no use for the package.
if TYPE_CHECKING:
    from wholearm.geometry.curve import Curve
    from wholearm.mapping.formation_map import FormationMap
    from wholearm.problem.definition import Problem
    from wholearm.results.trajectory import Trajectory

# Importing the package and collecting tests makes hardly any garbage.
gc.disable()
# A shell lets what it starts in the background ignore SIGINT, and so would all that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "multiply every number of every scene by 1 + k 2^-52, k from -4 to 4, drawn by SEED"
    parser.addoption("--rounding", type=int, metavar="SEED", help=text)
    text = "also run the lines of the documentation and cases of the corpus that take seconds"
    parser.addoption("--slow", action="store_true", help=text)


def pytest_configure(config: pytest.Config) -> None:
    seed = config.getoption("--rounding")
    if seed is not None:
        from wholearm.benchmark.corpus import perturb_scenes

        perturb_scenes(seed)


def pytest_collection_finish() -> None:
    """Spare the collector what is there until the end, modules and tests, and look rarely."""
    gc.freeze()
    gc.set_threshold(200_000, 50, 1000)
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def store(tmp_path_factory: pytest.TempPathFactory) -> None:
    """One folder for the results that all workers of this run share."""
    own = tmp_path_factory.getbasetemp()
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    STORE.folder = shared / "once"
    STORE.folder.mkdir(exist_ok=True)


@pytest.fixture(scope="session", autouse=True)
def quiet() -> Iterator[None]:
    """No line of progress on stderr, however long a command takes on this machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wholearm.cli.command.LOG_INTERVAL", math.inf)
        yield


@pytest.fixture(scope="session")
def heptagon() -> Problem:
    from shipped import HEPTAGON, problem_of

    return problem_of(HEPTAGON)


@pytest.fixture(scope="session")
def box_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from shipped import box_text

    path = tmp_path_factory.mktemp("box") / "box.toml"
    path.write_text(box_text(), encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def box(box_file: Path) -> Problem:
    """The problem of the README, as a file: one slide of a box."""
    from wholearm import load

    return load(str(box_file))


@pytest.fixture(scope="session")
def curves(heptagon: Problem) -> tuple[Curve, ...]:
    from wholearm.geometry.tracing import trace_phases

    return trace_phases(heptagon)


@pytest.fixture(scope="session")
def chart() -> FormationMap:
    import shipped

    return shipped.chart()


@pytest.fixture(scope="session")
def trajectory() -> Trajectory:
    """The plan for the heptagon with every option at its default."""
    from shipped import HEPTAGON, plan_of

    return plan_of(HEPTAGON)


@pytest.fixture
def unadvised(monkeypatch: pytest.MonkeyPatch) -> None:
    """Why there is no plan, without what would change that, which takes long to find."""
    monkeypatch.setattr("wholearm.planning.explain.find_changes", lambda *_: [])
