"""Pictures are written, readable and not blank; phases, Voronoi cells and moving means are right."""

import dataclasses
import sys
import warnings

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from envs.rendering import (
    Trajectory,
    draw_world,
    moving_mean,
    save_battery_plot,
    save_snapshots,
    save_training_curve,
    survey_charge_survey,
    voronoi_cells,
)
from envs.video import save_gif

ARRIVE, START, STOP, LEAVE = 12, 14, 26, 27  # robot 0 is in range in [ARRIVE, LEAVE), gains in [START, STOP)


def make(n=3, d=2, steps=40, rows=1):
    """Robots circle at home; robot 0 visits station 0 once."""
    rng = np.random.default_rng(0)
    axis = (np.arange(8) + 0.5) / 4 - 1
    points = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), -1).reshape(-1, d)
    weight = np.exp(-((points - 0.4) ** 2).sum(1) / 0.2)
    stations = np.zeros((2, d))
    stations[:, 0] = -0.9, 0.9
    time = np.arange(steps)[:, None]
    position = np.repeat(rng.uniform(-0.5, 0.5, (1, n, d)), steps, axis=0)
    position[..., 0] += 0.1 * np.sin(time / 5)
    charging = np.zeros((steps, n), dtype=bool)
    charging[START:STOP, 0] = True
    position[ARRIVE:LEAVE, 0] = stations[0]
    return Trajectory(
        position=position,
        energy=0.5 + 0.4 * np.cos(time / 10 + np.arange(n)),
        charging=charging,
        slot=np.tile(np.arange(n) % 2, (steps, 1)),
        density=np.repeat(weight[None] / weight.sum(), rows, axis=0),
        points=points,
        stations=stations,
        slots=stations * 0.95,
        arena=np.tile([-1.0, 1.0], (d, 1)),
        energy_min=0.2,
        energy_max=1.0,
        charge_radius=0.15,
        safety_distance=0.1,
        dt=0.1,
        coverage_cost=np.linspace(1.0, 0.5, steps),
    )


def check_picture(path, least=(500, 300)):
    with Image.open(path) as image:
        assert image.width >= least[0]
        assert image.height >= least[1]
        assert len(image.convert("RGB").getcolors(maxcolors=1 << 24)) > 5


def texts(ax):
    return {t.get_text() for t in ax.texts}


@pytest.fixture
def canvas():
    def build(d=2):
        figure = Figure(figsize=(6, 4), dpi=60)
        return figure, figure.add_axes((0.1, 0.1, 0.5, 0.8), projection="3d" if d == 3 else None)

    return build


@pytest.mark.parametrize("d", [2, 3])
def test_snapshots(tmp_path, d):
    paths = save_snapshots(make(d=d), tmp_path / "new" / "folder")
    assert [p.name for p in paths] == ["surveying_1.png", "charging.png", "surveying_2.png"]
    for path in paths:
        check_picture(path)
    assert len({path.read_bytes() for path in paths}) == 3


@pytest.mark.parametrize(("d", "rows"), [(2, 40), (3, 1)])
def test_gif(tmp_path, d, rows):
    path = save_gif(make(d=d, rows=rows), tmp_path / "a" / "mission.gif", max_frames=3, fps=10)
    check_picture(path)
    with Image.open(path) as image:
        assert image.n_frames == 3
        assert image.info["duration"] == 100
        assert image.info["loop"] == 0
    assert path.stat().st_size < 3 * 5e6 / 150  # 150 such frames stay below 5 MB


def test_gif_of_one_sample(tmp_path):
    trajectory = make()
    short = {f: getattr(trajectory, f)[:1] for f in ("position", "energy", "charging", "slot", "coverage_cost")}
    check_picture(save_gif(dataclasses.replace(trajectory, **short), tmp_path / "short.gif"))
    check_picture(save_battery_plot(dataclasses.replace(trajectory, **short), tmp_path / "short.png"))


def test_battery_plot(tmp_path):
    check_picture(save_battery_plot(make(n=16), tmp_path / "a" / "battery.png"))


