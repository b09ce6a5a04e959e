from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from shipped import HEPTAGON
from wholearm.benchmark.kernels import (
    Outcome,
    choose_kernel,
    compare,
    describe,
    find_kernel,
    plan_and_verify,
)


@pytest.mark.parametrize("own", ["Haswell", "Zen", "SkylakeX", "Sandybridge", "Prescott"])
def test_another_kernel_is_chosen(own: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    chosen = choose_kernel(own)
    assert chosen != own
    assert (own, chosen) != ("Zen", "Haswell")
    monkeypatch.setattr("platform.machine", lambda: "arm64")
    assert choose_kernel(own) == ""


def test_the_kernel_that_is_asked_for_is_taken() -> None:
    own = find_kernel()
    kernel = choose_kernel(own)
    assert find_kernel(kernel) == (kernel or own)
    assert choose_kernel("") == ""


def test_a_problem_without_a_plan_is_a_fault() -> None:
    outcome = plan_and_verify(str(HEPTAGON), "speed")
    assert outcome.value is None
    assert "speed" in outcome.fault
    good = Outcome("time", 0.25, "", 1.0)
    assert describe("a/b.toml", [good]) == "b: time 0.250000; 1.0 s"
    assert "FAILS: objective" in describe("a/b.toml", [good, outcome._replace(objective="effort")])


def test_a_least_time_off_its_reference_is_a_fault(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    assert compare(path, "time", 9.0) == []
    (tmp_path / "a.reference.json").write_text('{"phase_durations": [0.25, 0.75]}')
    assert compare(path, "time", 1.0004) == compare(path, "effort", 9.0) == []
    assert compare(path, "time", 0.999) == ["least time is -0.10% off its reference figure"]


def test_faults_make_the_exit_status(tmp_path: str) -> None:
    command = [sys.executable, "-m", "wholearm.benchmark.kernels", "--workers", "1"]
    run = subprocess.run([*command, f"{tmp_path}/none.toml"], capture_output=True, text=True)
    assert run.returncode == 1
    assert "none: time - FAILS: " in run.stdout
    assert run.stdout.endswith("0 of 1 problems planned and verified\n")
