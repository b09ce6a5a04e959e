"""What many tests need and one worker of a test run computes for all of them."""

from __future__ import annotations

import fcntl
import hashlib
import os
import pickle
from collections.abc import Callable
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Store:
    """A folder of pickled results, shared by the workers of one test run."""

    folder: Path | None = None
    """None outside a test run, where every process computes for itself."""

    def get(self, name: str, compute: Callable[[], T]) -> T:
        """The result of that name, computed now if no worker has done so yet."""
        if self.folder is None:
            return compute()
        file = self.folder / f"{hashlib.sha256(name.encode()).hexdigest()}.pickle"
        # The lock goes with its process, so that nobody waits for a worker that died.
        with file.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if file.exists():
                kept: T = pickle.loads(file.read_bytes())
                return kept
            result = compute()
            part = file.with_suffix(".part")
            part.write_bytes(pickle.dumps(result))
            os.replace(part, file)
            return result


STORE = Store()


def once(compute: Callable[P, T]) -> Callable[P, T]:
    """Like `functools.cache`, but for all workers of a test run.

    Arguments have to be told apart by their repr, and results have to pickle. An argument that is
    left out is the same as its default.
    """
    parameters, known = signature(compute), dict[str, T]()

    @wraps(compute)
    def get(*args: P.args, **kwargs: P.kwargs) -> T:
        given = parameters.bind(*args, **kwargs)
        given.apply_defaults()
        name = f"{compute.__module__}.{compute.__qualname__}({given.arguments})"
        if name not in known:
            known[name] = STORE.get(name, lambda: compute(*args, **kwargs))
        return known[name]

    return get
