"""Movies of a motion: hand and object with contact forces, force margins and torques."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from PIL import Image, ImageColor

from ..common.arrays import Array
from ..common.errors import InputError, require_number
from ..common.files import write_whole
from ..common.sharing import exclusive
from ..contacts.elemental import parse_contact
from ..figures.curves import draw_margins, draw_phases, draw_torques
from ..figures.snapshots import NUMBER, choose_numbers, place_vertices, trace_link, turn
from ..figures.style import (
    BAND,
    FINGERS,
    GRID,
    INK,
    LOST,
    LOW,
    PALETTE,
    PALM,
    STYLE,
    choose_styles,
    count_decimals,
    list_contacts,
    unit_of,
)
from ..problem.definition import Problem
from ..results.trajectory import Trajectory
from .motion_data import place_pushes

FRAMES = 25  # frames in a second of the movie
_MOST = 3000  # frames of a movie: two minutes
_SIZE = (8.0, 7.4)
RESOLUTION = 90  # dots per inch of a movie that is 8 inches wide
_REACH = 0.3  # length of the largest force's arrow, over the picture's
_BEYOND = 1.15  # length of friction cones over that of the arrows in them
BODY, TURNS, GHOST = "#fbf3df", "#D55E00", "#bbbbbb"
"""Colours of the object, of torques and the cursor, and of what is drawn behind."""
_TURN = 1.5 * math.pi  # angle of the arc of a torque at its limit


class _Scene:
    """Hand, object and forces on axes, moved from frame to frame."""

    def __init__(
        self, axes: Axes, problem: Problem, trajectory: Trajectory, ghost: Trajectory | None
    ) -> None:
        self._scene, self._trajectory, self._ghost = problem.scene, trajectory, ghost
        self._pushes = place_pushes(problem.scene, trajectory)
        strengths = np.hypot(*self._pushes.forces.T)
        self._strongest = float(np.nanmax(strengths, initial=0.0)) or 1.0
        low, high = _measure(self._scene, trajectory.z)
        self._size = float((high - low).max())
        fingers = [parse_contact(name, self._scene).finger for name in trajectory.contacts]
        self._friction = np.array([self._scene.friction.of(finger) for finger in fingers])
        low, high = self._cover_cones(low, high)
        pad = 0.05 * self._size
        axes.set(xlim=(low[0] - pad, high[0] + pad), ylim=(low[1] - pad, high[1] + pad))
        axes.set_aspect("equal")
        axes.set_axis_off()
        width, deep = high[0] - low[0] + 2 * pad, PALM * self._scene.scales.length
        axes.add_patch(Rectangle((low[0] - pad, -deep), width, deep, fc=INK))
        self._behind = [] if ghost is None else self._add_bodies(axes, GHOST, "none")
        self._bodies = self._add_bodies(axes, INK, None)
        styles = choose_styles(trajectory.contacts)
        colours = [styles[name].colour for name in trajectory.contacts]
        self._cones = [
            Polygon(np.zeros((3, 2)), fc=colour, alpha=0.2, lw=0, zorder=5) for colour in colours
        ]
        for cone in self._cones:
            axes.add_patch(cone)
        lines: Any = {"lw": 1.8, "solid_joinstyle": "miter", "zorder": 6}
        self._arrows = [axes.plot([], [], color=colour, **lines)[0] for colour in colours]
        self._dots = [
            axes.plot([], [], "o", ms=5.5, mfc=colour, mec="white", zorder=7)[0]
            for colour in colours
        ]
        self._arcs = [
            axes.plot([], [], color=TURNS, lw=1.6, zorder=8)[0] for _ in self._scene.fingers
        ]
        axes.apply_aspect()
        ends = axes.transData.transform([[0.0, 0.0], [1.0, 0.0]])
        scale = 72 / axes.figure.dpi * float(np.ptp(ends[:, 0]))
        vertices, look = self._scene.polygon.vertices, dict[str, Any](ha="center", va="center")
        shifts = choose_numbers(scale * vertices)
        self._places = np.array([vertices[k] + own / scale for k, own in shifts.items()])
        self._numbers = [
            axes.text(0.0, 0.0, str(k), fontsize=NUMBER, color="#555555", zorder=5, **look)
            for k in shifts
        ]
        for finger, (line, _) in zip(self._scene.fingers, FINGERS, strict=True):
            axes.plot(*np.asarray(finger.base), "o", ms=4, mfc="white", mec=line, zorder=8)

    @property
    def artists(self) -> list[Artist]:
        """What moves, in the order of drawing."""
        forces = [*self._cones, *self._arrows, *self._dots, *self._arcs]
        return [*self._behind, *self._bodies, *self._numbers, *forces]

    def _cover_cones(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Corners of a box, moved so far that arrows and their cones are inside, too."""
        points, normals, forces = self._pushes
        tangents = np.stack([normals[..., 1], -normals[..., 0]], axis=-1) * self._friction[:, None]
        strength = np.sqrt(np.hypot(forces[..., 0], forces[..., 1]) / self._strongest)
        reach = _BEYOND * _REACH * self._size * strength[..., None]
        ends = np.concatenate([points + reach * (normals + sign * tangents) for sign in (1, -1)])
        every = ends[np.isfinite(ends).all(axis=-1)]
        if not len(every):
            return low, high
        return np.minimum(low, every.min(axis=0)), np.maximum(high, every.max(axis=0))

    def _add_bodies(self, axes: Axes, ink: str, face: str | None) -> list[Polygon]:
        """Both links and the object."""
        none, bodies = np.zeros((3, 2)), []
        for _, own in FINGERS:
            bodies.append(Polygon(none, fc=face or own, ec=ink, lw=0.9, zorder=2))
        bodies.append(Polygon(none, fc=face or BODY, ec=ink, lw=1.1, zorder=4))
        for body in bodies:
            axes.add_patch(body)
        return bodies

    def move(self, t: float) -> None:
        """Put everything where it is at an instant."""
        own, row = self._trajectory, _find(self._trajectory.t, t)
        z = _blend(own.t, own.z, t)
        self._pose(self._bodies, z)
        if self._ghost is not None:
            self._pose(self._behind, _blend(self._ghost.t, self._ghost.z, t))
        for text, place in zip(self._numbers, turn(z, self._places), strict=True):
            text.set_position(place)
        self._push(row)
        for arc, finger, angle in zip(self._arcs, self._scene.fingers, own.tau[row], strict=True):
            swept = _TURN * float(angle) / finger.torque_limit
            arc.set_data(*_trace_arc(np.asarray(finger.base), swept, 0.05 * self._size).T)

    def _pose(self, bodies: list[Polygon], z: Array) -> None:
        for body, finger, angle in zip(bodies, self._scene.fingers, z[3:], strict=False):
            body.set_xy(trace_link(finger, float(angle)))
        bodies[-1].set_xy(place_vertices(self._scene, z))

    def _push(self, row: int) -> None:
        """Arrows and friction cones of the contacts that press at a sample."""
        points, normals, forces = (values[row] for values in self._pushes)
        # Square roots: small forces are to be seen beside large ones.
        scale = np.sqrt(np.maximum(np.hypot(*forces.T), 1e-12 * self._strongest) * self._strongest)
        arrows = forces * (_REACH * self._size / scale)[:, None]
        presses = np.isfinite(forces).all(axis=1)
        tangents = np.column_stack([normals[:, 1], -normals[:, 0]]) * self._friction[:, None]
        for k, own in enumerate(zip(self._cones, self._arrows, self._dots, strict=True)):
            for artist in own:
                artist.set_visible(bool(presses[k]))
            if not presses[k]:
                continue
            cone, arrow, dot = own
            reach = _BEYOND * max(float(np.hypot(*arrows[k])), 0.03 * self._size)
            sides = [points[k] + reach * (normals[k] + sign * tangents[k]) for sign in (1, -1)]
            cone.set_xy(np.array([points[k], *sides]))
            arrow.set_data(*_trace_arrow(points[k], arrows[k], 0.018 * self._size).T)
            dot.set_data(*points[k][:, None])


