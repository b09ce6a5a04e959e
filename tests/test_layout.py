from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "wholearm"


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


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def list_private_names(text: str) -> list[str]:
    """Names with a leading underscore that a test takes from the package.

    They are imported, or reached through a module: by a dot, or by a string for `monkeypatch`.
    """
    found, modules = [], set()
    nodes = list(ast.walk(ast.parse(text)))
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "wholearm":
            found += [alias.name for alias in node.names if is_private(alias.name)]
            modules |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            modules |= {
                alias.asname or "wholearm" for alias in node.names if "wholearm" in alias.name
            }
    for node in nodes:
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            if ast.unparse(node.value).split(".")[0] in modules:
                found.append(node.attr)
        elif isinstance(node, ast.Call) and re.search(r"[gs]etattr$", ast.unparse(node.func)):
            given = [arg.value for arg in node.args[:2] if isinstance(arg, ast.Constant)]
            found += [name for text in given for name in str(text).split(".") if is_private(name)]
    return found


def test_private_names_are_found() -> None:
    lines = [
        "from wholearm.planning.plan import _assemble",
        "import wholearm.planning.plan\nwholearm.planning.plan._assemble()",
        "from wholearm.planning import plan\nplan._assemble()",
        "import wholearm as w\nw.plan._assemble()",
        "monkeypatch.setattr(plan, '_assemble', None)",
        "monkeypatch.setattr('wholearm.planning.plan._assemble', None)",
    ]
    assert [list_private_names(line) for line in lines] == 6 * [["_assemble"]]
    for line in ("import os\nos._exit(3)", "row._replace(a=1)", "from wholearm import __version__"):
        assert list_private_names(line) == []


def test_no_test_takes_a_private_name() -> None:
    # What a test needs belongs to the interface of its module, under a name without underscore.
    tests = Path(__file__).parent.glob("*.py")
    found = {path.name: list_private_names(path.read_text(encoding="utf-8")) for path in tests}
    assert len(found) > 30 and {name: taken for name, taken in found.items() if taken} == {}


def test_the_readme_lists_every_package() -> None:
    packages = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    assert packages == set(read_order())


def test_packages_import_those_above_them() -> None:
    order = read_order()
    modules = list(SOURCE.glob("*/**/*.py"))
    assert len(modules) > 200
    for path in modules:
        package = path.relative_to(SOURCE).parts[0]
        below = {*order[order.index(package) + 1 :]} & {*list_imports(path)}
        assert not below, f"{path.relative_to(SOURCE)} imports {below}"


def test_the_simulator_shares_with_the_planner_what_it_says() -> None:
    """The mechanics and the friction cones; formations and problems are the data model."""
    folder = SOURCE / "simulation"
    doc = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    shared = set()
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.level == 2:
                module = node.module or ""
                assert module.split(".")[0] in {*re.findall(r"`(\w+)`", doc), "common", "mechanics"}
                if module.startswith("mechanics.") or module == "contacts.cones":
                    assert f"`{module}`" in doc
                    shared |= {alias.name for alias in node.names}
    said = set(re.findall(r"`(\w+)`", doc)) - {"scene", "contacts", "problem", "results"}
    assert shared == said


def test_the_places_to_look_are_there() -> None:
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("### Where to look")[1]
    rows = re.findall(r"^\| (?!\||-)(.*?) \| (`.*?) \| (`.*?) \|$", section.split("###")[0], re.M)
    assert len(rows) == 5
    for _, places, names in rows:
        files = [SOURCE / name for name in re.findall(r"`(.*?)`", places)]
        text = "".join(file.read_text(encoding="utf-8") for file in files)
        for name in re.findall(r"`(.*?)`", names):
            assert re.search(rf"(def|class) {name}\b", text), name
