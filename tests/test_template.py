"""Problem files to begin with plan as they are."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.geometry.path_guess import load
from wholearm.mapping.template import write_template
from wholearm.planning.plan import solve


def least_time(folder: Path, corners: int, size: float, mass: float | None = None) -> float:
    path = folder / "own.toml"
    path.write_text(write_template("own", corners, size, mass), encoding="utf-8")
    return solve(load(str(path))).value


@pytest.mark.parametrize("corners", [3, 4, 5, 6, 7, 12])
def test_a_template_plans_as_it_is(corners: int, tmp_path: Path) -> None:
    assert least_time(tmp_path, corners, 0.05) > 0


def test_templates_are_alike_in_every_size(tmp_path: Path) -> None:
    # Under gravity times go with the root of lengths, whatever the mass; numbers have four digits.
    small, large = least_time(tmp_path, 7, 0.05), least_time(tmp_path, 7, 5.0, mass=3.0)
    assert large / small == pytest.approx(math.sqrt(100.0), rel=1e-2)


@pytest.mark.parametrize(
    ("given", "key"),
    [((2, 0.05, None), "--polygon"), ((7, -1.0, None), "--size"), ((7, 0.05, 0.0), "--mass")],
)
def test_what_makes_no_scene_is_refused(given: tuple[int, float, float | None], key: str) -> None:
    with pytest.raises(InputError, match=key):
        write_template("own", *given)


def test_new_writes_a_file_and_keeps_one_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.toml"
    assert main(["new", str(tmp_path / "mine"), "--polygon", "5"]) == 0
    text = path.read_text(encoding="utf-8")
    assert load(str(path)).name == "mine"
    assert load(str(path)).scene.polygon.n_vertices == 5
    assert main(["new", str(path)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == text
