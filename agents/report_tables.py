"""The report's text: Markdown tables and CSV files from computed rows."""

import csv
import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from agents.report_runs import ReportError, Run
from agents.report_statistics import ALL, BOUND, RATES, Bootstrap, Curve, Groups, Row
from envs import keys

DASH = "–"
FIGURES = {"curves": "Learning curves", "rates": "The filter during training"}
EXPLANATION = """## How to read this

* J: coverage cost, m², mean over worlds and steps of the evaluation; lower is better. IQM: interquartile mean over the seeds
  (their mean for fewer than four). The seeds are the only replications.
* Brackets: {confidence:g} % percentile bootstrap intervals over the seeds ({resamples} resamples), each method and world
  resampled on its own; {dash} for fewer than two seeds. For few seeds such intervals are too narrow, down to one
  point (P(better) of methods that never overlap). "{all}" needs as many seeds of a method in every world.
* ratio: IQM of J over that of the reference. In "{all}" each world's J is divided by the reference's first; the intervals
  are stratified over the worlds.
* gap closed: (J of the reference - J) / (J of the reference - centroidal Voronoi cost), of IQMs. The centroidal Voronoi cost
  is that of robots that stand at the best places and never charge: the best of several descents of Lloyd's algorithm.
* P(better): probability that a run of the method has a lower J than a run of the other, ties half; 0.5 is no difference.
* charges: charging trips per robot in the evaluation. intervention: share of robot-steps whose action the filter changed;
  exploration noise included in training. hold, homing: share of robot-steps that the shield held or drove home. All are means
  over the seeds.
* Violations, infeasible (QPs) and outside (states that the filter does not vouch for) are robot-steps, summed over the
  seeds. Training counts exploration too; testing is the evaluation.
"""


def find_method(groups: Groups, name: str | None, setting: str) -> str | None:
    """The label that ``name`` means: the label itself, or the one label that contains it; ``auto`` finds coverage_cbf.

    Raises:
        ReportError: no label or several contain ``name``; the message lists them.
    """
    labels = sorted({method for _, method in groups.runs})
    if name is None or name in labels:
        return name
    if name == "auto":
        return next((label for label in labels if label.split(" ")[0] == "coverage_cbf"), None)
    found = [label for label in labels if name in label]
    if len(found) != 1:
        raise ReportError(f"{setting}={name} names {'several' if found else 'none'} of: {', '.join(found or labels)}.")
    return found[0]


def number(value: float, digits: int = 4) -> str:
    """Four significant digits, counts in full with separators; a dash for NaN."""
    if math.isnan(value):
        return DASH
    return f"{value:,.0f}" if float(value).is_integer() and abs(value) < 1e15 else f"{value:.{digits}g}"


