"""Cases that cost next to nothing, all in one test: each test costs some milliseconds by itself."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any


def each(names: str, rows: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Like `pytest.mark.parametrize`, in one test; what fails names its row."""
    keys, rows = [name.strip() for name in names.split(",")], list(rows)

    def decorate(check: Callable[..., None]) -> Callable[..., None]:
        def run(**fixtures: Any) -> None:
            for row in rows:
                try:
                    check(**fixtures, **dict(zip(keys, row if keys[1:] else [row], strict=True)))
                except BaseException as error:
                    error.add_note(f"with {', '.join(keys)} = {row!r}")
                    raise

        known = inspect.signature(check)
        left = [own for name, own in known.parameters.items() if name not in keys]
        run.__name__, run.__doc__, run.__module__ = check.__name__, check.__doc__, check.__module__
        run.__signature__ = known.replace(parameters=left)  # type: ignore[attr-defined]
        return run

    return decorate
