"""Tasks that do to their worker what tasks must not do."""

from __future__ import annotations

import os
import warnings

import numpy as np


def allow(task: str) -> float:
    """Processor time that a task may take [s]."""
    return 1.0 if task == "hang" else 20.0


def misbehave(how: str) -> str:
    """What a task may do to its worker."""
    if how == "hang":
        while True:
            pass
    if how == "die":
        os._exit(3)
    if how == "raise":
        raise KeyError(how)
    if how == "warn":
        warnings.warn("careful", RuntimeWarning, stacklevel=1)
    if how == "print":
        os.write(2, b"CasADi - WARNING\n")
    if how == "large":
        np.ones(6_000_000)
    return how