def estimate(row: Row | None) -> str:
    """Value and interval; a dash stands for what there is not."""
    if row is None:
        return DASH
    interval = DASH if math.isnan(row.low) else f"[{row.low:.4g}, {row.high:.4g}]"
    return f"{number(row.value)} {interval}" if not math.isnan(row.value) else DASH


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table, its first column to the left, the others to the right."""
    header = list(header)
    lines = [
        header,
        ["---", *["---:"] * (len(header) - 1)],
        *([cell.replace("|", "\\|") for cell in row] for row in rows),
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


class Report:
    """Markdown of a report.

    Args:
        groups: the runs.
        rows: from :func:`agents.report_statistics.compute_rows`.
        reference: label of the reference, if any.
        against: label of a second method to compare with, if any.
    """

    def __init__(self, groups: Groups, rows: list[Row], reference: str | None, against: str | None) -> None:
        self.groups, self.reference = groups, reference
        self.compared = [*dict.fromkeys(name for name in (reference, against) if name)]
        self.rows = {(row.world, row.method, row.quantity, row.against): row for row in rows}

    def markdown(self, title: str, warnings: list[str], bootstrap: Bootstrap, figures: list[str]) -> str:
        """The whole text.

        Args:
            title: name of the sweep.
            warnings: what the reader must know, one line each.
            bootstrap: how the intervals were made.
            figures: names of the PNG files to show.
        """
        runs = [run for group in self.groups.runs.values() for run in group]
        parts = [
            f"# {title}\n",
            f"{len(runs)} runs, seeds {', '.join(map(str, sorted({run.seed for run in runs})))}.\n",
        ]
        if shared := sorted({entry for run in runs for entry in run.shared}):
            parts.append(f"All trained methods have {', '.join(shared)}; their names leave it out.\n")
        if warnings:
            parts.append("## Warnings\n\n" + "".join(f"* {line}\n" for line in warnings))
        worlds = self.groups.worlds
        for world in [*worlds, *([ALL] if len(worlds) > 1 and self.reference else [])]:
            methods = self.groups.methods(world)
            key = "coverage_cost.ratio" if world == ALL else "coverage_cost.iqm"
            against = self.reference or "" if world == ALL else ""
            methods.sort(key=lambda name: self._order(world, name, key, against))
            parts.append(f"## {world if world == ALL else f'World {world}'}\n")
            parts.append(self._aggregate(methods) if world == ALL else self._coverage(world, methods))
            parts += self._improvement(world, methods)
            parts += [] if world == ALL else [self._safety(world, methods)]
        parts += [f"## {FIGURES[name]}\n\n![{FIGURES[name]}]({name}.png)\n" for name in figures]
        others = sorted(name for run in runs for name in run.others)
        if others:
            parts.append("Further evaluations of trained runs, in no table: " + ", ".join(others) + "\n")
        settings = {
            "confidence": 100 * bootstrap.confidence,
            "resamples": bootstrap.resamples,
            "dash": DASH,
            "all": ALL,
        }
        return "\n".join([*parts, EXPLANATION.format(**settings)])

    def _order(self, world: str, method: str, key: str, against: str) -> tuple[float, str]:
        row = self.rows.get((world, method, key, against))
        value = 1.0 if row is None else row.value  # only the reference has no ratio
        return (math.inf if math.isnan(value) else value, method)

    def _value(self, world: str, method: str, quantity: str) -> str:
        return number(self.rows[world, method, quantity, ""].value)

    def _ratio(self, world: str, method: str) -> str:
        if method == self.reference:
            return "1 (reference)"
        return estimate(self.rows.get((world, method, "coverage_cost.ratio", self.reference or "")))

    def _coverage(self, world: str, methods: list[str]) -> str:
        bound = self.rows.get((world, BOUND, "coverage_cost.bound", ""))
        shown = [f"ratio to {self.reference}"] if self.reference else []
        shown += ["gap closed"] if self.reference and bound else []
        header = ["method", "seeds", "IQM of J", "mean", "std", *shown, "charges", "intervention, training", "testing"]
        rows = [
            [
                name,
                str(len(self.groups.runs[world, name])),
                estimate(self.rows[world, name, "coverage_cost.iqm", ""]),
                *(self._value(world, name, f"coverage_cost.{key}") for key in ("mean", "std")),
                *([self._ratio(world, name)] if self.reference else []),
                *([self._gap(world, name)] if self.reference and bound else []),
                self._value(world, name, "charges_per_robot.mean"),
                *(self._value(world, name, f"{phase}.intervention_rate.mean") for phase in ("train", "eval")),
            ]
            for name in methods
        ]
        text = f"\nCentroidal Voronoi cost, robots with unlimited batteries: J = {bound.value:.4g}.\n" if bound else ""
        return table(header, rows) + text

    def _gap(self, world: str, method: str) -> str:
        if method == self.reference:
            return "0 (reference)"
        return estimate(self.rows.get((world, method, "gap_closed", self.reference or "")))

    def _aggregate(self, methods: list[str]) -> str:
        if self.reference not in methods:
            return f"The reference {self.reference} does not have runs in every world: no aggregate.\n"
        left = sorted({method for _, method in self.groups.runs} - set(methods))
        note = f"\nWithout runs in every world, and left out: {', '.join(left)}.\n" if left else ""
        return (
            table(["method", f"J / J of {self.reference}"], ([name, self._ratio(ALL, name)] for name in methods)) + note
        )

    def _improvement(self, world: str, methods: list[str]) -> list[str]:
        others = [name for name in self.compared if name in methods]
        learned = [name for name in methods if name in self.groups.learned]
        if not others or not set(learned) - set(others):
            return []
        found = {(x, y): self.rows.get((world, x, "probability_of_improvement", y)) for x in learned for y in others}
        rows = ([x, *(estimate(found[x, y]) for y in others)] for x in learned)
        return [table(["learned method", *(f"P(better than {name})" for name in others)], rows)]

    def _safety(self, world: str, methods: list[str]) -> str:
        counts = (
            "robot_steps",
            *(f"violations.{kind}" for kind in keys.VIOLATION_KINDS),
            "filter.infeasible",
            "filter.outside",
        )
        header = ["method", "phase", "robot-steps", *keys.VIOLATION_KINDS, "infeasible", "outside", *RATES[1:]]
        rows = []
        for name in methods:
            learned = name in self.groups.learned
            for phase, text in [("train", "training")] * learned + [("eval", "testing")]:
                rates = [self._value(world, name, f"{phase}.{rate}_rate.mean") for rate in RATES[1:]]
                rows.append([name, text, *(self._value(world, name, f"{phase}.{count}") for count in counts), *rates])
        return table(header, rows)


def _write(path: Path, header: list[str], rows: Iterable[dict]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, header, restval="", lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {key: "" if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}
            )


def write_rows(path: Path, rows: list[Row]) -> None:
    """``table.csv``: one line per number; empty cells are NaN."""
    _write(path, list(Row.__annotations__), (asdict(row) for row in rows))


def write_runs(path: Path, runs: list[Run]) -> None:
    """``runs.csv``: one line per run with every number it wrote; empty cells were not measured."""
    own = ["world", "method", "seed", "learned", "name", "config_hash", "git_hash", "protocol"]
    header = [*own, *dict.fromkeys(name for run in runs for name in run.numbers)]
    _write(path, header, ({name: getattr(run, name) for name in own} | run.numbers for run in runs))


def write_curves(path: Path, curves: list[Curve]) -> None:
    """``curves.csv``: one line per point of a curve."""
    header = ["world", "method", "quantity", "seeds", "frames", "wall_time_s", "value", "low", "high"]
    rows = (
        dict(zip(header, (curve.world, curve.method, curve.quantity, curve.seeds, int(frames), *point), strict=True))
        for curve in curves
        for frames, *point in np.stack(
            [curve.frames, curve.seconds, curve.estimate.value, curve.estimate.low, curve.estimate.high], axis=1
        ).tolist()
    )
    _write(path, header, rows)
