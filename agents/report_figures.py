"""The report's figures: learning curves of J and the filter's rates, one row of panels per world."""

import textwrap
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.report_statistics import RATES, Curve, Groups, Row
from envs.rendering import COLOURS, INK, LINES, STYLE

DOTS = ((0, (1, 1)), (0, (5, 1, 1, 1)))  # methods without a curve


def _look(index: int) -> dict:
    """Colour and line style of a method; equal colours differ in style."""
    return {"color": COLOURS[index % len(COLOURS)], "ls": LINES[(index + index // len(COLOURS)) % len(LINES)]}


def _draw(ax: Axes, curves: list[Curve], looks: dict[str, dict], seconds: bool) -> None:
    """IQM and interval of each curve against frames or seconds."""
    for curve in curves:
        x, look, band = curve.seconds if seconds else curve.frames, looks[curve.method], curve.estimate
        ax.plot(x, band.value, lw=1.6, label=curve.method, **look)
        if np.isfinite(band.low).any():
            ax.fill_between(x, band.low, band.high, color=look["color"], alpha=0.2, lw=0)
    ax.set_xlabel("wall time (s)" if seconds else "frames (world-steps)")
    ax.grid(True)
    ax.locator_params(axis="x", nbins=5)


def _save(figure: Figure, path: Path) -> None:
    """As PNG and SVG, with one legend below all panels."""
    found = {}
    for ax in figure.axes:
        found |= {label: line for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    width, height = figure.get_size_inches()
    labels = [textwrap.fill(label, round(11 * width)) for label in found]
    columns = 2 if max(map(len, labels)) < 5 * width else 1
    figure.set_size_inches(width, height + 0.2 * (1 + sum(label.count("\n") + 1 for label in labels) / columns))
    place = {"loc": "outside lower center", "ncols": columns}
    figure.legend(found.values(), labels, frameon=False, handlelength=3.5, **place)
    for suffix in (".png", ".svg"):
        figure.savefig(path.with_suffix(suffix), metadata={"Date": None} if suffix == ".svg" else None)


def _figure(rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(3.6 * columns, 2.6 * rows), dpi=180, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


@rc_context(STYLE)
def save_figures(groups: Groups, rows: list[Row], curves: list[Curve], marked: list[str], folder: Path) -> list[str]:
    """Writes ``curves`` (J against frames and against wall time) and ``rates`` (of the filter), each as PNG and SVG.

    Args:
        groups: the runs.
        rows: the report's numbers.
        curves: from :func:`agents.report_statistics.compute_curves`.
        marked: methods without a curve whose IQM of J is drawn as a horizontal line.
        folder: where to write.

    Returns:
        Names of the figures written; a figure without a curve is not.
    """
    methods = list(dict.fromkeys(curve.method for curve in curves))
    looks = {name: _look(index) for index, name in enumerate(methods)}
    marks = [name for name in marked if name not in groups.learned]
    written = []
    cost = [curve for curve in curves if curve.quantity == "coverage_cost"]
    if cost:
        worlds = [world for world in groups.worlds if any(curve.world == world for curve in cost)]
        figure, panels = _figure(len(worlds), 2)
        for pair, world in zip(panels, worlds, strict=True):
            for ax, seconds in zip(pair, (False, True), strict=True):
                _draw(ax, [curve for curve in cost if curve.world == world], looks, seconds)
                for row in (row for row in rows if row.world == world and row.quantity == "coverage_cost.iqm"):
                    if row.method in marks:
                        ax.axhline(row.value, color=INK, lw=1.2, ls=DOTS[marks.index(row.method) % 2], label=row.method)
                ax.set_title(world, fontsize=10)
            pair[0].set_ylabel("coverage cost J (m²)")
        _save(figure, folder / "curves")
        written.append("curves")
    rates = [curve for curve in curves if curve.quantity != "coverage_cost"]
    if rates:
        shown = [name for name in RATES if any(curve.quantity == f"{name}_rate" for curve in rates)]
        worlds = [world for world in groups.worlds if any(curve.world == world for curve in rates)]
        figure, panels = _figure(len(worlds), len(shown))
        for line, world in zip(panels, worlds, strict=True):
            for ax, name in zip(line, shown, strict=True):
                own = [curve for curve in rates if (curve.world, curve.quantity) == (world, f"{name}_rate")]
                _draw(ax, own, looks, seconds=False)
                ax.set_title(f"{world}: {name}", fontsize=10)
            line[0].set_ylabel("share of robot-steps")
        _save(figure, folder / "rates")
        written.append("rates")
    return written
