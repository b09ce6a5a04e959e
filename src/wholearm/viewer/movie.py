"""Movies of a motion: hand and object with contact forces, force margins and torques."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from PIL import Image, ImageColor

from ..common.arrays import Array, interpolate
from ..common.document import fixed
from ..common.errors import InputError, require_number
from ..common.files import write_whole
from ..common.sharing import exclusive
from ..figures import plots, style
from ..problem.definition import Problem
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from ..verification.newton_euler import locate

FRAMES = 25  # frames in a second of the movie
ACCENT, GHOST = "#D55E00", "#bbbbbb"
"""Colours of torques and the cursor, and of the replay in the background."""


def _prepare_scene(
    axes: Axes, scene: Scene, trajectory: Trajectory, ghost: Trajectory | None
) -> Callable[[float], list[Artist]]:
    """Function that draws hand, object and forces on axes at an instant."""
    contacts = [locate(scene, name, trajectory.z) for name in trajectory.contacts]
    points, normals, tangents = (  # (n, m, 2)
        np.stack([getattr(contact, name)[:, :2] for contact in contacts], axis=1)
        for name in ("point", "normal", "tangent")
    )
    forces = trajectory.c_n[..., None] * normals + trajectory.c_t[..., None] * tangents
    low, high = plots.measure_box(scene, trajectory.z[:: max(1, len(trajectory.t) // 200)])
    size = float((high - low).max())
    styles = style.choose_styles(trajectory.contacts)
    colours = [styles[name].colour for name in trajectory.contacts]
    # Square roots, so that small forces are visible beside large ones.
    strengths = np.hypot(*forces.T).T[..., None]
    strongest = float(np.nanmax(strengths, initial=0.0)) or 1.0
    scales = np.sqrt(np.maximum(strengths, 1e-12 * strongest) * strongest)
    arrows = 0.3 * size * forces / scales
    presses = np.asarray(np.isfinite(forces).all(axis=2))
    # Friction cones are longer than the arrows in them.
    reach = 1.15 * np.maximum(np.hypot(*arrows.T).T, 0.03 * size)[..., None]
    edges = np.array([[contact.friction] for contact in contacts]) * tangents
    sides = [points + reach * (normals + sign * edges) for sign in (1, -1)]
    cones = np.stack([points, *sides], axis=2)  # (n, m, 3, 2)
    corners = np.vstack([low, high, cones[presses].reshape(-1, 2)])
    low, high = corners.min(axis=0) - 0.05 * size, corners.max(axis=0) + 0.05 * size
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal")
    axes.set_axis_off()
    plots.draw_palm(axes, scene, low[0], high[0])
    scale, vertices = plots.measure_scale(axes), scene.polygon.vertices
    shifts = plots.choose_numbers(scale * vertices)
    numbers = vertices[[*shifts]] + np.reshape([*shifts.values()], (-1, 2)) / scale

    def draw(t: float) -> list[Artist]:
        """All artists at an instant, in the order of drawing."""
        artists = list[Artist]()
        row = max(0, int(np.searchsorted(trajectory.t, t, side="right")) - 1)
        z = interpolate(t, trajectory.t, trajectory.z)
        if ghost is not None:
            ghost_z = interpolate(t, ghost.t, ghost.z)
            artists += plots.draw_bodies(axes, scene, ghost_z, ec=GHOST, fc="none")
        artists += plots.draw_bodies(axes, scene, z)
        c, s = math.cos(z[2]), math.sin(z[2])
        places = z[:2] + numbers @ np.array([[c, s], [-s, c]])
        look: Any = {"ha": "center", "va": "center", "color": "#555555"}
        look["fontsize"] = plots.NUMBER
        for k, (x, y) in zip(shifts, places.tolist(), strict=True):
            artists.append(axes.text(x, y, str(k), **look))
        pressing = np.flatnonzero(presses[row]).tolist()
        for k in pressing:
            artists.append(axes.add_artist(Polygon(cones[row, k], fc=colours[k], alpha=0.2, lw=0)))
        for k in pressing:
            arrow = _trace_arrow(points[row, k], arrows[row, k], 0.018 * size)
            artists.append(style.add_line(axes, arrow, color=colours[k], lw=1.8))
        for k in pressing:
            dot: Any = {"marker": "o", "ms": 5.5, "mfc": colours[k], "mec": "white"}
            artists.append(style.add_line(axes, points[row, [k]], **dot))
        for finger, torque in zip(scene.fingers, trajectory.tau[row].tolist(), strict=True):
            # An arc of three quarters of a circle is the torque limit.
            angle = 1.5 * math.pi * torque / finger.torque_limit
            arc = _trace_arc(np.asarray(finger.base), angle, 0.05 * size)
            # Whole at the edge, too.
            artists.append(style.add_line(axes, arc, color=ACCENT, lw=1.6, clip_on=False))
        return artists + plots.draw_joints(axes, scene)

    return draw


def _trace_arrow(start: Array, vector: Array, head: float) -> Array:
    """An arrow as one line, shape (5, 2)."""
    length = float(np.hypot(*vector)) or 1.0
    axis = min(head, length) * vector / length
    side, end = 0.5 * np.array([axis[1], -axis[0]]), start + vector
    return np.array([start, end, end - axis + side, end, end - axis - side])


def _trace_arc(base: Array, angle: float, radius: float) -> Array:
    """An arc about a joint from below it, with an arrow head."""
    angles = -np.pi / 2 + np.linspace(0.0, angle, 24)
    tail = angles[-1] - np.sign(angle) * min(0.5, abs(angle))
    angles = np.append(angles, [tail, angles[-1], tail])
    radii = radius * np.append(np.ones(24), [1.2, 1.0, 0.8])
    return np.asarray(base + radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))


@exclusive
def write_movie(
    path: str | os.PathLike[str],
    problem: Problem,
    trajectory: Trajectory,
    ghost: Trajectory | None = None,
    speed: float = 0.1,
    resolution: int = 90,
    progress: Callable[[str], None] = lambda text: None,
) -> None:
    """Write a motion as GIF, or as MP4 by ffmpeg, in pictures of 8 inches width.

    Parameters
    ----------
    ghost       a replay, drawn behind
    speed       over real time
    resolution  dots per inch

    InputError if `speed` is not positive, or makes the movie longer than two minutes, there is no
    ffmpeg for an MP4, or the file cannot be written.
    """
    speed = require_number(speed, "--speed", positive=True)
    duration, max_frames = trajectory.duration, 120 * FRAMES
    count = math.ceil(duration / speed * FRAMES) + 1
    if count > max_frames:
        least = duration * FRAMES / max_frames
        text = f"{speed:g} given; from {least:.2g} on, movies are short enough"
        raise InputError("", "--speed", text)
    times = np.linspace(0.0, duration, max(2, count))

    def draw() -> Iterator[Array]:
        """Pictures one by one, shape (height, width, 4), uint8."""
        with style.open_figure(8.0, 7.4, dpi=resolution) as figure:
            canvas: Any = figure.canvas
            axes = figure.add_axes((0.02, 0.47, 0.96, 0.49))
            draw_scene = _prepare_scene(axes, problem.scene, trajectory, ghost)
            margins = figure.add_axes((0.09, 0.225, 0.74, 0.215))
            torques = figure.add_axes((0.09, 0.06, 0.74, 0.14), sharex=margins)
            styles = style.choose_styles(trajectory.contacts)
            plots.draw_margins(margins, trajectory, problem.epsilon, styles)
            plots.draw_torques(torques, trajectory.torque, problem.scene.torque_limit)
            for axes, room in ((margins, 0.235), (torques, 0.14)):
                plots.draw_phases(axes, trajectory.phase_starts, labels=axes is margins)
                style.list_contacts(axes, 72 * 7.4 * room, 8.0)
            margins.set_ylabel(f"margin {style.unit_of(margins)}")
            margins.tick_params(labelbottom=False)
            label = rf"$\tau$ {style.unit_of(torques)}"
            torques.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, duration))
            figure.align_ylabels([margins, torques])
            canvas.draw()
            background = canvas.copy_from_bbox(figure.bbox)
            form = fixed(min(duration, 0.9))
            look: Any = {"va": "top", "fontsize": 10.5, "fontweight": "bold", "parse_math": False}
            for k, t in enumerate(times.tolist(), start=1):
                canvas.restore_region(background)
                artists = draw_scene(t)
                for axes in (margins, torques):
                    cursor: Any = {"color": ACCENT, "lw": 1.3}
                    cursor["transform"] = axes.get_xaxis_transform()
                    artists.append(style.add_line(axes, np.array([[t, 0.0], [t, 1.0]]), **cursor))
                text = f"{problem.name}   t = {t:{form}} s"
                artists.append(figure.text(0.02, 0.975, text, **look))
                for artist in artists:
                    figure.draw_artist(artist)
                    artist.remove()
                progress(f"frame {k} of {len(times)}")
                yield np.array(canvas.buffer_rgba())

    pictures = draw()
    if str(path).lower().endswith(".gif"):
        images = [Image.fromarray(picture[..., :3]) for picture in pictures]
        # One palette for all frames, so that constant parts are stored once.
        palette = _choose_palette(images)
        frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        options: Any = {"format": "GIF", "save_all": True, "loop": 0, "optimize": False}
        options |= {"append_images": frames[1:], "duration": 1000 // FRAMES}
        write_whole(path, lambda stream: frames[0].save(stream, **options))
    else:
        content = _encode(pictures, path)
        write_whole(path, lambda stream: stream.write(content))


def _choose_palette(images: Sequence[Image.Image]) -> Image.Image:
    """A palette for a movie with the exact colours of all elements.

    The others are the colours of four pictures, mostly tints of these.
    """
    colours = [*style.PALETTE, style.BAND, style.LOW, style.LOST, style.INK, style.GRID]
    colours += ["#ffffff", style.BODY, ACCENT, GHOST, *chain(*style.FINGERS)]
    exact = np.array([ImageColor.getrgb(colour) for colour in colours])
    samples = [images[k] for k in np.linspace(0, len(images) - 1, 4).astype(int)]
    strip = Image.new("RGB", (samples[0].width, 4 * samples[0].height))
    for k, image in enumerate(samples):
        strip.paste(image, (0, k * image.height))
    tints = np.reshape(strip.quantize(96).getpalette() or [], (-1, 3))[:96]
    # Pillow looks up colours in cells of 4 levels: a similar tint could replace an exact colour.
    distinct = np.abs(tints[:, None] - exact).max(axis=2).min(axis=1) >= 12
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.vstack([exact, tints[distinct]]).ravel().tolist())
    return palette


def _encode(pictures: Iterator[Array], path: str | os.PathLike[str]) -> bytes:
    """Content of an MP4 file of pictures."""
    program = shutil.which("ffmpeg")
    if program is None:
        text = "MP4 needs ffmpeg, which is not there; .gif and .html do not"
        raise InputError(str(path), "", text)
    first = next(pictures)
    height, width = first.shape[:2]
    raw = ["-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{width}x{height}", "-r", str(FRAMES)]
    output = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    with tempfile.TemporaryDirectory() as folder:
        target = os.path.join(folder, "movie.mp4")
        command = [program, "-y", "-loglevel", "error", *raw, "-i", "-", *output, target]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
            assert process.stdin is not None
            process.stdin.write(first.tobytes())
            for picture in pictures:
                process.stdin.write(picture.tobytes())
            process.stdin.close()
        if process.returncode:
            raise InputError(str(path), "", f"ffmpeg ended with status {process.returncode}")
        with open(target, "rb") as stream:
            return stream.read()
