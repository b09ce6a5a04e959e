"""The phases that a study runs on: those of one freedom, on four sliding contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...geometry.curve import Curve
from ...geometry.tracing import trace_phases
from ...problem.definition import End, Problem
from ...problem.read import read_problem


class Instance(NamedTuple):
    """One phase from rest to rest.

    Attributes
    ----------
    name : str
        Of the file, and the number of the phase.
    problem : Problem
        Of that phase alone.
    curve : Curve
    """

    name: str
    problem: Problem
    curve: Curve


def keep_curves(problem: Problem) -> Problem | None:
    """The first phases of a problem as far as each is a curve of four sliding contacts.

    These are what peers know; None if already the first phase is not.
    """
    curves = trace_phases(problem)
    rolling = [bool(phase.formation.rolling) for phase in problem.phases[: len(curves)]]
    count = [*rolling, True].index(True)
    kept = tuple(replace(phase, end=End.REST) for phase in problem.phases[:count])
    return replace(problem, phases=kept) if kept else None


@lru_cache(maxsize=4)
def list_instances(paths: tuple[str, ...], drag: bool = True) -> tuple[Instance, ...]:
    """Every phase of problem files that is such a curve; those that files share once.

    Without `drag` joints have no viscous friction.
    """
    found: dict[object, Instance] = {}
    for path in paths:
        read = read_problem(path)
        problem = keep_curves(read if drag else read.with_(viscous=0.0))
        for instance in isolate(problem, Path(path).stem) if problem else ():
            found.setdefault(_identify(instance), instance)
    return tuple(found.values())


def isolate(problem: Problem, name: str) -> list[Instance]:
    """Each phase of a problem as a problem of its own."""
    found = []
    for phase, curve in zip(problem.phases, trace_phases(problem), strict=True):
        alone = replace(problem, start=curve.start, phases=(replace(phase, index=0),))
        found.append(Instance(f"{name} {phase.number}", alone, curve))
    return found


def _identify(instance: Instance) -> object:
    """Equal for phases that are the same in different files."""
    problem = instance.problem
    (phase,), scene = problem.phases, problem.scene
    limits = (problem.epsilon, *scene.torque_limit, *scene.speed_limit)
    places = np.round(np.append(problem.start, instance.curve.end), 9) + 0.0
    return scene.equations, limits, phase.formation.names, tuple(places)


def find_files(folder: str) -> tuple[str, ...]:
    """Problem files of a folder."""
    return tuple(str(path) for path in sorted(Path(folder).glob("*.toml")))


def pick(instances: Sequence[Instance], name: str) -> Instance:
    """The instance of a name."""
    return next(instance for instance in instances if instance.name == name)
