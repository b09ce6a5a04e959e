"""Changes of nested tables and lists, from a seeded generator."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

STRANGE: tuple[Any, ...] = (
    float("nan"), float("inf"), float("-inf"), 0, 0.0, -0.0, -1, 1, 2**63, 10**400, -(10**30),
    1e308, -1e308, 1e-308, 5e-324, 1e30, 1e-30, True, False, "", "text", "v0-palm", "v99-palm",
    "e1-tip1", "v0-palm rolling", "rest", "smooth", "impact", "\u00e9\u4e2d\U0001f600", "a\\u0000b",
    [], [[]], [0], [1, 2, 3], ["v0-palm"], [[0, 0]], [["a", "b"]], [float("nan")], {}, {"x": 1},
    {"x": "y"}, {"a": {"b": {}}}, {"phi_deg": 1e9}, {"x": 0.0, "phi_deg": 1.0},
)  # fmt: skip
"""Values that take the place of others."""


def pick(rng: np.random.Generator, options: Any) -> Any:
    """One of some options."""
    return options[int(rng.integers(len(options)))]


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every path into nested tables and lists."""
    items: Any = ()
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list):
        items = enumerate(value)
    return [place for key, part in items for place in ((*path, key), *_places(part, (*path, key)))]


def _parent(table: Any, path: tuple[Any, ...]) -> Any:
    for key in path[:-1]:
        table = table[key]
    return table


def change_tree(rng: np.random.Generator, table: Any) -> str:
    """Change one value or key of nested tables and lists in place; says what."""
    path = pick(rng, _places(table))
    parent, key = _parent(table, path), path[-1]
    what = str(rng.choice(["delete", "rename", "replace", "replace", "replace", "scale", "double"]))
    name = ".".join(map(str, path))
    value = parent[key]
    if what == "delete":
        del parent[key]
    elif what == "rename" and isinstance(parent, dict):
        parent[pick(rng, [f"{key}s", str(key).upper(), "", "x y", "\u00e9", "mass"])] = parent.pop(
            key
        )
    elif what == "scale" and isinstance(value, int | float) and not isinstance(value, bool):
        parent[key] = value * pick(rng, [-1.0, 0.5, 2.0, 1e3, 1e-3, 1e6, 1e-6, 1e12, 1e-12])
    elif what == "double" and isinstance(parent, list):
        parent.insert(int(rng.integers(len(parent) + 1)), copy.deepcopy(value))
    else:
        what, new = "replace", pick(rng, STRANGE)
        parent[key] = copy.deepcopy(new)
        return f"{name} becomes {str(new)[:40]}"
    return f"{what} {name}"
