"""Tasks that do to their worker what tasks must not do."""

from __future__ import annotations

import os
import warnings


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
    return how
