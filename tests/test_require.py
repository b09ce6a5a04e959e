from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wholearm.common.errors import InputError, require_number, require_vector


@pytest.mark.parametrize("value", [3, 3.0, np.float32(3), np.int64(3)])
def test_require_number_takes_every_real_kind(value: Any) -> None:
    number = require_number(value, "key")
    assert number == 3.0 and type(number) is float


@pytest.mark.parametrize("value", [np.bool_(True), np.complex128(1), b"1"])
def test_require_number_refuses_what_is_not_real(value: Any) -> None:
    with pytest.raises(InputError, match="key"):
        require_number(value, "key")


def test_require_vector_takes_tuples_and_arrays() -> None:
    assert require_vector((1, 2), "key", 2).tolist() == [1.0, 2.0]
    assert require_vector(np.array([1, 2]), "key", 2).tolist() == [1.0, 2.0]