def test_battery_plot_as_vector(tmp_path):
    assert save_battery_plot(make(n=1), tmp_path / "battery.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("count", [0, 1, 5, 5000])
def test_training_curve(tmp_path, count):
    rng = np.random.default_rng(0)
    episodes = {"return": rng.normal(size=count), "violations": rng.poisson(2, size=count)}
    episodes["return"][2:3] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_picture(save_training_curve(episodes, tmp_path / "a" / "curve.png"))


@pytest.mark.parametrize("n", [0, 1, 4, 9])
def test_moving_mean(n):
    values = np.random.default_rng(n).normal(size=n)
    expected = [values[max(0, k - 3) : k + 1].mean() for k in range(n)]
    np.testing.assert_allclose(moving_mean(values, 4), expected, atol=1e-12)


def test_moving_mean_leaves_nan_out():
    np.testing.assert_allclose(moving_mean(np.array([np.nan, 2.0, np.nan, 4.0]), 2), [np.nan, 2.0, 2.0, 4.0])


def test_phases_of_a_known_charge():
    before, middle, after = survey_charge_survey(make())
    assert before < ARRIVE
    assert middle == (START + STOP) // 2
    assert after >= LEAVE


def test_phases_prefer_the_charge_with_most_surveying():
    trajectory = make(n=2, steps=90)
    trajectory.position[:ARRIVE, 1] = trajectory.stations[1]  # robot 1 does not survey before robot 0's first charge
    trajectory.position[60:70, 0] = trajectory.stations[0]
    trajectory.charging[62:67, 0] = True  # shorter than the first charge, but everyone surveys before and after it
    before, middle, after = survey_charge_survey(trajectory)
    assert LEAVE <= before < 60
    assert middle == 64
    assert after >= 70


def test_phases_without_a_charge_or_without_before_and_after():
    trajectory = make()
    trajectory.charging[:] = True
    before, middle, after = survey_charge_survey(trajectory)
    assert (before, after) == (0, 39)
    assert 0 < middle < 39
    trajectory.charging[:] = False
    assert survey_charge_survey(trajectory) == (0, 20, 39)


@pytest.mark.parametrize(("n", "d"), [(1, 2), (16, 2), (3, 3)])
def test_world_numbers_every_robot(canvas, n, d):
    figure, ax = canvas(d)
    draw_world(ax, make(n=n, d=d), 20)
    figure.canvas.draw()
    assert texts(ax) == {str(i + 1) for i in range(n)}


@pytest.mark.parametrize("d", [2, 3])
def test_nan_robots_are_left_out(tmp_path, canvas, d):
    trajectory = make(d=d)
    trajectory.position[10:, 1] = np.nan
    trajectory.position[25, 2, 0] = np.inf
    trajectory.energy[5:, 2] = np.nan
    trajectory.slot[:, 0] = -1
    figure, ax = canvas(d)
    draw_world(ax, trajectory, 20)
    figure.canvas.draw()
    assert texts(ax) == {"1", "3"}
    assert len(survey_charge_survey(trajectory)) == 3
    check_picture(save_battery_plot(trajectory, tmp_path / "b.png"))
    trajectory.position[:] = np.nan
    trajectory.energy[:] = np.nan
    check_picture(save_gif(trajectory, tmp_path / "n.gif", max_frames=1))


def test_view_ignores_a_runaway_robot(canvas):
    trajectory = make()
    trajectory.position[30:, 2] = 1e6
    _, ax = canvas()
    draw_world(ax, trajectory, 35)
    assert max(np.abs([*ax.get_xlim(), *ax.get_ylim()])) < 2.0
    assert texts(ax) == {"1", "2"}


@pytest.mark.parametrize("arena", [[[-4.0, 4.0], [-1.0, 1.0]], [[-1.0, 1.0], [-4.0, 4.0]]])
def test_long_arena_keeps_its_shape_and_the_picture_some_height(canvas, arena):
    trajectory = make()
    trajectory.arena = np.array(arena)
    figure, ax = canvas()
    draw_world(ax, trajectory, 0)
    figure.canvas.draw()
    assert ax.get_aspect() == 1.0
    assert 0.7 < np.ptp(ax.get_xlim()) / np.ptp(ax.get_ylim()) < 1.41


def test_density_image_follows_the_row_major_grid(canvas):
    trajectory = make()
    _, ax = canvas()
    draw_world(ax, trajectory, 0)
    shown = np.asarray(ax.images[0].get_array())
    row, column = np.unravel_index(shown.argmax(), shown.shape)
    peak = trajectory.points[trajectory.density[0].argmax()]
    assert ax.images[0].get_extent() == pytest.approx([-1, 1, -1, 1])
    np.testing.assert_allclose([(column + 0.5) / 4 - 1, (row + 0.5) / 4 - 1], peak)
    assert shown.sum() * 0.25**2 == pytest.approx(1.0)


def area(polygon):
    x, y = polygon.T
    return 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) if len(polygon) else 0.0


@pytest.mark.parametrize("n", [1, 2, 7])
@pytest.mark.parametrize("spread", [0.9, 3.0])
def test_voronoi_cells_match_the_nearest_robot(n, spread):
    arena = np.array([[-1.0, 1.0], [-0.5, 2.0]])
    position = np.random.default_rng(n).uniform(-spread, spread, (n, 2))
    grid = np.stack(np.meshgrid(*[np.linspace(*a, 301)[:-1] + np.ptp(a) / 600 for a in arena]), -1).reshape(-1, 2)
    nearest = np.linalg.norm(grid[:, None] - position, axis=-1).argmin(1)
    shares = np.bincount(nearest, minlength=n) / len(grid)
    areas = np.array([area(cell) for cell in voronoi_cells(position, arena)])
    np.testing.assert_allclose(areas / 5.0, shares, atol=0.005)
    assert areas.sum() == pytest.approx(5.0)


def test_coinciding_robots_share_a_cell():
    cells = voronoi_cells(np.zeros((2, 2)), np.array([[-1.0, 1.0], [-1.0, 1.0]]))
    assert [area(cell) for cell in cells] == pytest.approx([4.0, 4.0])


def test_global_matplotlib_state_is_untouched(tmp_path):
    import matplotlib

    had_pyplot, before = "matplotlib.pyplot" in sys.modules, dict(matplotlib.rcParams.copy())
    save_training_curve({"return": np.ones(3), "violations": np.ones(3)}, tmp_path / "c.png")
    assert ("matplotlib.pyplot" in sys.modules) == had_pyplot
    assert dict(matplotlib.rcParams.copy()) == before
