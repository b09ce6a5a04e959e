from __future__ import annotations

import pytest

from wholearm.common.errors import LONGEST, InputError, name_source


@pytest.mark.parametrize("given", ["\n" * 3, "\x00" * 5000, "x" * 5000, "\u2028", "\x1b[2J"])
def test_a_message_is_one_line(given: str) -> None:
    text = str(InputError("a.toml", "name", f"{given} is not allowed"))
    assert text.isprintable() and len(text) <= LONGEST + 10
    assert text.startswith("a.toml: name: ") and text.endswith(" is not allowed")


def test_letters_of_all_scripts_stay() -> None:
    assert str(InputError("", "\u00e9", "\u4e2d")) == "\u00e9: \u4e2d"


def test_a_source_is_given_to_errors_without_one() -> None:
    with pytest.raises(InputError, match="b: key: problem"), name_source("b"):
        raise InputError("", "key", "problem")
    with pytest.raises(InputError, match="a: key: problem"), name_source("b"):
        raise InputError("a", "key", "problem")
