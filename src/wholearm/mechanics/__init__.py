"""Equations of motion, limits, impacts; the least uniqueness margin that can be asked for."""

from __future__ import annotations

from dataclasses import replace

from ..common.errors import InputError, require_number
from ..common.fields import FieldKind, read_options

MARGIN = """\
--uniqueness-margin  least uniqueness margin of contact forces: principal minors of the contact
    matrix over those without friction, 1 without friction, 0 ambiguous (0.1) in -1e3..0.999
"""


def _read_margin(margin: object, key: str) -> float:
    value = require_number(margin, key)
    if value >= 1:
        raise InputError("", key, f"{value:g} given; allowed are numbers below 1")
    return value


_KIND = FieldKind(_read_margin, {"type": "number", "exclusiveMaximum": 1})
# Coefficients of friction are not known to better than a tenth.
UNIQUENESS = replace(read_options(MARGIN)[0].field, kind=_KIND, default=0.1)
