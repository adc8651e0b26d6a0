"""Pictures of a mission: the world at one instant, battery traces and training curves.

NumPy arrays in, files out, on matplotlib's Agg canvas without pyplot state. Robots are numbered from 1. Colour
(Okabe-Ito) is always backed up by a number, shape, line style or hatch: no picture depends on colour vision.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle
from mpl_toolkits.mplot3d.art3d import Line3DCollection

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000", "#F0E442")
MARKERS = ("o", "s", "D", "h")  # one shape per round of the eight colours
LINES, HATCHES = ("-", "--", "-.", (0, (3, 1, 1, 1, 1, 1))), ("////", "\\\\\\\\", "xxxx", "....")
BOLT = ((0.25, 1.0), (-0.6, -0.15), (-0.05, -0.15), (-0.25, -1.0), (0.6, 0.15), (0.05, 0.15))  # station marker
# A straight ramp from white to a muted tone is nearly uniform in lightness; few levels keep animations small.
DENSITY_MAP = LinearSegmentedColormap.from_list("density", ["#ffffff", "#8f88a6"], N=16)
INK, GREY, GREEN = "#222222", "#777777", "#006b4f"
TRAIL, FONT = 20, 8.5  # steps, pt
STYLE = {"font.size": 9, "pdf.fonttype": 42, "svg.fonttype": "none", "axes.spines.top": False}
STYLE |= {"axes.spines.right": False, "axes.axisbelow": True, "grid.color": "#dddddd"}


@dataclass
class Trajectory:
    """One world's history: T samples of N robots in d = 2 or 3 dimensions."""

    position: np.ndarray  # (T, N, d) m
    energy: np.ndarray  # (T, N)
    charging: np.ndarray  # (T, N) bool: the robot gained energy in the step that led to this sample
    slot: np.ndarray  # (T, N) int: index into slots, negative for none
    density: np.ndarray  # (T, Q), or (1, Q) when constant: weights of the quadrature points, summing to 1
    points: np.ndarray  # (Q, d) m, quadrature points on a regular grid, row-major over the axes
    stations: np.ndarray  # (M, d) m
    slots: np.ndarray  # (S, d) m
    arena: np.ndarray  # (d, 2) m, low and high per axis
    energy_min: float  # lowest allowed energy
    energy_max: float  # energy of a full battery
    charge_radius: float  # m, radius around a station within which a battery gains
    safety_distance: float  # m, smallest allowed distance of two robots
    dt: float  # s
    coverage_cost: np.ndarray  # (T,) J


def voronoi_cells(position: np.ndarray, arena: np.ndarray) -> list[np.ndarray]:
    """Voronoi cells in the arena (2, 2) of finite positions (N, 2), all in m: N polygons (V, 2), V = 0 if empty."""
    (x0, x1), (y0, y1) = arena
    cells = [np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=float) for _ in position]
    for i, j in np.ndindex(len(position), len(position)):
        normal = position[j] - position[i]
        if normal @ normal > 0.0 and len(cells[i]):  # robots at the same place share one cell
            # Clip to the half-plane nearer to robot i than to robot j, where `outside` <= 0.
            outside = (cells[i] - 0.5 * (position[i] + position[j])) @ normal
            kept = []
            for a, b, fa, fb in zip(cells[i], np.roll(cells[i], -1, 0), outside, np.roll(outside, -1), strict=True):
                kept += [a] if fa <= 0.0 else []
                kept += [a + (b - a) * fa / (fa - fb)] if fa * fb < 0.0 else []
            cells[i] = np.reshape(kept, (-1, 2))
    return cells


def _view(trajectory: Trajectory) -> np.ndarray:
    """Axis limits (d, 2) in m, the same for every frame: the arena and what lies close around it."""
    arena = np.asarray(trajectory.arena, dtype=float)
    span = np.ptp(arena, axis=1)
    things = np.concatenate([*trajectory.position, trajectory.stations, trajectory.slots, arena.T])
    # One runaway robot must not shrink the world to a dot: show at most a quarter of the arena on either side.
    things = np.clip(things, arena[:, 0] - 0.25 * span, arena[:, 1] + 0.25 * span)
    view = np.stack([np.fmin.reduce(things), np.fmax.reduce(things)], axis=1) + 0.06 * span.max() * np.array([-1, 1])
    # The column beside a flat view needs some height: keep its aspect ratio within 1.4 : 1.
    extra = np.maximum(np.ptp(view, axis=1).max() / 1.4 - np.ptp(view, axis=1), 0.0) / 2 * (len(arena) == 2)
    return view + np.stack([-extra, extra], axis=1)