def _measure(scene: Any, z: Array) -> tuple[Array, Array]:
    """Corners of the box around a motion."""
    rows = z[:: max(1, len(z) // 200)]
    parts = [place_vertices(scene, row) for row in rows]
    parts += [
        trace_link(finger, float(row[3 + k]))
        for row in rows
        for k, finger in enumerate(scene.fingers)
    ]
    every = np.concatenate(parts)
    return every.min(axis=0), every.max(axis=0)


def _find(times: Array, t: float) -> int:
    """The last sample at or before `t`."""
    return max(0, int(np.searchsorted(times, t, side="right")) - 1)


def _blend(times: Array, values: Array, t: float) -> Array:
    """Values at `t`, straight between samples."""
    return np.array([np.interp(t, times, column) for column in values.T])


def _trace_arrow(start: Array, along: Array, head: float) -> Array:
    """An arrow as one line, shape (5, 2)."""
    length = float(np.hypot(*along)) or 1.0
    axis = min(head, length) * along / length
    across, end = 0.5 * np.array([axis[1], -axis[0]]), start + along
    return np.array([start, end, end - axis + across, end, end - axis - across])


def _trace_arc(base: Array, turn: float, radius: float) -> Array:
    """An arc about a joint from below it, with an arrow head."""
    angles = -np.pi / 2 + np.linspace(0.0, turn, 24)
    back = angles[-1] - np.sign(turn) * min(0.5, abs(turn))
    angles = np.append(angles, [back, angles[-1], back])
    radii = radius * np.append(np.ones(24), [1.2, 1.0, 0.8])
    return np.asarray(base + radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))


class Movie:
    """A motion as pictures.

    Parameters
    ----------
    ghost       a replay, drawn behind
    speed       how fast the motion passes, over real time
    resolution  dots per inch; it is 8 inches wide

    Raises
    ------
    InputError  if `speed` is not positive, or makes the movie longer than two minutes
    """

    def __init__(
        self,
        problem: Problem,
        trajectory: Trajectory,
        ghost: Trajectory | None = None,
        speed: float = 0.1,
        resolution: int = RESOLUTION,
    ) -> None:
        speed = require_number(speed, "--speed", positive=True)
        frames = math.ceil(trajectory.duration / speed * FRAMES) + 1
        if frames > _MOST:
            least = trajectory.duration * FRAMES / _MOST
            text = f"{speed:g} given; from {least:.2g} on, movies are short enough"
            raise InputError("", "--speed", text)
        self.times = np.linspace(0.0, trajectory.duration, max(2, frames))
        self._problem, self._trajectory, self._ghost = problem, trajectory, ghost
        self._resolution = resolution

    @exclusive
    def draw(self) -> Iterator[Array]:
        """Pictures one by one, shape (height, width, 4), uint8."""
        problem, own = self._problem, self._trajectory
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=_SIZE, dpi=self._resolution)
            canvas: Any = FigureCanvasAgg(figure)
            scene = _Scene(figure.add_axes((0.02, 0.47, 0.96, 0.49)), problem, own, self._ghost)
            margins = figure.add_axes((0.09, 0.225, 0.74, 0.215))
            torques = figure.add_axes((0.09, 0.06, 0.74, 0.14), sharex=margins)
            draw_margins(margins, own, problem.epsilon, choose_styles(own.contacts))
            draw_torques(torques, own.torque, problem.scene.torque_limit)
            for axes, room in ((margins, 0.235), (torques, 0.14)):
                draw_phases(axes, own.phase_starts, labels=axes is margins)
                list_contacts(axes, 72 * _SIZE[1] * room, 8.0)
            margins.set_ylabel(f"margin {unit_of(margins)}")
            margins.tick_params(labelbottom=False)
            label = rf"$\tau$ {unit_of(torques)}"
            torques.set(xlabel="time $t$ [s]", ylabel=label, xlim=(0.0, own.duration))
            figure.align_ylabels([margins, torques])
            cursors = [axes.axvline(0.0, color=TURNS, lw=1.3) for axes in (margins, torques)]
            clock = figure.text(0.02, 0.975, "", va="top", fontsize=10.5, fontweight="bold")
            moving = [*scene.artists, *cursors, clock]
            for artist in moving:
                artist.set_animated(True)
            canvas.draw()
            still = canvas.copy_from_bbox(figure.bbox)
            for t in self.times:
                canvas.restore_region(still)
                scene.move(t)
                for cursor in cursors:
                    cursor.set_xdata([t, t])
                time = f"{t:.{count_decimals(own.duration)}f} s"
                clock.set_text(f"{problem.name}   t = {time}".replace("$", r"\$"))
                for artist in moving:
                    figure.draw_artist(artist)
                yield np.array(canvas.buffer_rgba())


