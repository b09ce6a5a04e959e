"""Equations of motion, limits, impacts, statics; the option of the least uniqueness margin."""

from __future__ import annotations

from dataclasses import replace

from ..common.fields import read_options

MARGIN = """\
--uniqueness-margin  least uniqueness margin of contact forces: principal minors of the contact
    matrix over those without friction, 1 without friction, 0 ambiguous (0.1) in -1e3..0.999
"""


# Coefficients of friction are not known to better than a tenth.
UNIQUENESS = replace(read_options(MARGIN)[0].field, default=0.1)