def robot_style(i: int) -> tuple[str, str, str]:
    """Colour, marker and black or white (whichever reads better on the colour) of robot i."""
    colour = COLOURS[i % len(COLOURS)]
    return colour, MARKERS[i // 8 % 4], "black" if np.dot(to_rgb(colour), (0.21, 0.72, 0.07)) > 0.45 else "white"


def draw_density(ax: Axes, trajectory: Trajectory, k: int) -> AxesImage:
    """Draws the density of sample k as an image, on one scale for all samples."""
    low, span = trajectory.points.min(axis=0), np.maximum(np.ptp(trajectory.points, axis=0), 1e-9)
    shape = [len(np.unique(column)) for column in np.round((trajectory.points - low) / span, 6).T]
    (w, h), (x, y) = span / np.maximum(np.subtract(shape, 1), 1), low
    weights = trajectory.density[min(k, len(trajectory.density) - 1)].reshape(shape)
    # One scale for all frames, so that a moving density does not pulse.
    scale = {"vmin": 0.0, "vmax": float(trajectory.density.max()) / (w * h), "cmap": DENSITY_MAP}
    extent = (x - w / 2, x + span[0] + w / 2, y - h / 2, y + span[1] + h / 2)
    return ax.imshow(weights.T / (w * h), origin="lower", extent=extent, interpolation="bicubic", **scale)


def _draw_density_scale(ax: Axes, image: AxesImage) -> None:
    """Colour bar of the density in the column to the right."""
    bar = ax.inset_axes((1.13, 0.05, 0.38, 0.025))
    ax.figure.colorbar(image, cax=bar, orientation="horizontal", ticks=[0.0, image.get_clim()[1]], format="%.2g")
    bar.set_title("density φ (1/m²)", fontsize=FONT, loc="left", pad=4)
    bar.tick_params(labelsize=FONT, length=2)


def _draw_batteries(panel: Axes, trajectory: Trajectory, k: int) -> None:
    """One bar per robot: outlined up to E_max, filled to the current level, hatched while charging."""
    low, high, n = trajectory.energy_min, trajectory.energy_max, trajectory.energy.shape[1]
    left = low - 0.25 * (high - low)  # a level below E_min, a violation, stays visible
    for i, energy in enumerate(trajectory.energy[k]):
        (colour, _, ink), hatch = robot_style(i), "////" if trajectory.charging[k, i] else None
        panel.add_patch(Rectangle((left, i - 0.36), high - left, 0.72, fc="white", ec=GREY, lw=0.8))
        if np.isfinite([energy, *trajectory.position[k, i]]).all():
            level = float(np.clip(energy, left, high)) - left
            panel.add_patch(Rectangle((left, i - 0.36), level, 0.72, fc=colour, ec=ink, hatch=hatch, lw=0))
            if hatch:
                panel.plot(high + 0.09 * (high - low), i, marker=BOLT, ms=min(9, 110 / n), color=INK, clip_on=False)
    panel.axvline(low, color=INK, lw=1.2, ls=(0, (3, 1.5)))
    panel.set(xlim=(left, high), ylim=(n - 0.4, -0.6))
    panel.set_xticks([low, high], [f"$E_{{\\min}}$\n{low:.3g}", f"$E_{{\\max}}$\n{high:.3g}"])
    panel.set_yticks(range(n), [str(i + 1) for i in range(n)])
    panel.set_title("battery energy of robot", fontsize=FONT, loc="left", pad=4)
    panel.tick_params(length=0, pad=3, labelsize=8)
    panel.spines[:].set_visible(False)


def draw_world(ax: Axes, trajectory: Trajectory, k: int) -> None:
    """Draws sample k of a world; a column to the right holds the battery bars, the legend and the density scale.

    Args:
        ax: Empty Axes, 3-D for d = 3. The column takes about half the Axes' width beyond their right edge.
        trajectory: The history. Robots whose position is not finite, or far outside the arena, are left out.
        k: Sample index, 0 <= k < T.
    """
    view, here, flat = _view(trajectory), trajectory.position[k].astype(float), len(trajectory.arena) == 2
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 17), np.linspace(0, np.pi, 9))
    ball = trajectory.charge_radius * np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    if flat:
        _draw_density_scale(ax, draw_density(ax, trajectory, k))
        for cell in voronoi_cells(here[np.isfinite(here).all(axis=1)], trajectory.arena):
            ax.add_patch(Polygon(cell, fill=False, ec="#555555", lw=1.1, zorder=2)) if len(cell) > 2 else None
    for centre in trajectory.stations:
        if flat:
            ax.add_patch(Circle(centre, trajectory.charge_radius, fc="#009e7329", ec=GREEN, ls=(0, (4, 2)), zorder=3))
        else:
            ax.plot_wireframe(*(ball + centre[:, None, None]), color=GREEN, lw=0.5, alpha=0.45)
            ax.computed_zorder = False  # keeps each number on its own disc
    loose = {"ls": "none", "clip_on": flat, "zorder": 4}
    ax.plot(*trajectory.slots.T, marker="o", ms=11, mfc="white", mec=INK, mew=0.8, **loose)
    ax.plot(*trajectory.stations.T, marker=BOLT, ms=8, color=INK, mew=0.0, **loose)
    for i in np.flatnonzero(((here >= view[:, 0]) & (here <= view[:, 1])).all(axis=1)):
        (colour, marker, ink), slot, charging = robot_style(i), trajectory.slot[k, i], trajectory.charging[k, i]
        path = trajectory.position[max(0, k - TRAIL) : k + 1, i]
        segments = np.stack([path[:-1], path[1:]], axis=1)
        fade = np.linspace(0.1, 1.0, len(segments))[whole := np.isfinite(segments).all(axis=(1, 2))]
        if whole.any():  # thicker and more opaque towards the present
            trail = {"colors": [(*to_rgb(colour), a) for a in fade], "linewidths": 0.8 + 2.2 * fade, "zorder": 5}
            ax.add_collection((LineCollection if flat else Line3DCollection)(segments[whole], **trail))
        if flat:  # two of these circles overlap when a pair is closer than allowed
            ax.add_patch(Circle(here[i], trajectory.safety_distance / 2, fill=False, ec=colour, zorder=4))
        else:  # a line to the floor shows where the robot is in depth
            drop = np.stack([[*here[i, :2], view[2, 0]], here[i]])
            ax.plot(*drop.T, color=colour, lw=0.8, ls=":", marker="x", ms=4, markevery=[0])
        if charging and 0 <= slot < len(trajectory.slots):
            ax.plot(*np.stack([here[i], trajectory.slots[slot]]).T, color=INK, lw=1.6, ls=":", zorder=6)
        look = {"mfc": colour, "mec": INK if charging else "white", "mew": 2.0 if charging else 1.0, "ms": 14}
        ax.plot(*here[i, :, None], marker=marker, **look, **loose | {"zorder": 7 + 0.02 * i})
        font = {"color": ink, "fontsize": FONT, "fontweight": "bold", "ha": "center", "va": "center_baseline"}
        ax.text(*here[i], str(i + 1), zorder=7.01 + 0.02 * i, **font)
    for name, limits in zip("xyz", view, strict=False):
        ax.set(**{f"{name}lim": limits, f"{name}label": f"{name} (m)"})
    ax.locator_params(nbins=5)
    ax.set_aspect("equal")
    ax.set_title(f"t = {k * trajectory.dt:.1f} s,  coverage cost J = {trajectory.coverage_cost[k]:.3g} m²", fontsize=10)
    # The column keeps its order in low Axes: density scale and legend have their size, the batteries take the rest.
    inches = ax.get_position(original=True).height * ax.figure.get_figheight()
    bottom = min((0.62 if flat else 0.1) / inches, 0.3)
    bars = min(bottom + (1.6 if flat else 1.45) / inches, 0.8)
    right = 1.13 if flat else 1.22  # of the z label
    _draw_batteries(ax.inset_axes((right, bars, 0.38, 0.96 - bars)), trajectory, k)
    disc = {"marker": "o", "ms": 9, "mfc": "#bbbbbb"}
    key = [
        Line2D([], [], **disc, mec="white", color=GREY, lw=2, label=f"robot, last {TRAIL * trajectory.dt:.3g} s"),
        Line2D([], [], **disc, mec=INK, mew=2, color=INK, ls=":", label="charging, way to slot"),
        Line2D([], [], marker="o", ms=9, mfc="white", mew=0.8, color=INK, ls="none", label="charging slot"),
        Line2D([], [], marker=BOLT, ms=8, color=INK, mew=0, ls="none", label="charging station"),
        Line2D([], [], color=GREEN, ls=(0, (4, 2)) if flat else "-", lw=1, label="charging range"),
        Line2D([], [], color="#555555", lw=1.1, label="Voronoi boundary"),
        Line2D([], [], marker="o", ms=12, mfc="none", color=COLOURS[0], ls="none", label="half safety distance"),
    ]
    floor = [Line2D([], [], color=GREY, lw=0.8, ls=":", marker="x", ms=4, label="point below on the floor")]
    handles = key if flat else key[:5] + floor
    ax.legend(handles=handles, fontsize=FONT, loc=(right - 0.07, bottom), labelspacing=0.3, frameon=False)


