"""Pages and movies; what moves in a page is tried in a browser, where there is one."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from shipped import HEPTAGON, LANDING, chart, plan_of, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.contacts.closing import contact_table, evaluate_contacts
from wholearm.figures.style import choose_styles
from wholearm.mapping.formation_list import write_template
from wholearm.viewer import page
from wholearm.viewer.motion_data import describe_motion, place_pushes
from wholearm.viewer.movie import FRAMES, Movie, write_movie
from wholearm.viewer.report_page import build_report, describe_map, list_joints, list_phases

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def test_pushes_and_weight_are_what_accelerates_the_object() -> None:
    problem, plan = problem_of(LANDING), plan_of(LANDING)
    pushes = place_pushes(problem.scene, plan)
    body = problem.scene.polygon
    assert body.inertia is not None
    arms = pushes.points - plan.q[:, None, :2]
    moments = arms[..., 0] * pushes.forces[..., 1] - arms[..., 1] * pushes.forces[..., 0]
    force, moment = np.nansum(pushes.forces, axis=1), np.nansum(moments, axis=1)
    force[:, 1] -= body.mass * problem.scene.gravity
    # Newton and Euler; plans satisfy them between nodes to 1e-6 of the largest forces.
    scale = np.nanmax(np.abs(pushes.forces))
    np.testing.assert_allclose(body.mass * plan.q_ddot[:, :2], force, atol=1e-5 * scale)
    np.testing.assert_allclose(body.inertia * plan.q_ddot[:, 2], moment, atol=1e-6 * scale)
    np.testing.assert_allclose(np.hypot(*pushes.normals.T), 1.0, rtol=1e-12)


def test_a_motion_survives_its_page() -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    text = page.build_page("a <title>", [page.write_player(describe_motion(plan, problem))])
    assert "a &lt;title&gt;" in text
    # Nothing is fetched: the only address is the name of SVG's namespace.
    assert set(re.findall(r"https?://[^\"]+", text)) == {"http://www.w3.org/2000/svg"}
    assert not re.search(r"\bsrc=\"(?!data:)|\bhref=", text)
    (found,) = re.findall(r'<script type="application/json">(.*?)</script>', text, re.S)
    read = json.loads(found)
    assert len(read["t"]) == len(read["z"]) == len(plan.t)
    np.testing.assert_allclose(read["z"], plan.z, atol=1e-5)
    for index, contact in enumerate(read["contacts"]):
        c = np.full((len(plan.t), 2), np.nan)
        for span in contact["spans"]:
            c[span["first"] : span["first"] + len(span["c"])] = span["c"]
        np.testing.assert_allclose(c[:, 0], plan.c_n[:, index], rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(c[:, 1], plan.c_t[:, index], rtol=1e-5, atol=1e-12)


def test_names_cannot_end_a_script() -> None:
    name = "</script><script>alert(1)"
    motion = describe_motion(plan_of(HEPTAGON), problem_of(HEPTAGON)) | {"name": name}
    assert "</script><script>alert" not in page.write_player(motion)


def test_tables_say_what_the_joints_of_phases_are() -> None:
    problem, plan = problem_of(LANDING), plan_of(LANDING)
    phases, joints = list_phases(problem, plan), list_joints(plan)
    assert [row[0] for row in phases.cells] == list("123456")
    for table in (phases, joints):
        assert {len(row) for row in table.rows} == {len(table.columns)}
    assert [row[0] for row in joints.cells] == list("12345")
    duration = sum(float(row[phases.heads.index("duration [s]")]) for row in phases.cells)
    assert duration == pytest.approx(plan.duration, abs=1e-5)
    # The fourth ends at rest, the fifth smoothly: at a speed, the same on both sides.
    speeds = [row[joints.heads.index("speed before [m/s]") :][:2] for row in joints.cells]
    assert speeds[3] == ["0.0000", "0.0000"]
    assert speeds[4][0] == speeds[4][1] != "0.0000"
    assert "v3-finger1: 0.050 \u2192 -" in joints.cells[4][1]


def test_a_movie_shows_the_whole_motion(tmp_path: Path) -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    movie = Movie(problem, plan, plan, speed=2.0)
    assert movie.times[[0, -1]] == pytest.approx([0.0, plan.duration])
    # Not slower than a frame of the whole, and at twice the speed.
    assert len(movie.times) == pytest.approx(plan.duration / 2.0 * FRAMES + 1, abs=1.0)
    write_movie(movie, tmp_path / "plan.gif")
    with Image.open(tmp_path / "plan.gif") as image:
        frames = getattr(image, "n_frames", 1)
        assert frames == len(movie.times)
        assert image.info["duration"] * FRAMES == 1000
        first = np.array(image.convert("RGB"), dtype=int)
        # Each contact has its own colour.
        for colour in {own.colour for own in choose_styles(plan.contacts).values()}:
            assert (first == ImageColor.getrgb(colour)).all(axis=2).any()
        image.seek(frames - 1)
        assert (np.abs(np.array(image.convert("RGB")) - first).max(axis=2) > 60).mean() > 0.01


@pytest.mark.parametrize(
    ("output", "words"), [("plan.avi", "'.avi' given"), ("none/plan.gif", "none")]
)
def test_animate_refuses_what_it_cannot_write(
    output: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan_of(HEPTAGON).save(str(tmp_path / "plan.npz"))
    assert main(["animate", str(tmp_path / "plan.npz"), "-o", str(tmp_path / output)]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("ffmpeg") is not None, reason="ffmpeg is there")
def test_an_mp4_needs_ffmpeg(tmp_path: Path) -> None:
    movie = Movie(problem_of(HEPTAGON), plan_of(HEPTAGON), speed=100.0)
    with pytest.raises(InputError, match="needs ffmpeg"):
        write_movie(movie, tmp_path / "plan.mp4")


def open_in_browser(text: str, folder: Path, fragment: str = "") -> str:
    """What a page has become in a browser, as HTML."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no Chromium here")
    (folder / "page.html").write_text(text, encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    options += ["--no-first-run", "--disable-sync", "--disable-component-update", "--disable-quic"]
    command = [browser, *options, f"--user-data-dir={folder / 'profile'}", "--dump-dom"]
    address = f"file://{folder / 'page.html'}{fragment}"
    done = subprocess.run([*command, address], capture_output=True, text=True, timeout=60)
    return done.stdout


def test_slider_plots_and_map_respond_in_a_browser(tmp_path: Path) -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    drawing, told = describe_map(chart(), plan)
    places = told["places"]
    kinds = ("a cell", "a border", "a crossing")
    texts = [place["text"] for place in places]
    firsts = [next(k for k, text in enumerate(texts) if text.startswith(kind)) for kind in kinds]
    motion = describe_motion(plan, problem, plan) | {"speed": 0.25}
    parts = [page.write_player(motion), page.write_chart(drawing, told)]
    acts = """<script>
      const said = {}, output = document.querySelector("output");
      const read = () => [output.textContent, document.querySelector(".cursor").getAttribute("x1")];
      said.first = read(); said.speed = document.querySelector("select").value;
      const slider = document.querySelector("input[type=range]");
      slider.value = 500; slider.dispatchEvent(new Event("input")); said.slid = read();
      const plot = document.querySelector(".plot"), box = plot.getBoundingClientRect();
      plot.setPointerCapture = () => {};
      plot.dispatchEvent(new PointerEvent("pointerdown",
        { clientX: box.left + box.width * (58 + 932 * 0.25) / 1000, clientY: box.top + 50 }));
      said.clicked = read();
      said.places = FIRSTS.map((k) => {
        document.querySelector(`.map #place-${k}`).dispatchEvent(new MouseEvent("click"));
        return [document.querySelector(".choice p").textContent,
                document.querySelectorAll(".pose polygon").length,
                document.querySelectorAll(".pose circle[visibility=visible]").length];
      });
      document.body.append(JSON.stringify(said));
    </script></body>""".replace("FIRSTS", str(firsts))
    text = page.build_page("heptagon", parts).replace("</body>", acts)
    found = re.findall(r'\{"first".*\}', open_in_browser(text, tmp_path, "#t=0.1"))
    said = json.loads(found[-1])
    cursor = [58 + 932 * share for share in (0.1 / plan.duration, 0.5, 0.25)]
    for key, x in zip(("first", "slid", "clicked"), cursor, strict=True):
        t = (x - 58) / 932 * plan.duration
        own = int(plan.phase[np.searchsorted(plan.t, t, side="right") - 1])
        assert said[key][0] == f"{float(said[key][0].split()[0]):.4f} s, phase {own + 1}"
        assert float(said[key][0].split()[0]) == pytest.approx(t, abs=1e-3 * plan.duration)
        assert float(said[key][1]) == pytest.approx(x, abs=1.0)
    assert said["speed"] == "0.25"
    # A cell, a border and a crossing, each with its contacts: the object and a dot for each.
    for (text, objects, dots), n_contacts in zip(said["places"], (3, 4, 5), strict=True):
        own = next(own for own in places if own["text"] in text)
        assert text.startswith(" ".join(own["contacts"]) + ": ")
        assert objects == 1 + dots and dots == len(own["contacts"]) >= n_contacts


def test_what_touches_at_a_place_of_the_map_is_told() -> None:
    drawing, told = describe_map(chart(), plan_of(HEPTAGON))
    places = told["places"]
    # Each has its number in the drawing.
    ids = re.findall(r'id="place-(\d+)"', drawing)
    assert sorted(map(int, ids)) == list(range(len(places)))
    scene, freedoms = problem_of(HEPTAGON).scene, {"a cell": 3, "a border": 4, "a crossing": 5}
    table = {contact.name: k for k, contact in enumerate(contact_table(scene))}
    seen = set()
    for own in places:
        kind = next(kind for kind in freedoms if own["text"].startswith(kind))
        assert len(own["contacts"]) >= freedoms[kind]
        label = [table[name] for name in own["contacts"]]
        # Poses are rounded to 1e-5 m and rad, and links are 0.2 m long.
        assert np.abs(evaluate_contacts(scene, label, np.array(own["z"])).C).max() < 1e-5
        seen.add(kind)
    assert seen == set(freedoms)


def test_a_gallery_shows_every_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem = tmp_path / "slide.toml"
    problem.write_text(write_template("slide", 4, 0.05), encoding="utf-8")
    page = tmp_path / "gallery.md"
    assert main(["gallery", str(problem), "-o", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| slide \|.*$", text, re.M)
    assert row.endswith("| ok |")
    for name in re.findall(r"\]\((.*?)\)", text):
        assert (tmp_path / name).stat().st_size < 1_000_000
    assert len(list((tmp_path / "gallery").iterdir())) == 2


def test_a_report_holds_what_was_given(tmp_path: Path) -> None:
    problem, path = problem_of(HEPTAGON), tmp_path / "plan.npz"
    plan_of(HEPTAGON).save(str(path))
    text = build_report(problem, [str(path)], HEPTAGON.read_text(encoding="utf-8"), chart=chart())
    for words in ("plan.npz", "ok: ", "v3-finger1", "[fingers.1]", "what verify says"):
        assert words in text
    assert len(text) < 5e6


def test_a_report_says_which_contact_torques_lose_at_once(tmp_path: Path) -> None:
    path = tmp_path / "torques.csv"
    path.write_text("t,tau1,tau2\n0,3,2.1\n0.5,3,2.1\n", encoding="utf-8")
    text = build_report(problem_of(HEPTAGON), [str(path)], chart=chart())
    assert "FAILED: c_n of v5-finger2 falls to " in text and "what verify says" in text
