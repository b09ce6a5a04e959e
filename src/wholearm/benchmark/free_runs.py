"""Free simulations: random drops, throws and torques, and plans without being told their contacts.

A random run may end in any way, but it must not gain energy, nothing may overlap, and its events
have to end. A plan is simulated phase by phase from rest, and compared with the plan.

    python -m wholearm.benchmark.free_runs --runs 1000 -o results
    python -m wholearm.benchmark.free_runs --plans plan.npz ...
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.files import write_text
from ..free_simulation.hand import measure_gaps
from ..free_simulation.result import FreeSimulation
from ..free_simulation.simulate import simulate_free, simulate_phases
from ..problem.definition import Problem
from ..problem.read import read_own_problem
from ..results.torque import TorqueProfile
from ..results.trajectory_file import load_trajectory
from ..scene.model import Finger, Friction, Scene
from ..scene.polygon import Polygon
from ..simulation.events import OutcomeKind
from ..simulation.simulate import simulate
from .report import stamp

DURATION = 0.4
"""Of a random run [s]."""


class Draw(NamedTuple):
    """A random scene with a state and torques to start from."""

    problem: Problem
    state: Array
    torque: TorqueProfile
    restitution: float


class Figures(NamedTuple):
    """What must not be, of one run.

    Attributes
    ----------
    gained : float
        Largest gain of energy over what the torques did, relative to all that has moved.
    unexplained : float
        Largest residual of the balance of energy, likewise.
    overlap : float
        Largest overlap of two bodies, relative to the scene's length.
    """

    gained: float
    unexplained: float
    overlap: float


def draw_run(seed: int) -> Draw:
    """A random object that is thrown into a hand, which moves by random torques."""
    rng = np.random.default_rng([17, seed])
    count, size = int(rng.integers(3, 8)), 0.05
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    corners = size * np.column_stack([np.cos(angles), rng.uniform(0.4, 1.0) * np.sin(angles)])
    radius = float(rng.choice([0.0, 0.005]))
    fingers = tuple(
        Finger(
            base=[side * rng.uniform(0.07, 0.12), -0.01],
            length=rng.uniform(0.1, 0.2),
            radius=radius,
            inertia=rng.uniform(1e-4, 5e-3),
            viscous=rng.choice([0.0, 0.01]),
            dry=rng.choice([0.0, 0.02]),
            torque_limit=2.0,
        )
        for side in (1.0, -1.0)
    )
    mu = rng.uniform(0, 1, 3) * rng.choice([0.0, 1.0], p=[0.2, 0.8])
    scene = Scene(Polygon(corners, 0.2), (fingers[0], fingers[1]), Friction(*mu.tolist()))
    z = np.zeros(5)
    while measure_gaps(scene, z[None]).min() < 1e-3:
        turn = rng.uniform(-np.pi, np.pi)
        z[:3] = rng.uniform(-0.05, 0.05), rng.uniform(0.05, 0.25), turn
        z[3:] = rng.uniform(0, np.pi / 2), rng.uniform(np.pi / 2, np.pi)
    v = rng.choice([0.0, 1.0]) * rng.normal(size=5) * [0.5, 0.5, 5.0, 3.0, 3.0]
    breaks = np.linspace(0, DURATION, 5)
    coefficients = rng.normal(size=(4, 2, 2)) * rng.choice([0.0, 0.05, 0.5])
    problem = Problem("random", scene, 0.05, z, (), checked=True)
    restitution = float(rng.choice([0.0, rng.uniform(0, 0.9)]))
    return Draw(problem, np.concatenate([z, v]), TorqueProfile(breaks, coefficients), restitution)


def run_draw(draw: Draw) -> FreeSimulation:
    """Simulate one."""
    return simulate_free(draw.problem, draw.torque, start=draw.state, restitution=draw.restitution)


def judge_run(run: FreeSimulation) -> Figures:
    """Measure what must not be."""
    energies = run.energies
    kinetic = 0.5 * (run.z_dot**2) @ run.problem.scene.mass_diagonal
    left = energies.stored - energies.work
    size = kinetic.max() + np.abs(energies.stored).max() + np.abs(energies.work).max()
    depth = -measure_gaps(run.problem.scene, run.z).min()
    return Figures(
        float((left - np.minimum.accumulate(left)).max() / size),
        float(np.abs(energies.residual).max() / size),
        float(max(depth, 0.0) / run.problem.scene.scales.length),
    )


def _study_runs(first: int, count: int) -> list[str]:
    """Run many, and list what stands out."""
    worst: dict[str, tuple[float, int]] = {}
    kinds: Counter[str] = Counter()
    odd, begin = [], time.process_time()
    for seed in range(first, first + count):
        try:
            run = run_draw(draw_run(seed))
        except Exception as error:  # what a study is for
            odd.append(f"run {seed}: {type(error).__name__}: {error}")
            kinds["errors"] += 1
            continue
        kinds.update(event.kind.value for event in run.events)
        if run.outcome.kind is not OutcomeKind.ENDED:
            odd.append(f"run {seed}: {run.outcome.text}")
            kinds["runs given up"] += 1
        for name, value in {**judge_run(run)._asdict(), "residual": run.residual}.items():
            if value > worst.get(name, (-1.0, 0))[0]:
                worst[name] = value, seed
    spent = time.process_time() - begin
    return [
        f"{count} runs of {DURATION} s, from run {first} on, in {spent:.0f} s of processor time.",
        "",
        "| largest | is | in run |",
        "|---|---:|---:|",
        *(f"| {name} | {value:.1e} | {seed} |" for name, (value, seed) in worst.items()),
        "",
        "; ".join(odd) or "Every run comes to its end.",
        "",
        "Events: " + ", ".join(f"{name} {number}" for name, number in sorted(kinds.items())) + ".",
    ]


def _write_runs(lines: Sequence[str], folder: Path, command: str) -> None:
    """Write the table of random runs."""
    head = [
        "# Random free runs: drops, throws and torques",
        "",
        f"`{command}`; {stamp()}",
        "",
        "Gained: energy over what the torques did, and unexplained: what its balance leaves, over",
        "all that has moved. Overlap: of two bodies, over the object's radius of gyration.",
        "Residual: of a contact problem, over its largest rate.",
        "",
    ]
    write_text(str(folder / "bench_free_runs.md"), "\n".join([*head, *lines]) + "\n")


def _study_plans(paths: Sequence[str]) -> None:
    """Compare plans phase by phase."""
    print("plan  phases  position [m]  angle [rad]  events  processor time over that of `simulate`")
    for path in paths:
        plan = load_trajectory(path)
        problem = read_own_problem(plan.meta)
        spent = []
        for _ in range(2):
            marks = [time.process_time()]
            simulate(problem, plan.torque)
            marks.append(time.process_time())
            runs = simulate_phases(problem, plan)
            marks.append(time.process_time())
            spent.append(np.diff(marks))
        ratio = spent[1][1] / spent[1][0]
        for run in runs:
            last = plan.z[np.flatnonzero(plan.phase == run.last)[-1]]
            away = np.abs(run.simulation.z[-1] - last)
            title = f"{path}  {run.first + 1}-{run.last + 1}"
            print(f"{title}  {away[:2].max():.1e}  {away[2:].max():.1e}  ", end="")
            print(f"{len(run.simulation.events)}  {ratio:.1f}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--plans", nargs="*", default=())
    parser.add_argument("-o", "--output", type=Path, help="folder to write the table of runs to")
    options = parser.parse_args(arguments)
    if options.runs:
        lines = _study_runs(options.first, options.runs)
        print("\n".join(lines))
        if options.output is not None:
            command = f"python -m wholearm.benchmark.free_runs --runs {options.runs}"
            command += f" --first {options.first}" if options.first else ""
            _write_runs(lines, options.output, command)
    if options.plans:
        _study_plans(options.plans)


if __name__ == "__main__":
    main()