def write_movie(
    movie: Movie, path: str | os.PathLike[str], progress: Callable[[str], None] = lambda text: None
) -> None:
    """Write a movie as GIF, or as MP4 by ffmpeg.

    Raises
    ------
    InputError  if there is no ffmpeg for an MP4, or the file cannot be written
    """
    pictures = _count(movie, progress)
    if str(path).lower().endswith(".gif"):
        images = [Image.fromarray(picture[..., :3]) for picture in pictures]
        # One palette for all, so that what stays the same is stored once.
        palette = _choose_palette(images)
        frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        options: Any = {"format": "GIF", "save_all": True, "loop": 0, "optimize": False}
        options |= {"append_images": frames[1:], "duration": 1000 // FRAMES}
        write_whole(path, lambda stream: frames[0].save(stream, **options))
    else:
        content = _encode(pictures, path)
        write_whole(path, lambda stream: stream.write(content))


def _choose_palette(images: Sequence[Image.Image]) -> Image.Image:
    """A palette for all of a movie in which every colour that has a meaning is there as it is.

    The rest are the colours of four pictures, mostly tints of these.
    """
    own = [*PALETTE, BAND, LOW, LOST, INK, GRID, "#ffffff", BODY, TURNS, GHOST]
    own += [colour for pair in FINGERS for colour in pair]
    exact = [part for colour in own for part in ImageColor.getrgb(colour)]
    some = [images[k] for k in np.linspace(0, len(images) - 1, 4).astype(int)]
    strip = Image.new("RGB", (some[0].width, 4 * some[0].height))
    for k, image in enumerate(some):
        strip.paste(image, (0, k * image.height))
    tints = strip.quantize(96).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette(exact + tints[: 3 * 96])
    return palette


def _count(movie: Movie, progress: Callable[[str], None]) -> Iterator[Array]:
    for k, picture in enumerate(movie.draw(), start=1):
        progress(f"frame {k} of {len(movie.times)}")
        yield picture


def _encode(pictures: Iterator[Array], path: str | os.PathLike[str]) -> bytes:
    """An MP4 of pictures."""
    program = shutil.which("ffmpeg")
    if program is None:
        text = "MP4 needs ffmpeg, which is not there; .gif and .html do not"
        raise InputError(str(path), "", text)
    first = next(pictures)
    height, width = first.shape[:2]
    raw = ["-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{width}x{height}", "-r", str(FRAMES)]
    even = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    with tempfile.TemporaryDirectory() as folder:
        target = os.path.join(folder, "movie.mp4")
        command = [program, "-y", "-loglevel", "error", *raw, "-i", "-", *even, target]
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
