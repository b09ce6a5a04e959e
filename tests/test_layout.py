from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "wholearm"
MODULES = sorted(SOURCE.rglob("*.py"))


def read_order() -> list[str]:
    """Packages in the order in which the README lists them."""
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("## Inside")[1]
    rows = re.findall(r"^\| (`\S.*?) \|", section, re.M)
    names = re.findall(r"`(\w+)/", "\n".join(rows))
    return list(dict.fromkeys(names))


def list_imports(path: Path) -> list[str]:
    """Packages of this project that a module imports from, at any place in it."""
    here = path.relative_to(SOURCE).parts[:-1]
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = here[: len(here) - (node.level - 1)]
            first = (*base, *(node.module or "").split("."))[0]
            found += [first] if (SOURCE / first).is_dir() else []
    return found


def test_the_readme_lists_every_package() -> None:
    packages = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    assert packages == set(read_order())


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_packages_import_those_above_them(path: Path) -> None:
    order = read_order()
    parts = path.relative_to(SOURCE).parts
    if len(parts) > 1:
        below = order[order.index(parts[0]) + 1 :]
        assert not [name for name in list_imports(path) if name in below]


def test_the_places_to_look_are_there() -> None:
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("### Where to look")[1]
    rows = re.findall(r"^\| (?!\||-)(.*?) \| (`.*?) \| (`.*?) \|$", section.split("###")[0], re.M)
    assert len(rows) == 5
    for _, places, names in rows:
        files = [SOURCE / name for name in re.findall(r"`(.*?)`", places)]
        text = "".join(file.read_text(encoding="utf-8") for file in files)
        for name in re.findall(r"`(.*?)`", names):
            assert re.search(rf"(def|class) {name}\b", text), name
