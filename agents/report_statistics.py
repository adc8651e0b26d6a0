"""Statistics over seeds, the only replication unit: interquartile means, bootstrap intervals, probability of improvement.

Intervals are percentile bootstraps of scipy. Several samples (a method and its reference, or the worlds of an aggregate)
are resampled each on its own: a bootstrap stratified over methods and worlds. No interval is given for fewer than two
seeds; with few seeds percentile intervals are too narrow.

Source: Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (IQM, stratified
bootstrap, probability of improvement).
"""

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from agents.report_runs import Run
from envs import SurveillanceConfig, keys
from envs.centroidal import centroidal_cost

ALL = "all worlds"
BOUND = "unlimited batteries"
COST = "eval.coverage_cost"
RATES = ("intervention", "hold", "homing")
LOGGED = {
    "coverage_cost": "eval/coverage_cost",
    "intervention_rate": "filter/intervention_rate",
    "homing_rate": "filter/homing_rate",
    "fallback_rate": "filter/fallback_rate",
}
"""TensorBoard tags that the curves are made of."""
BATCH = 2_000_000  # resampled numbers in memory at a time
POINTS = 25  # of a curve of rates: finer, the phase of the episodes shows, which start together in all worlds


@dataclass
class Estimate:
    """A number, or an array of them, with its interval; NaN where there is none."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass
class Row:
    """One number of the report."""

    world: str
    method: str
    quantity: str
    against: str  # the other method of a comparison, or empty
    seeds: int
    value: float
    low: float = np.nan
    high: float = np.nan


def iqm(sample: np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean: of what is left without the lowest and the highest quarter (rounded down) of the sample."""
    return stats.trim_mean(sample, 0.25, axis=axis)


