"""The commands ``wholearm new`` and ``wholearm schema``: for those who write problem files."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..common.arrays import Array


def write(options: argparse.Namespace) -> int:
    """Write a problem file."""
    from ..common.errors import InputError, name_source
    from ..common.files import require_writable, write_text
    from ..mapping.formation_list import write_template

    output = f"{options.name.removesuffix('.toml')}.toml"
    require_writable(output)
    if os.path.exists(output):
        raise InputError(output, "", "is there already; choose another name")
    name = os.path.splitext(os.path.basename(output))[0]
    vertices = None if options.vertices is None else _read_vertices(options.vertices)
    with name_source("--vertices" if vertices is not None else ""):
        text = write_template(name, options.polygon, options.size, options.mass, vertices)
    write_text(output, text)
    print(f"wrote {output}; next: wholearm solve {output}")
    return 0


def _read_vertices(text: str) -> Array:
    """Corners, shape (n, 2) [m]."""
    import numpy as np

    from ..common.errors import InputError

    try:
        return np.array([[float(part) for part in own.split(",")] for own in text.split()])
    except ValueError:
        given = f"{text!r} given; needed are corners as x,y in m, such as '0,0 0.08,0 0.04,0.06'"
        raise InputError("", "--vertices", given) from None


def show_schema(options: argparse.Namespace) -> int:
    """Print or write the schema, or the tables of keys."""
    import json

    from ..common.files import require_writable, write_text
    from ..problem.keys import build_schema, write_page

    text = write_page() if options.table else json.dumps(build_schema(), indent=2) + "\n"
    if options.output is None:
        print(text, end="")
        return 0
    require_writable(options.output)
    write_text(options.output, text)
    print(f"wrote {options.output}")
    return 0
