"""Where the robots of one world went: a figure of their paths over a whole rollout."""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from envs.rendering import BOLT, COLOURS, DENSITY_MAP, GREEN, INK, LINES, STYLE, Trajectory, draw_density, robot_style


@rc_context(STYLE)
def path_figure(trajectory: Trajectory, dpi: int = 180) -> Figure:
    """Paths of all robots, thick where they gained energy, from an empty marker at the start to a filled one at the end.

    Colour is backed up by line style, marker and number. A third dimension is drawn as such.
    """
    world, flat = trajectory, len(trajectory.arena) == 2
    figure = FigureCanvasAgg(Figure(figsize=(6.4, 4.4), dpi=dpi, layout="constrained" if flat else None)).figure
    # Layout engines do not see a 3-D view's z label.
    ax = figure.add_subplot() if flat else figure.add_axes((-0.02, 0.04, 0.72, 0.88), projection="3d")
    collection = LineCollection if flat else Line3DCollection
    if flat:
        draw_density(ax, world, len(world.density) - 1)
        (x0, x1), (y0, y1) = world.arena
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec="#555555", lw=1.1, zorder=2))
        for centre in world.stations:
            ax.add_patch(Circle(centre, world.charge_radius, fill=False, ec=GREEN, ls=(0, (4, 2)), zorder=2))
    ax.plot(*world.stations.T, marker=BOLT, ms=11, color=INK, mec="white", mew=0.6, ls="none", zorder=6)
    if not flat:
        ax.computed_zorder = False  # keeps each number on its own disc
    key = []
    for i in range(world.position.shape[1]):
        (colour, marker, ink), line = robot_style(i), LINES[(i + i // len(COLOURS)) % 4]
        path = world.position[:, i].astype(float)
        whole = np.isfinite(path).all(axis=-1)
        # One line, broken where the robot has no place: dashes of single steps would run together.
        ax.plot(*np.where(whole[:, None], path, np.nan).T, color=colour, lw=1.2, ls=line, zorder=4)
        segments, charging = np.stack([path[:-1], path[1:]], axis=1), world.charging[1:, i] & whole[:-1] & whole[1:]
        if charging.any():
            ax.add_collection(collection(segments[charging], colors=colour, linewidths=4.5, alpha=0.45, zorder=4))
        ends = np.flatnonzero(whole)[[0, -1]] if whole.any() else ()
        for k, face, number in zip(ends, ("white", colour), (INK, ink), strict=False):
            if (np.abs(path[k] - world.arena.mean(axis=1)) <= np.ptp(world.arena, axis=1)).all():  # no runaway robot
                level = 7 + 0.02 * i
                ax.plot(*path[k, :, None], marker=marker, ms=11, mfc=face, mec=colour, mew=1.4, ls="none", zorder=level)
                font = {"size": 7.5, "fontweight": "bold", "ha": "center", "va": "center_baseline"}
                ax.text(*path[k], str(i + 1), color=number, zorder=level + 0.01, clip_on=flat, **font)
        key.append(Line2D([], [], color=colour, ls=line, lw=1.4, label=f"robot {i + 1}"))
    key.append(Line2D([], [], color=INK, lw=4.5, alpha=0.45, label="charging"))
    key.append(Line2D([], [], color=INK, marker="o", mfc="white", ms=8, ls="none", label="start"))
    key.append(Line2D([], [], color=INK, marker="o", ms=8, ls="none", label="end"))
    key.append(Line2D([], [], marker=BOLT, ms=9, color=INK, mew=0, ls="none", label="charging station"))
    if flat:
        key.append(Line2D([], [], color=GREEN, ls=(0, (4, 2)), lw=1, label="charging range"))
        last = " at the end" if len(world.density) > 1 else ""
        key.append(Patch(fc=DENSITY_MAP(0.6), label=f"density φ{last}"))
    for name, limits in zip("xyz", world.arena, strict=False):
        pad = 0.06 * float(np.ptp(world.arena, axis=1).max())
        ax.set(**{f"{name}lim": (limits[0] - pad, limits[1] + pad), f"{name}label": f"{name} (m)"})
    ax.locator_params(nbins=5)
    ax.set_aspect("equal")
    length = (len(world.position) - 1) * world.dt
    ax.set_title(f"{length:.0f} s, mean coverage cost J = {np.nanmean(world.coverage_cost):.3g} m²", fontsize=10)
    figure.legend(handles=key, loc="outside right center" if flat else "center right", frameon=False, fontsize=8.5)
    return figure


def save_path_plot(trajectory: Trajectory, path: str | Path) -> Path:
    """Write :func:`path_figure` to a file of any of matplotlib's formats; returns the path."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    path_figure(trajectory).savefig(path)
    return Path(path)