def ratio(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """IQM of a method's J, each world's divided by the IQM of the reference's J in that world.

    Args:
        samples: the method's in K worlds, then the reference's in the same K worlds, each ``(*B, n_seeds)``.
        axis: of the seeds; the last.
    """
    own, reference = samples[: len(samples) // 2], samples[len(samples) // 2 :]
    scaled = [x / np.expand_dims(iqm(y, axis), axis) for x, y in zip(own, reference, strict=True)]
    return iqm(np.concatenate(scaled, axis=axis), axis)


def gap_closed(bound: float, own: np.ndarray, reference: np.ndarray, axis: int = -1) -> np.ndarray:
    """Share of the gap between the reference's IQM of J and a lower bound that a method's closes; samples ``(*B, n_seeds)``."""
    start = iqm(reference, axis)
    return (start - iqm(own, axis)) / (start - bound)


def improvement(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean over K worlds of P(J_x < J_y), ties counted half.

    Args:
        samples: x in K worlds, then y in the same K worlds, each ``(*B, n_seeds)``.
        axis: of the seeds; the last.
    """
    x, y = samples[: len(samples) // 2], samples[len(samples) // 2 :]
    shares = []
    for one, other in zip(x, y, strict=True):
        # Mann and Whitney's U: pairs in which the first sample is larger, ties half
        pairs = stats.mannwhitneyu(other, one, axis=axis, method="asymptotic").statistic
        shares.append(pairs / (one.shape[axis] * other.shape[axis]))
    return np.mean(shares, axis=0)


@dataclass
class Bootstrap:
    """Percentile bootstrap; the same numbers for the same samples, whatever else is computed.

    Args:
        resamples: number of resamples.
        confidence: of the interval, in (0, 1).
        seed: of the resampling.
    """

    resamples: int = 5000
    confidence: float = 0.95
    seed: int = 0

    def __call__(self, statistic: Callable[..., np.ndarray], *samples: np.ndarray) -> Estimate:
        """``statistic`` of samples ``(*B, n_seeds)``, each resampled on its own along the seeds."""
        value = np.asarray(statistic(*samples, axis=-1), dtype=float)
        nothing = np.full_like(value, np.nan)
        if min(sample.shape[-1] for sample in samples) < 2 or not np.isfinite(value).all():
            return Estimate(value, nothing, nothing)
        result = stats.bootstrap(
            samples,
            statistic,
            n_resamples=self.resamples,
            confidence_level=self.confidence,
            method="percentile",
            vectorized=True,
            axis=-1,
            batch=max(1, BATCH // sum(sample.size for sample in samples)),
            rng=np.random.default_rng(self.seed),
        )
        return Estimate(value, *result.confidence_interval)


class Groups:
    """The runs by world and method.

    Args:
        runs: finished runs.
    """

    def __init__(self, runs: list[Run]) -> None:
        self.runs: dict[tuple[str, str], list[Run]] = {}
        for run in sorted(runs, key=lambda run: run.seed):
            self.runs.setdefault((run.world, run.method), []).append(run)
        self.worlds = sorted({run.world for run in runs})
        self.learned = {run.method for run in runs if run.learned}

    def methods(self, world: str) -> list[str]:
        """Methods of a world, of all of them for :data:`ALL` (those that have runs in every world)."""
        worlds = self.worlds if world == ALL else [world]
        names = sorted({method for _, method in self.runs})
        return [name for name in names if all((world, name) in self.runs for world in worlds)]

    def config(self, world: str) -> SurveillanceConfig:
        """The world's configuration, as its first run has it."""
        env = self.runs[world, self.methods(world)[0]][0].env
        return SurveillanceConfig(
            **{name: env[name] for name in SurveillanceConfig.__dataclass_fields__ if name in env}
        )

    def sample(self, world: str, method: str, quantity: str) -> np.ndarray:
        """``(n_seeds,)``; NaN where a run did not measure ``quantity``."""
        return np.array([run.numbers.get(quantity, np.nan) for run in self.runs[world, method]], dtype=float)

    def samples(self, world: str, method: str, quantity: str = COST) -> list[np.ndarray]:
        """The sample of a world, or those of every world for :data:`ALL`."""
        return [self.sample(name, method, quantity) for name in (self.worlds if world == ALL else [world])]


def compute_rows(groups: Groups, bootstrap: Bootstrap, reference: str | None) -> list[Row]:
    """Every number of the report; lower J is better.

    Args:
        groups: the runs.
        bootstrap: the intervals.
        reference: label of the method that J is divided by; None for no ratios.

    Returns:
        Per world, and for :data:`ALL` where there are several: J's IQM, mean, standard deviation and ratio; rates;
        violations summed over the seeds; P(J_x < J_y) of every learned method x over every other method y. Per world:
        the centroidal Voronoi cost, as J of :data:`BOUND`, and with a reference the share of the gap to it that is closed.
    """
    rows: list[Row] = []
    bounds = {world: centroidal_cost(groups.config(world)) for world in groups.worlds}
    rows += [Row(world, BOUND, "coverage_cost.bound", "", 0, j) for world, j in bounds.items() if j is not None]
    for world in groups.worlds:
        for method in groups.methods(world):
            rows += _own_rows(groups, bootstrap, world, method)
    for world in [*groups.worlds, *([ALL] if len(groups.worlds) > 1 else [])]:
        methods = groups.methods(world)
        for method in methods:
            x = groups.samples(world, method)
            seeds = min(sample.size for sample in x)
            if any(sample.size != seeds for sample in x):
                continue  # worlds with more seeds would count for more

            def compare(quantity, statistic, other, method=method, x=x, seeds=seeds, world=world) -> None:
                found = bootstrap(statistic, *x, *groups.samples(world, other))
                rows.append(_row(world, method, quantity, other, seeds, found))

            if reference in methods and method != reference:
                compare("coverage_cost.ratio", ratio, reference)
                if world != ALL and bounds.get(world) is not None:
                    compare("gap_closed", functools.partial(gap_closed, bounds[world]), reference)
            if method in groups.learned:
                for other in (name for name in methods if name != method):
                    compare("probability_of_improvement", improvement, other)
    return rows


def _own_rows(groups: Groups, bootstrap: Bootstrap, world: str, method: str) -> Iterator[Row]:
    """What a method measured in a world."""
    cost = groups.sample(world, method, COST)
    n = cost.size

    def single(quantity: str, value: float) -> Row:
        return Row(world, method, quantity, "", n, float(value))

    for name in ("coverage_cost", "episode_reward"):
        yield _row(world, method, f"{name}.iqm", "", n, bootstrap(iqm, groups.sample(world, method, f"eval.{name}")))
    yield single("coverage_cost.mean", cost.mean())
    yield single("coverage_cost.std", cost.std(ddof=1) if n > 1 else np.nan)
    yield single("charges_per_robot.mean", groups.sample(world, method, "eval.charges_per_robot").mean())
    for phase in ("train", "eval"):
        logged = (f"{phase}.filter.{name}_rate" for name in ("intervention", "fallback", "homing"))
        intervention, fallback, homing = (groups.sample(world, method, name) for name in logged)
        for name, rate in zip(RATES, (intervention, fallback - homing, homing), strict=True):
            yield single(f"{phase}.{name}_rate.mean", rate.mean())
        kinds = [f"violations.{kind}" for kind in keys.VIOLATION_KINDS]
        for name in ("robot_steps", *kinds, "filter.infeasible", "filter.outside"):
            yield single(f"{phase}.{name}", groups.sample(world, method, f"{phase}.{name}").sum())


def _row(world: str, method: str, quantity: str, against: str, seeds: int, found: Estimate) -> Row:
    return Row(world, method, quantity, against, seeds, float(found.value), float(found.low), float(found.high))


@dataclass
class Curve:
    """IQM over seeds of what the runs of a method logged, at the frames that all of them logged; arrays ``(T,)``.

    A rate is the mean since the point before, J that of the evaluation at the point.
    """

    world: str
    method: str
    quantity: str
    seeds: int
    frames: np.ndarray
    seconds: np.ndarray  # IQM over the seeds of the time at which they got there, s
    estimate: Estimate


def compute_curves(
    groups: Groups, bootstrap: Bootstrap, read: Callable[[Run], Mapping[str, np.ndarray]]
) -> tuple[list[Curve], list[str]]:
    """Learning curves of J and of the filter's rates.

    Args:
        groups: the runs.
        bootstrap: the bands.
        read: a run's logged scalars by tag, ``(T, 3)``, such as :meth:`agents.report_runs.Events.curves`.

    Returns:
        The curves, and a warning per method of which a run logged nothing.
    """
    curves, warnings = [], []
    for (world, method), runs in groups.runs.items():
        logged = [_logged(read(run)) for run in runs if run.learned]
        if any(not entry for entry in logged):
            warnings.append(
                f"{world} / {method}: no TensorBoard events in {sum(not e for e in logged)} runs: no curves of them"
            )
        for quantity in ("coverage_cost", *(f"{name}_rate" for name in RATES)):
            if not (found := [entry[quantity] for entry in logged if quantity in entry]):
                continue
            frames = found[0][:, 0]
            for entry in found[1:]:
                frames = np.intersect1d(frames, entry[:, 0])
            rows = np.stack([entry[np.isin(entry[:, 0], frames)] for entry in found], axis=1)
            if quantity != "coverage_cost" and len(frames) > POINTS:
                parts = np.array_split(rows, POINTS)  # values are means since the point before: so are means of them
                means = np.stack([part[..., 2].mean(axis=0) for part in parts])
                rows = np.stack([part[-1] for part in parts])
                rows[..., 2], frames = means, rows[:, 0, 0]
            estimate = bootstrap(iqm, rows[..., 2]) if frames.size else Estimate(*np.zeros((3, 0)))
            curves.append(Curve(world, method, quantity, len(found), frames, iqm(rows[..., 1]), estimate))
    return curves, warnings


def _logged(tags: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    found = {name: tags[tag] for name, tag in LOGGED.items() if tag in tags}
    fallback, homing = found.pop("fallback_rate", None), found.get("homing_rate")
    if fallback is not None and homing is not None and len(fallback) == len(homing):
        found["hold_rate"] = fallback - homing * (0.0, 0.0, 1.0)
    return found
