"""What commands print of results, and of the files that they have written."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from .progress import clear_progress

if TYPE_CHECKING:
    from ..common.document import Result


def print_result(
    options: argparse.Namespace, result: Result, notes: Mapping[str, Any] | None = None
) -> int:
    """Print a result as text, or with --json and with notes as JSON; return the exit status."""
    clear_progress()
    if options.json:
        print(json.dumps({**result.to_dict(), **(notes or {})}, indent=2))
    else:
        print(result.to_text())
    return result.exit_status


def name_files(options: argparse.Namespace, *paths: str | None) -> None:
    """Say which files have been written, if any, but not amid JSON."""
    clear_progress()
    written = ", ".join(filter(None, paths))
    if written and not getattr(options, "json", False):
        print(f"wrote {written}")
