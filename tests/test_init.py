from __future__ import annotations

import subprocess
import sys

import pytest

import wholearm


def run(code: str) -> list[str]:
    """What a fresh interpreter prints, line by line."""
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    return result.stdout.splitlines()


@pytest.mark.parametrize("name", wholearm.__all__)
def test_every_name_is_there(name: str) -> None:
    assert getattr(wholearm, name) is not None
    # And the same object when asked again.
    assert getattr(wholearm, name) is getattr(wholearm, name)
    assert name in dir(wholearm)


def test_unknown_attribute() -> None:
    with pytest.raises(AttributeError, match="module 'wholearm' has no attribute 'slove'"):
        wholearm.slove  # noqa: B018
    assert not hasattr(wholearm, "numpy_")


def test_a_function_is_not_shadowed_by_its_module() -> None:
    """Importing a submodule must not replace the function of the same name."""
    code = (
        "import importlib, wholearm\n"
        "for m in ('verification.verify', 'simulation.simulate', 'planning.plan'):\n"
        "    importlib.import_module('wholearm.' + m)\n"
        "for name in ('verify', 'simulate', 'plots', 'solve'):\n"
        "    print(type(getattr(wholearm, name)).__name__)\n"
        "from wholearm import verify, simulate, plots, solve\n"
        "print(*(type(part).__name__ for part in (verify, simulate, plots, solve)), sep='\\n')"
    )
    kinds = ["function", "function", "module", "function"]
    assert run(code) == 2 * kinds


def test_import_is_lazy() -> None:
    (loaded,) = run(
        "import sys, wholearm; "
        "print([m for m in ('casadi', 'numpy', 'scipy', 'matplotlib') if m in sys.modules])"
    )
    assert loaded == "[]"
