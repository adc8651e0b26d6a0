"""Where the robots of one world went: a figure of their paths over a whole rollout."""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from envs.rendering import BOLT, COLOURS, GREEN, INK, LINES, MARKERS, STYLE, Trajectory, draw_density


@rc_context(STYLE)
def path_figure(trajectory: Trajectory, dpi: int = 180) -> Figure:
    """Paths of all robots, thick where they gained energy, from an empty marker at the start to a filled one at the end.

    Colour is backed up by line style, marker and number. A third dimension is drawn as such.
    """
    world, flat = trajectory, len(trajectory.arena) == 2
    figure = FigureCanvasAgg(Figure(figsize=(6.4, 4.4), dpi=dpi, layout="constrained")).figure
    ax = figure.add_subplot(projection=None if flat else "3d")
    collection = LineCollection if flat else Line3DCollection
    if flat:
        draw_density(ax, world, len(world.density) - 1)
        for centre in world.stations:
            ax.add_patch(Circle(centre, world.charge_radius, fill=False, ec=GREEN, ls=(0, (4, 2)), zorder=2))
    ax.plot(*world.stations.T, marker=BOLT, ms=11, color=INK, mec="white", mew=0.6, ls="none", zorder=6)
    key = []
    for i in range(world.position.shape[1]):
        colour, style, marker = COLOURS[i % 8], LINES[i % 4], MARKERS[i // 8 % 4]
        path = world.position[:, i].astype(float)
        whole = np.isfinite(path).all(axis=-1)
        segments, drawn = np.stack([path[:-1], path[1:]], axis=1), whole[:-1] & whole[1:]
        charging = world.charging[1:, i] & drawn
        ax.add_collection(collection(segments[drawn], colors=colour, linewidths=1.1, linestyles=style, zorder=4))
        if charging.any():
            ax.add_collection(collection(segments[charging], colors=colour, linewidths=4.5, alpha=0.45, zorder=4))
        for k, face in zip(np.flatnonzero(whole)[[0, -1]] if whole.any() else (), ("white", colour), strict=False):
            ax.plot(*path[k, :, None], marker=marker, ms=9, mfc=face, mec=colour, mew=1.4, ls="none", zorder=5)
        key.append(Line2D([], [], color=colour, ls=style, lw=1.4, marker=marker, ms=8, label=f"robot {i + 1}"))
    key.append(Line2D([], [], color=INK, lw=4.5, alpha=0.45, label="charging"))
    key.append(Line2D([], [], color=INK, marker="o", mfc="white", ms=8, ls="none", label="start"))
    key.append(Line2D([], [], color=INK, marker="o", ms=8, ls="none", label="end"))
    for name, limits in zip("xyz", world.arena, strict=False):
        pad = 0.06 * float(np.ptp(world.arena, axis=1).max())
        ax.set(**{f"{name}lim": (limits[0] - pad, limits[1] + pad), f"{name}label": f"{name} (m)"})
    ax.set_aspect("equal")
    length = (len(world.position) - 1) * world.dt
    ax.set_title(f"{length:.0f} s, mean coverage cost J = {np.nanmean(world.coverage_cost):.3g}", fontsize=10)
    figure.legend(handles=key, loc="outside right center", frameon=False, fontsize=8.5)
    return figure


def save_path_plot(trajectory: Trajectory, path: str | Path) -> Path:
    """Write :func:`path_figure` to a file of any of matplotlib's formats; returns the path."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    path_figure(trajectory).savefig(path)
    return Path(path)
