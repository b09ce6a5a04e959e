"""Packages and their order, and every Python and shell line of the documentation."""

from __future__ import annotations

import ast
import inspect
import pkgutil
import re
import shlex
import tomllib
from collections.abc import Callable
from functools import cache
from glob import glob
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import pytest

import wholearm
from once import once
from shipped import FOLDER, HEPTAGON, HEXAGON, LANDING, chart, problem_of, solved, verified
from wholearm import Plan, Problem
from wholearm.cli.command import TOPICS, build_parser, main, prepare, read_page

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
    lines = re.findall(r"^ *from (\.+)(\S*) import", path.read_text(encoding="utf-8"), re.M)
    firsts = [(*here[: len(here) + 1 - len(dots)], *name.split("."))[0] for dots, name in lines]
    return [first for first in firsts if (SOURCE / first).is_dir()]


def test_the_readme_lists_every_package() -> None:
    packages = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    assert packages == set(read_order())


def test_packages_import_those_above_them() -> None:
    order = read_order()
    modules = list(SOURCE.glob("*/**/*.py"))
    assert len(modules) > 100
    for path in modules:
        package = path.relative_to(SOURCE).parts[0]
        below = {*order[order.index(package) + 1 :]} & {*list_imports(path)}
        assert not below, f"{path.relative_to(SOURCE)} imports {below}"


def test_the_places_to_look_are_there() -> None:
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("### Where to look")[1]
    rows = re.findall(r"^\| (?!\||-)(.*?) \| (`.*?) \| (`.*?) \|$", section.split("###")[0], re.M)
    assert len(rows) == 5
    for _, places, names in rows:
        files = [SOURCE / name for name in re.findall(r"`(.*?)`", places)]
        text = "".join(file.read_text(encoding="utf-8") for file in files)
        for name in re.findall(r"`(.*?)`", names):
            assert re.search(rf"(def|class) {name}\b", text), name


def test_every_name_is_there() -> None:
    for name in wholearm.__all__:
        assert getattr(wholearm, name) is not None, name
        # And the same object when asked again.
        assert getattr(wholearm, name) is getattr(wholearm, name), name
        assert name in dir(wholearm), name


def test_unknown_attribute() -> None:
    with pytest.raises(AttributeError, match="module 'wholearm' has no attribute 'slove'"):
        wholearm.slove  # type: ignore[attr-defined] # noqa: B018
    assert not hasattr(wholearm, "numpy_")


def test_a_function_is_not_shadowed_by_its_module() -> None:
    """The import of a module beside it would replace a function of the same name."""
    beside = {own.name for own in pkgutil.iter_modules(wholearm.__path__)}
    assert not beside & {*wholearm.__all__}
    kinds = [type(getattr(wholearm, name)) for name in ("verify", "simulate", "plots", "solve")]
    assert kinds == [FunctionType, FunctionType, ModuleType, FunctionType]


PAGES = [ROOT / "README.md", *sorted(SOURCE.rglob("README.md"))]
"""How the package is used, and what it does; the parts beside the code are topics of `help`."""
EVERY = [*PAGES, *sorted(FOLDER.rglob("README.md")), *sorted((ROOT / "results").glob("*.md"))]
QUICK = ("new", "schema", "export", "verify", "plot")
"""Commands that are run; the others plan, search, draw movies or sample, which tests of their own
do with less: of these the real parser reads the lines."""


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def list_lines(path: Path) -> list[str]:
    """Commands of a page, indented or in backticks."""
    indented = re.findall(r"^    ((?:\.venv/bin/)?(?:wholearm|python).*)$", read(path), re.M)
    parts = [part.strip() for line in indented for part in line.split("&&")]
    spans = re.findall(r"`((?:wholearm|python -m wholearm)[^`]*)`", read(path))
    found = [*parts, *(" ".join(span.split()) for span in spans)]
    own = (re.sub(r"^.*?/?(wholearm |python -m wholearm)", r"\1", line) for line in found)
    return [line for line in own if line.startswith(("wholearm ", "python -m wholearm"))]


