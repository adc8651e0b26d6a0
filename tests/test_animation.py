"""The quick animation and the figure of paths show what happened."""

import dataclasses
import io

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from envs.animation import Painter, write_gif
from envs.path_plot import path_figure, save_path_plot
from envs.rendering import COLOURS
from tests.test_rendering import ARRIVE, START, STOP, make


def near(image, place, colour, radius=4):
    """Whether a pixel of ``colour`` lies within ``radius`` pixels of ``place``."""
    x, y = (round(c) for c in place)
    patch = np.asarray(image.convert("RGB"))[y - radius : y + radius + 1, x - radius : x + radius + 1]
    return bool((np.abs(patch / 255 - to_rgb(colour)).max(-1) < 0.05).any())


def pixel(painter, point):
    """Where a point lies in the image."""
    ((x, y),) = painter._at(np.asarray(point)[None, :2])
    return x / 2, y / 2


@pytest.mark.parametrize(("n", "d", "rows"), [(3, 2, 1), (1, 2, 40), (9, 2, 1), (3, 3, 1)])
def test_robots_are_where_they_were(n, d, rows):
    world = make(n, d, rows=rows)
    painter = Painter(world)
    for k in (0, 20, 39):
        image = painter.frame(k)
        assert image.size[1] == 300
        for i in range(min(n, 8)):
            others = np.delete(world.position[k, :, :2], i, axis=0)
            if not len(others) or np.linalg.norm(others - world.position[k, i, :2], axis=-1).min() > 0.2:
                assert near(image, pixel(painter, world.position[k, i]), COLOURS[i])


def test_charging_is_hatched_and_ringed():
    world = make(1)
    calm = dataclasses.replace(world, charging=np.zeros_like(world.charging))
    k = (START + STOP) // 2
    assert world.charging[k, 0]
    loud, quiet = (np.asarray(Painter(w).frame(k)).astype(int) for w in (world, calm))
    differ = np.abs(loud - quiet).max(-1) > 60
    column = Painter(world).wide // 2
    assert differ[:, :column].any()  # the ring around the robot
    assert differ[:, column:].any()  # the hatch of its battery
    before = [np.asarray(Painter(w).frame(ARRIVE - 2)) for w in (world, calm)]
    assert (before[0] == before[1]).all()


def test_battery_bars_show_the_energy():
    world = make(1)
    low, high = (dataclasses.replace(world, energy=np.full_like(world.energy, e)) for e in (0.2, 0.9))
    low, high = (dataclasses.replace(w, charging=np.zeros_like(w.charging)) for w in (low, high))
    blue = np.asarray(to_rgb(COLOURS[0])) * 255

    def filled(w):
        image = np.asarray(Painter(w).frame(0)).astype(float)[:, Painter(w).wide // 2 :]
        return (np.abs(image - blue).max(-1) < 12).sum()

    assert filled(high) > 2 * filled(low) > 0


@pytest.mark.parametrize(("steps", "frames", "count"), [(40, 10, 10), (40, 100, 40), (40, 1, 1), (1, 5, 1)])
def test_gif(tmp_path, steps, frames, count):
    world = make(steps=40)
    world = dataclasses.replace(
        world,
        **{name: getattr(world, name)[:steps] for name in ("position", "energy", "charging", "slot", "coverage_cost")},
    )
    stream = io.BytesIO()
    for target in (stream, tmp_path / "a.gif"):
        write_gif(world, target, max_frames=frames)
        with Image.open(target) as picture:
            assert picture.n_frames == count
            assert picture.size == Painter(world).frame(0).size
    assert (tmp_path / "a.gif").read_bytes() == stream.getvalue()  # the same twice


def test_places_that_are_not_finite_or_far_away_are_left_out(tmp_path):
    world = make(3)
    position = world.position.copy()
    position[5:, 0] = np.nan
    position[10:, 1] = 1e6
    energy = world.energy.copy()
    energy[5:, 0] = np.nan
    broken = dataclasses.replace(world, position=position, energy=energy)
    write_gif(broken, tmp_path / "a.gif", max_frames=12)
    assert save_path_plot(broken, tmp_path / "b" / "paths.png").stat().st_size > 5000
    everywhere = dataclasses.replace(world, position=np.full_like(position, np.nan))
    write_gif(everywhere, tmp_path / "a.gif", max_frames=3)
    path_figure(everywhere)


@pytest.mark.parametrize(("n", "d"), [(3, 2), (9, 2), (2, 3)])
def test_paths(tmp_path, n, d):
    world = make(n, d)
    with Image.open(save_path_plot(world, tmp_path / "paths.png")) as picture:
        image = np.asarray(picture.convert("RGB")) / 255
    for i in range(min(n, 8)):
        assert (np.abs(image - to_rgb(COLOURS[i])).max(-1) < 0.02).sum() > 30
    figure = path_figure(world)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    general = ["charging", "start", "end", "charging station"] + ["charging range", "density φ"] * (d == 2)
    assert labels == [*(f"robot {i + 1}" for i in range(n)), *general]
    (axes,) = figure.axes
    paths = [line for line in axes.lines if line.get_linestyle() != "None"]
    assert len(paths) == n
    for i, line in enumerate(paths):
        drawn = line.get_data() if d == 2 else line.get_data_3d()
        np.testing.assert_array_equal(np.stack(drawn, axis=-1), world.position[:, i])
    assert sorted(text.get_text() for text in axes.texts) == sorted(2 * [str(i + 1) for i in range(n)])
    if d == 2:
        thick = [c for c in axes.collections if c.get_linewidths()[0] > 4]
        gained = world.charging[1:].sum(axis=0)
        assert [len(c.get_segments()) for c in thick] == gained[gained > 0].tolist()
    save_path_plot(world, tmp_path / "paths.svg")
    save_path_plot(world, tmp_path / "paths.pdf")