def _runs(flag: np.ndarray) -> np.ndarray:
    """First index and one past the last index (R, 2) of every run of True in a flag (T,)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], flag, [0]]))).reshape(-1, 2)


def survey_charge_survey(trajectory: Trajectory) -> tuple[int, int, int]:
    """Picks three samples that tell the story of one charge: before it, in its middle and after it.

    A robot surveys while neither charging nor in range of a station. The charge with most surveying robots before and
    after it is taken, the longest of equals. Without any, the indices are those of the first, middle and last sample.
    """
    position, charging, steps = trajectory.position, trajectory.charging.astype(bool), len(trajectory.position)
    gap = np.linalg.norm(position[:, :, None] - trajectory.stations, axis=-1).min(axis=-1, initial=np.inf)
    present = np.isfinite(position).all(axis=-1)
    # A full battery may toggle between gain and no gain: a visit lasts until the robot leaves the station.
    visiting = present & (charging | (gap <= trajectory.charge_radius))
    surveying = (present & ~visiting).sum(axis=1)

    def best(low: int, high: int, otherwise: int) -> int:
        most = np.flatnonzero(surveying[low:high] == surveying[low:high].max(initial=0))
        return low + int(most[len(most) // 2]) if len(most) else otherwise

    options = []
    for i in range(position.shape[1]):
        visits = [(a, b) for a, b in _runs(visiting[:, i]) if charging[a:b, i].any()]
        for (_, since), (a, b), (until, _) in zip([(0, 0), *visits], visits, [*visits[1:], (steps, 0)], strict=False):
            gains = a + np.flatnonzero(charging[a:b, i])
            before, after = best(since, a, 0), best(b, until, steps - 1)
            score = ((since < a) + (b < until), surveying[before] + surveying[after], len(gains))
            options.append((score, (before, int(gains[len(gains) // 2]), after)))
    return max(options, key=lambda option: option[0])[1] if options else (0, steps // 2, steps - 1)


def world_figure(trajectory: Trajectory, dpi: int) -> tuple[Figure, Axes]:
    """A figure with Axes for `draw_world`, sized to the arena; its fixed margins keep animations still."""
    sides = np.ptp(_view(trajectory), axis=1)
    width, height = 4.4 * sides / sides.max() if len(sides) == 2 else (4.4, 4.4)
    full = (width + 3.2, height + 0.95)  # inches
    figure = FigureCanvasAgg(Figure(figsize=full, dpi=dpi)).figure
    left = 0.75 if len(sides) == 2 else 0.35  # a 3-D view has its z label to the right
    place = (left / full[0], 0.55 / full[1], width / full[0], height / full[1])
    return figure, figure.add_axes(place, projection=None if len(sides) == 2 else "3d")


@rc_context(STYLE)
def save_snapshots(trajectory: Trajectory, folder: str | Path, *, suffix: str = "png") -> list[Path]:
    """Writes surveying_1, charging and surveying_2 (the paper's Figures 5 to 7); returns the paths."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    paths = [Path(folder) / f"{name}.{suffix}" for name in ("surveying_1", "charging", "surveying_2")]
    for path, k in zip(paths, survey_charge_survey(trajectory), strict=True):
        figure, ax = world_figure(trajectory, dpi=180)
        draw_world(ax, trajectory, k)
        figure.savefig(path)
    return paths


@rc_context(STYLE)
def save_battery_plot(trajectory: Trajectory, path: str | Path) -> Path:
    """Plots energy over time per robot, a chart of everyone's charging intervals and the coverage cost; returns the path."""
    (steps, n), dt, energy = trajectory.energy.shape, trajectory.dt, trajectory.energy
    figure = Figure(figsize=(7.0, 4.7 + 0.19 * n), dpi=180, layout="constrained")
    top, rows, cost = figure.subplots(3, 1, sharex=True, height_ratios=(2.6, 0.35 + 0.19 * n, 1.0))
    for i in range(n):
        colour, marker, ink = robot_style(i)
        variant = (i + i // len(COLOURS)) % 4  # shifts by one per round, so that equal colours differ in style
        top.plot(np.arange(steps) * dt, energy[:, i], color=colour, ls=LINES[variant], lw=1.5)
        # The robot's number sits on its line, staggered so that neighbours do not cover each other.
        for s in np.unique(((np.arange(3) + (i + 0.5) / n) / 3 * (steps - 1)).astype(int)):
            if np.isfinite(energy[s, i]):
                top.plot(s * dt, energy[s, i], marker=marker, mec=colour, mfc="white", ms=10.5, mew=1.3, zorder=3)
                top.text(s * dt, energy[s, i], str(i + 1), size=8, ha="center", va="center_baseline", zorder=4)
        # A gain at sample k happened during the step from k - 1 to k.
        bars = [(max(a - 1, 0) * dt, (b - max(a, 1)) * dt) for a, b in _runs(trajectory.charging[:, i])]
        rows.broken_barh(bars, (i - 0.36, 0.72), fc=colour, ec=ink, lw=0, hatch=HATCHES[variant])
    for level, name in ((trajectory.energy_min, "min"), (trajectory.energy_max, "max")):
        top.axhline(level, color=INK, lw=1.0, ls=(0, (6, 3)), zorder=1)
        top.text(1.01, level, f"$E_{{\\{name}}}$ = {level:.3g}", va="center", transform=top.get_yaxis_transform())
    top.set(ylabel="battery energy E\n(battery units)")
    cost.plot(np.arange(steps) * dt, trajectory.coverage_cost, color=INK, lw=0.8)
    cost.set(xlabel="time (s)", ylabel="coverage\ncost J (m²)")
    rows.set(ylabel="charging\nrobot", xlim=(0.0, (steps - 1) * dt or 1.0), ylim=(n - 0.4, -0.6))
    rows.set_yticks(range(n), [str(i + 1) for i in range(n)])
    figure.align_ylabels()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return Path(path)


def moving_mean(values: np.ndarray, window: int = 100) -> np.ndarray:
    """Mean (n,) of the last `window` values up to each one, of fewer at the start; NaNs are left out."""
    finite = np.isfinite(values)
    sums = np.stack([np.where(finite, values, 0.0), finite]).cumsum(axis=1)
    sums[:, window:] -= sums[:, :-window].copy()
    return np.where(sums[1] > 0, sums[0] / np.maximum(sums[1], 1), np.nan)


@rc_context(STYLE)
def save_training_curve(episodes: Mapping[str, np.ndarray], path: str | Path) -> Path:
    """Plots "return" and "violations", each (n_episodes,) in order of completion (the paper's first Figure 5)."""
    figure = Figure(figsize=(6.4, 4.6), dpi=180, layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    for ax, name, colour in zip(panels, ("return", "violations"), COLOURS[::3], strict=False):
        values = np.asarray(episodes[name], dtype=float).ravel()
        n, number = len(values), np.arange(1, len(values) + 1)
        size, alpha = float(np.clip(60 / max(n, 1) ** 0.5, 1.0, 5.0)), 0.35 if n > 50 else 0.8
        # Rasterised: tens of thousands of points would make a vector file unusable.
        ax.plot(number, values, "o", color=colour, ms=size, mew=0, alpha=alpha, rasterized=True, label="one episode")
        ax.plot(number, moving_mean(values), color=INK, lw=1.6, label=f"mean of the last {max(1, min(100, n))}")
        ax.set(ylabel=f"{name} per episode", xlim=(0.5 - 0.02 * n, 1.02 * max(n, 1) + 0.5))
        ax.grid(True)
        ax.locator_params(axis="x", nbins=6, integer=True, min_n_ticks=1, steps=[1, 2, 5, 10])
        ax.legend(fontsize=8, markerscale=5 / size, ncols=2, frameon=False, loc="lower right", bbox_to_anchor=(1, 0.99))
        ax.text(0.5, 0.5, "" if n else "no episode yet", transform=ax.transAxes, ha="center", backgroundcolor="white")
    panels[1].set_xlabel("episode (in order of completion)")
    figure.align_ylabels()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return Path(path)