def list_blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", read(path), re.M | re.S)


make_parser = cache(build_parser)
LINES = list(dict.fromkeys(line for path in EVERY for line in list_lines(path)))
BLOCKS = [block for path in PAGES for block in list_blocks(path, "python")]


@pytest.fixture
def line(request: pytest.FixtureRequest) -> str:
    """A line that is run."""
    own: str = request.param
    words = shlex.split(own)[1:]
    quick = words[0] in QUICK and not {"--policy", "--free", "free"} & {*words}
    if not quick and not request.config.getoption("--slow"):
        pytest.skip("slow: --slow runs it")
    return own


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with the files that the lines name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "problems").symlink_to(FOLDER)
    (tmp_path / "results").mkdir()
    solved(LANDING).save("results/heptagon.npz")
    solved(HEPTAGON).save("plan.npz")
    tuned = read(FOLDER / "torques" / "heptagon_tuned.csv")
    (tmp_path / "tuned.csv").write_text(tuned, encoding="utf-8")
    block = list_blocks(FOLDER / "README.md", "toml")[0]
    for name in ("flip.toml", "goal.toml"):
        (tmp_path / name).write_text(block, encoding="utf-8")
    wholearm.save(problem_of(HEPTAGON), "problem.toml")
    return tmp_path


@once
def flip() -> Plan:
    return wholearm.solve(wholearm.load("flip.toml"))


@once
def pent() -> Plan:
    assert main(shlex.split(next(line for line in LINES if "new pent" in line))[1:]) == 0
    return wholearm.solve(wholearm.load("pent.toml"))


@once
def policy() -> wholearm.Policy:
    return wholearm.make_policy(problem_of(HEPTAGON), solved(HEPTAGON), reserve=0.0)


def test_python_blocks_run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy().save("policy.npz")
    solve, known = wholearm.solve, {"heptagon, landing on edge 1": solved(LANDING)}

    def look_up(problem: Problem, **options: Any) -> Plan:
        return known.get(problem.name) or solve(problem, **options)

    monkeypatch.setattr(wholearm, "solve", look_up)
    names: dict[str, Any] = {}
    assert len(BLOCKS) >= 4
    for block in BLOCKS:
        exec(block, names)
    assert {path.name for path in folder.iterdir()} >= {"plan.pdf", "replay.npz", "heavier.toml"}
    assert wholearm.load("heavier.toml").table == problem_of(LANDING).with_(mass=0.25).table


def test_python_calls_fit_their_functions() -> None:
    for text in re.findall(r"`(wholearm\.\w[\w.]*\([^`]*\))`", "".join(map(read, PAGES))):
        call = ast.parse(text, mode="eval").body
        assert isinstance(call, ast.Call), text
        function = eval(ast.unparse(call.func), {"wholearm": wholearm})
        inspect.signature(function).bind(*call.args, **{str(key.arg): 0 for key in call.keywords})


def test_shell_lines_are_read(folder: Path) -> None:
    for line in LINES:
        words = shlex.split(line, comments=True)
        if words[0] == "wholearm" and "COMMAND" not in words:
            if len(words) == 2:
                words.append("--help")
            try:
                make_parser().parse_args(prepare(words[1:]))
            except SystemExit as error:
                assert error.code == 0, line


PLANS: dict[str, Callable[[], Any]] = {
    "hexagon.npz": lambda: solved(HEXAGON),
    "time.npz": lambda: solved(HEPTAGON),
    "margin.npz": lambda: solved(HEPTAGON, "margin"),
    "policy.npz": lambda: policy(),
    "flip.npz": lambda: flip(),
    "pent.npz": lambda: pent(),
}
"""Files that other lines of the documentation have written."""
RUN = [
    line
    for line in LINES
    if len(line.split()) > 2 and line.split()[1] != "bench" and not re.search("COMMAND|FILE", line)
]


