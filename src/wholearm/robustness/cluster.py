"""Samples on a cluster of Dask's."""

from __future__ import annotations

from concurrent.futures import Executor

from ..common.errors import InputError


def connect(address: str, patience: float = 10.0) -> Executor:
    """An executor on the workers of a scheduler.

    Parameters
    ----------
    address         such as ``tcp://10.0.0.1:8786``
    patience : [s]  how long to wait for an answer

    Raises
    ------
    InputError  if Dask is not installed, or no scheduler answers there
    """
    try:
        from distributed import Client
    except ImportError:
        text = "Dask is not installed; pip install 'wholearm[cluster]' brings it"
        raise InputError("", "--scheduler", text) from None
    try:
        client = Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError("", "--scheduler", f"{address}: {error}") from None
    executor: Executor = client.get_executor(pure=False)
    return executor
