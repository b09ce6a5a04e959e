"""Whether the lists of random routes load: ``python -m wholearm.benchmark.lists --scenes 300``."""

from __future__ import annotations

import argparse
import os
import re
import tempfile
import tomllib
from collections import Counter

import numpy as np

from ..common.errors import InputError
from ..geometry.path_guess import load
from ..mapping.route import Route, format_route, list_formations
from ..problem.read import build_problem
from .stress.scenes import Table, random_route, random_scene
from .stress.toml import to_toml

TRIES = 8
"""Most routes that are drawn in one scene until one can be followed."""
_FIGURE = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


def study_lists(seed: int, scenes: int) -> tuple[int, Counter[str]]:
    """Draw scenes, list a route in each and load the list.

    Returns
    -------
    loaded : int
        Scenes of which a list loads.
    outcomes : Counter
        How often lists failed to load and routes were refused, by message without its figures.
    """
    loaded, outcomes = 0, Counter[str]()
    for index in range(scenes):
        rng = np.random.default_rng([seed, index])
        table = random_scene(rng)
        problem = build_problem(table)
        for _ in range(TRIES):
            try:
                route = list_formations(problem, *random_route(rng, problem))
            except InputError as error:
                outcomes[f"refused: {_FIGURE.sub('#', error.problem)}"] += 1
                continue
            try:
                load_pasted(table, route)
                loaded += 1
            except InputError as error:
                outcomes[f"not loaded: {_FIGURE.sub('#', error.problem)}"] += 1
            break
    return loaded, outcomes


def load_pasted(table: Table, route: Route) -> None:
    """Load the problem file in which a list replaces the phases, and the start if it has one.

    Raises
    ------
    InputError
        If the list does not load.
    """
    text = format_route(route)
    kept = {key: value for key, value in table.items() if key not in tomllib.loads(text)}
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "pasted.toml")
        with open(path, "w", encoding="utf-8") as stream:
            stream.write(f"{to_toml(kept)}\n{text}")
        load(path)


def main() -> None:
    """Print how many lists load, and what became of the others."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    loaded, outcomes = study_lists(options.seed, options.scenes)
    print(f"lists of {loaded} of {options.scenes} scenes load")
    for text, count in outcomes.most_common():
        print(f"{count:5d}  {text}")


if __name__ == "__main__":
    main()
