"""A GIF of one world drawn directly into pixels: about fifty times faster than :func:`envs.video.save_gif`.

For TensorBoard and for long rollouts; worlds in three dimensions are seen from above. The colours, numbers and hatches
are those of :mod:`envs.rendering`.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from envs.rendering import BOLT, COLOURS, DENSITY_MAP, GREEN, GREY, INK, TRAIL, Trajectory, voronoi_cells

SCALE = 2  # drawn larger and scaled down: smooth edges
PALETTE = 48  # colours of a GIF


class Painter:
    """Draws samples of a trajectory as images of one size.

    Args:
        trajectory: the history.
        height: pixels at zoom 1; the width follows from the arena, and a column for the batteries.
        zoom: factor of both, lines and letters included, >= 1.
    """

    def __init__(self, trajectory: Trajectory, height: int = 300, zoom: int = 1) -> None:
        self.trajectory, self.scale = trajectory, SCALE * zoom
        low, high = np.asarray(trajectory.arena, dtype=float)[:2].T
        room = np.concatenate([trajectory.stations, trajectory.slots])[:, :2]
        border = 0.12 * (high - low).max()
        self.low, self.high = np.minimum(low, room.min(0)) - border, np.maximum(high, room.max(0)) + border
        self.unit = self.scale * (height - 24) / (self.high - self.low)[1]  # pixels per metre
        self.wide = round((self.high - self.low)[0] * self.unit)
        self.size = (self.wide + 120 * self.scale, height * self.scale)
        face = Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf")  # that of the figures
        self.font, self.small = (ImageFont.truetype(face, size * self.scale) for size in (10, 8))
        self.ground = self._ground(0) if len(trajectory.density) == 1 else None

    def frame(self, k: int) -> Image.Image:
        """Sample ``k`` as an RGB image."""
        world = self.trajectory
        image = (self._ground(k) if self.ground is None else self.ground).copy()
        draw = ImageDraw.Draw(image)
        here = world.position[k, :, :2].astype(float)
        shown = np.isfinite(here).all(-1) & (here >= self.low).all(-1) & (here <= self.high).all(-1)
        if len(world.arena) == 2:
            for cell in voronoi_cells(here[shown], world.arena):
                if len(cell) > 2:
                    draw.line([*self._at(cell), *self._at(cell[:1])], fill="#555555", width=self.scale)
        for i in np.flatnonzero(shown):
            self._robot(draw, k, i, here[i])
        self._batteries(draw, k)
        title = f"t = {k * world.dt:.1f} s   J = {world.coverage_cost[k]:.3g} m²"
        draw.text((6 * self.scale, 4 * self.scale), title, fill=INK, font=self.font)
        return image.reduce(SCALE)

    def _robot(self, draw: ImageDraw.ImageDraw, k: int, i: int, here: np.ndarray) -> None:
        world, colour, charging = self.trajectory, COLOURS[i % len(COLOURS)], bool(self.trajectory.charging[k, i])
        path = world.position[max(0, k - TRAIL) : k + 1, i, :2].astype(float)
        if np.isfinite(path).all() and len(path) > 1:
            draw.line(self._at(np.clip(path, self.low, self.high)), fill=colour, width=2 * self.scale)
        ((x, y),) = self._at(here[None])
        half = world.safety_distance / 2 * self.unit
        draw.ellipse((x - half, y - half, x + half, y + half), outline=colour, width=self.scale)
        r = 8 * self.scale
        ring = {"outline": INK, "width": 3 * self.scale} if charging else {"outline": "white", "width": self.scale}
        draw.ellipse((x - r, y - r, x + r, y + r), fill=colour, **ring)
        draw.text((x, y), str(i + 1), fill=_ink(colour), font=self.small, anchor="mm")

    def _batteries(self, draw: ImageDraw.ImageDraw, k: int) -> None:
        """One bar per robot, from a quarter of the range below E_min to E_max; hatched while charging."""
        world, n = self.trajectory, self.trajectory.energy.shape[1]
        left, right, top = self.wide + 22 * self.scale, self.wide + 102 * self.scale, 40 * self.scale
        step = min(26 * self.scale, (self.size[1] - top - 32 * self.scale) // n)
        start = world.energy_min - 0.25 * (world.energy_max - world.energy_min)

        def at(energy: float) -> float:
            return left + (right - left) * (energy - start) / (world.energy_max - start)

        draw.text((left, 22 * self.scale), "battery energy", fill=INK, font=self.small)
        for i, energy in enumerate(world.energy[k].astype(float)):
            y0, y1, colour = top + i * step, top + i * step + 0.7 * step, COLOURS[i % len(COLOURS)]
            draw.rectangle((left, y0, right, y1), fill="white", outline=GREY)
            if np.isfinite(energy):
                end = at(float(np.clip(energy, start, world.energy_max)))
                draw.rectangle((left, y0, end, y1), fill=colour)
                for x in np.arange(left, end - 3 * self.scale, 6 * self.scale) if world.charging[k, i] else ():
                    draw.line((x, y1, x + 3 * self.scale, y0), fill=_ink(colour), width=self.scale)
            draw.text((left - 5 * self.scale, (y0 + y1) / 2), str(i + 1), fill=INK, font=self.small, anchor="rm")
        x, end = at(world.energy_min), top + n * step
        draw.line((x, top - 3 * self.scale, x, end), fill=INK, width=self.scale)
        draw.text((x, end), "min", fill=INK, font=self.small, anchor="ma")
        draw.text((left, end + 14 * self.scale), "hatched: charging", fill=INK, font=self.small)

    def _ground(self, k: int) -> Image.Image:
        """Density, arena, stations and slots: what stays where it is."""
        world = self.trajectory
        image = Image.new("RGB", self.size, "white")
        draw = ImageDraw.Draw(image)
        (corner, other) = self._at(np.asarray(world.arena, dtype=float)[:2].T)  # lower left, upper right
        if len(world.arena) == 2:
            sides = [len(np.unique(np.round(column, 6))) for column in world.points.T]
            grid = world.density[min(k, len(world.density) - 1)].reshape(sides) / world.density.max()
            box = (round(other[0] - corner[0]), round(corner[1] - other[1]))
            field = Image.fromarray(grid.T[::-1].astype(np.float32)).resize(box, Image.Resampling.BICUBIC)
            colours = (DENSITY_MAP(np.asarray(field))[..., :3] * 255).astype(np.uint8)  # bands: small files
            image.paste(Image.fromarray(colours), (round(corner[0]), round(other[1])))
        draw.rectangle((corner[0], other[1], other[0], corner[1]), outline=GREY, width=self.scale)
        for x, y in self._at(world.stations[:, :2]):
            r = world.charge_radius * self.unit
            draw.ellipse((x - r, y - r, x + r, y + r), outline=GREEN, width=2 * self.scale)
        for x, y in self._at(world.slots[:, :2]):
            r = 6 * self.scale
            draw.ellipse((x - r, y - r, x + r, y + r), fill="white", outline=INK, width=self.scale)
        for x, y in self._at(world.stations[:, :2]):
            draw.polygon([(x + 5 * self.scale * a, y - 5 * self.scale * b) for a, b in BOLT], fill=INK)
        return image

    def _at(self, points: np.ndarray) -> list[tuple[float, float]]:
        """Pixels of points ``(K, 2)`` in m."""
        x, y = (np.asarray(points, dtype=float) - self.low).T * self.unit
        return list(zip(x.tolist(), (self.size[1] - y).tolist(), strict=True))


def _ink(colour: str) -> str:
    """Black or white, whichever reads better on the colour."""
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return "black" if 0.21 * red + 0.72 * green + 0.07 * blue > 115 else "white"


def write_gif(trajectory: Trajectory, target: str | Path | BinaryIO, *, max_frames: int = 100, fps: float = 12) -> None:
    """Write an animation of at most ``max_frames`` samples, evenly spread; one frame is in memory at a time.

    Args:
        trajectory: the history.
        target: a file or a binary stream.
        max_frames: frames at most, >= 1.
        fps: frames per second.
    """
    painter, last = Painter(trajectory), len(trajectory.position) - 1
    chosen = np.unique(np.linspace(0, last, max(1, min(last + 1, max_frames))).round().astype(int))
    sample = np.concatenate([np.asarray(painter.frame(int(k))) for k in chosen[[0, len(chosen) // 2, -1]]])
    palette = Image.fromarray(sample).quantize(PALETTE)  # one for all frames: no flicker

    def frames() -> Iterator[Image.Image]:
        for k in chosen:
            yield painter.frame(int(k)).quantize(palette=palette, dither=Image.Dither.NONE)

    stream = frames()
    options = {"append_images": stream, "duration": round(1000 / fps), "loop": 0, "optimize": False}
    next(stream).save(target, format="GIF", save_all=True, **options)
