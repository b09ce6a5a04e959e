"""Plans joint-torque trajectories for dynamic whole-arm manipulation in the plane.

>>> problem = wholearm.load("problems/heptagon.toml")
>>> plan = wholearm.solve(problem, objective="time")
>>> report = wholearm.verify(problem, plan)
>>> figure = wholearm.plots.force_margins(plan)

Everything is imported when it is first used, so that a program pays only for what it needs. What
there is, and where, stands in ``__init__.pyi`` alone.
"""

from __future__ import annotations

import ast
from pathlib import Path
from types import FunctionType
from typing import Any

__version__ = "0.1.0"

_MODULES = {
    alias.name: node.module
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
"""Modules of the public names."""
__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # As `from .module import name` does, which may be a module, too.
    value = getattr(__import__(_MODULES[name], globals(), None, [name], 1), name)
    if isinstance(value, FunctionType):
        from .common.arguments import checked

        value = checked(value)
        value.__module__ = __name__  # where it is found when it is pickled
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