@pytest.mark.parametrize("line", RUN, indirect=True)
def test_shell_lines_run(line: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(line)[1:]
    if "mujoco" in words:
        pytest.importorskip("mujoco")
    if "pent.toml" in words:
        pent()
    made = {option + 1 for option, word in enumerate(words) if word in ("-o", "--torques")}
    for place, word in enumerate(words):
        if word in PLANS and place not in made:
            PLANS[word]().save(word)
    words = [own for word in words for own in (glob(word) if "*" in word else [word])]
    status = main(words)
    # Torques that are compared may lose a contact, which the exit status says.
    assert status == 0 or (words[0], status) == ("compare", 1), capsys.readouterr().err


def test_results_are_one_line_and_motions_a_picture() -> None:
    problem, plan = problem_of(HEPTAGON), solved(HEPTAGON)
    results = [plan, plan.trajectory, wholearm.simulate(problem, plan), verified(HEPTAGON)]
    for result in (*results, policy(), chart(), problem):
        text = repr(result)
        assert len(text) <= 100 and "\n" not in text
        assert text.startswith(f"{type(result).__name__}(")
    assert "<svg" in plan._repr_html_() and "<svg" in chart()._repr_html_()


def test_problem_files_are_toml_and_that_of_the_readme_plans(box: Problem) -> None:
    for path in EVERY:
        for block in list_blocks(path, "toml"):
            assert tomllib.loads(block)
    assert wholearm.solve(box).replay is not None


def test_links_lead_somewhere() -> None:
    for path in EVERY:
        text = re.sub(r"^```.*?^```", "", read(path), flags=re.M | re.S)
        for target, anchor in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", text):
            if target.startswith("http"):
                continue
            found = path if not target else path.parent / target
            assert found.exists(), (path, target)
            if anchor:
                headings = re.findall(r"^#+ (.*)$", read(found).lower(), re.M)
                anchors = [re.sub(r"[^\w\- ]", "", own).replace(" ", "-") for own in headings]
                assert anchor in anchors, (path, target, anchor)


def test_modules_that_pages_name_are_there() -> None:
    for path in PAGES:
        for name in re.findall(r"`([\w./]+\.py)`", read(path)):
            places = (ROOT, SOURCE, path.parent, SOURCE / "planning")
            assert any((place / name).exists() for place in places), (path, name)


def test_pages_are_short_and_topics_of_help(capsys: pytest.CaptureFixture[str]) -> None:
    beside = {page.parent for page in PAGES[1:]}
    assert beside == {SOURCE / folder for folder in TOPICS.values()}
    assert len(read(PAGES[0]).splitlines()) <= 300
    assert all(len(read(page).splitlines()) <= 120 for page in PAGES[1:])
    assert main(["help"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(TOPICS)
    assert main(["help", "time-domain"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("# Time domain") and "(wholearm help path-domain)" in text
    for folder in TOPICS.values():
        text = read_page(folder)
        assert text.startswith("# ") and "README.md)" not in text, folder
    assert main(["help", "planing"]) == 2
    assert "'planning'" in capsys.readouterr().err
    with (ROOT / "pyproject.toml").open("rb") as file:
        data = tomllib.load(file)["tool"]["setuptools"]["package-data"]
    assert "README.md" in data["*"]


def test_set_up_takes_two_commands_which_are_those_of_ci() -> None:
    solving, testing = re.findall(r"^    (python3 -m venv .*)$", read(ROOT / "README.md"), re.M)
    script = read(ROOT / ".ci" / "run")
    assert testing in script.splitlines()
    assert solving.split("wholearm ")[1].split(" -o")[0] in script


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
                if module.startswith("mechanics."):
                    assert f"`{module}`" in doc
                    shared |= {alias.name for alias in node.names}
    said = set(re.findall(r"`(\w+)`", doc)) - {"scene", "contacts", "problem", "results"}
    assert shared == said
