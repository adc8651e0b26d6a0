"""Find the runs below a folder, read what they measured, and refuse what cannot be compared.

A run is a folder of train.py (``.hydra/``, ``summary.json``, TensorBoard events) or of a controller's evaluation by
evaluate.py (``.hydra/``, ``eval.json``). Runs are replications of each other where world and method are the same and
the seed differs. What lies inside a run's folder (``eval/``, ``replaced_<k>/``) is not another run.
"""

import json
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents.evaluation import rollout_steps
from agents.training_config import NOT_HASHED

# Overrides that belong to the world or to no method: they do not name one.
UNNAMED = {
    *NOT_HASHED,
    *("env", "eval", "experiment", "method"),
    *("compile", "fixed_sizes", "cuda_graphs"),
    *("workers.backend", "workers.ray_address", "workers.gpus"),
}
UNNAMED_EVALUATION = UNNAMED | {"controller", "steps", "num_envs", "pictures", "restart"}
SHOWN = 3  # names per problem in an error: messages have at most 8 lines


class ReportError(ValueError):
    """Runs that cannot be reported; the message names them and says what to do."""


@dataclass
class Run:
    """One run, finished or not."""

    folder: Path
    name: str  # path below the sweep
    world: str
    method: str  # the same for all runs of a configuration, however it was given
    seed: int
    learned: bool  # by train.py; otherwise a controller's evaluation
    config_hash: str
    env: dict  # the world's configuration
    protocol: str  # how J was measured
    n_agents: int
    base: str = ""  # what the method's name begins with, if anything
    settings: list[str] = field(default_factory=list)  # overrides that it ends with
    shared: list[str] = field(default_factory=list)  # those that no name needs: every trained method has them
    git_hash: str = ""
    finished: bool = False
    numbers: dict[str, float] = field(default_factory=dict)
    """Every number of summary.json or eval.json by dotted name: ``eval.coverage_cost``, ``train.violations.collision``,
    ``train.filter.fallback_rate``, ``eval.filter.…`` (controllers only), ``train.robot_steps``; NaN for null."""
    others: list[str] = field(default_factory=list)  # evaluations inside the run's folder

    @property
    def label(self) -> str:
        """World, method and seed."""
        return f"{self.world} / {self.method} / seed {self.seed}"


def find_runs(sweep: Path, config_hash: Callable[[DictConfig], str]) -> list[Run]:
    """All runs at any depth below ``sweep``, finished or not, by world, method and seed.

    Args:
        sweep: folder to search.
        config_hash: digest of a resolved configuration that is the same for all seeds.

    Raises:
        ReportError: the folder does not exist, holds no run, or a run's JSON cannot be read.
    """
    if not sweep.is_dir():
        raise ReportError(f"sweep={sweep} is not a folder.")
    found = [run for folder in run_folders(sweep) if (run := read_run(folder, sweep, config_hash))]
    if not found:
        raise ReportError(
            f"sweep={sweep} holds no runs: no folder below it was written by train.py or by evaluate.py controller=…"
        )
    _name_alike(found)
    _leave_out_shared([run for run in found if run.learned])
    return sorted(found, key=lambda run: (run.world, run.method, run.seed, run.name))


def _name_alike(runs: list[Run]) -> None:
    """Give the runs of one configuration the shortest of their worlds' and methods' names, a chosen method's or experiment's
    first: values may be given as overrides that are the defaults.
    """
    alike = defaultdict(list)
    for run in runs:
        alike[run.config_hash].append(run)
    for group in alike.values():
        world = min((run.world for run in group), key=lambda name: (len(name), name))
        named = min(group, key=lambda run: (not run.base, len(run.method), run.method))
        for run in group:
            run.world, run.method, run.base, run.settings = world, named.method, named.base, named.settings


def _leave_out_shared(runs: list[Run]) -> None:
    """Shorten the names of several trained methods by the overrides that all of them have."""
    if len({run.method for run in runs}) < 2:
        return
    shared = sorted(set.intersection(*(set(run.settings) for run in runs)))
    for run in runs:
        run.settings, run.shared = [entry for entry in run.settings if entry not in shared], shared
        run.method = _label(run.base, run.settings)


def run_folders(sweep: Path) -> Iterable[Path]:
    """Folders below ``sweep`` that hold a run, whoever wrote it; what lies inside one is not looked at."""
    for path, names, _ in os.walk(sweep):
        folder = Path(path)
        if (folder / ".hydra" / "config.yaml").is_file() and not _of_several_seeds(folder):
            names.clear()
            yield folder
        else:
            names[:] = [name for name in names if not re.fullmatch(r"replaced_\d+|\..*", name)]


def is_training(config: DictConfig) -> bool:
    """Whether a composed configuration is train.py's."""
    return "collector" in config


def is_reported(config: DictConfig) -> bool:
    """Whether a composed configuration is of a run that a report reads: a training, or a controller's evaluation."""
    return is_training(config) or config.get("controller") is not None


def _of_several_seeds(folder: Path) -> bool:
    """Whether the folder is that of a program whose runs have folders of their own."""
    config = OmegaConf.load(folder / ".hydra" / "config.yaml")
    return config.get("seeds") is not None or config.get("n_seeds", 1) > 1


def read_run(folder: Path, sweep: Path, config_hash: Callable[[DictConfig], str]) -> Run | None:
    """The run in ``folder``; None if another program wrote it, or if it evaluates a trained run."""
    config: Any = OmegaConf.load(folder / ".hydra" / "config.yaml")
    if not is_reported(config):
        return None
    learned = is_training(config)
    hydra = OmegaConf.load(folder / ".hydra" / "hydra.yaml").hydra
    choices, overrides = hydra.runtime.choices, [str(entry).lstrip("+~") for entry in hydra.overrides.task]
    steps = (config.eval.steps if learned else config.steps) or rollout_steps(config.env.horizon)
    restart = ", worlds drawn anew after a violation" if config.get("restart") else ""
    base, settings = _method(config, choices, overrides)
    run = Run(
        folder=folder,
        name=folder.relative_to(sweep).as_posix(),
        world=" ".join([choices.env, *sorted(entry[4:] for entry in overrides if _names_world(entry))]),
        method=_label(base, settings),
        seed=config.seed,
        learned=learned,
        config_hash=config_hash(config),
        env=OmegaConf.to_container(config.env),
        protocol=f"{steps} steps{restart}",
        n_agents=config.env.n_agents,
        base=base,
        settings=settings,
        others=sorted(path.parent.relative_to(sweep).as_posix() for path in folder.glob("eval/*/eval.json")),
    )
    path = folder / ("summary.json" if learned else "eval.json")
    if path.is_file():
        try:
            content = json.loads(path.read_text())
            run.numbers = _training_numbers(content, run) if learned else _evaluation_numbers(content)
            run.git_hash, run.finished = content["git_hash"], True
            run.config_hash = content.get("config_hash", run.config_hash)
        except (json.JSONDecodeError, KeyError) as error:
            raise ReportError(f"{path} cannot be read ({type(error).__name__}: {error}).") from error
    return run


def _method(config: DictConfig, choices: DictConfig, overrides: list[str]) -> tuple[str, list[str]]:
    """What is compared: the choice of group ``method``, a controller and its filter, or an experiment; and its overrides."""
    if choices.get("method", "default") != "default":
        return choices.method, _named(overrides, UNNAMED)
    if config.get("controller") is not None:
        own = [entry for entry in overrides if not entry.startswith("safety=")]
        return f"{config.controller} + {choices.safety}", _named(own, UNNAMED_EVALUATION)
    given = any(entry.startswith("experiment=") for entry in overrides)
    return choices.experiment if given else "", _named(overrides, UNNAMED)


def _label(base: str, settings: list[str]) -> str:
    """A method's name."""
    return " ".join(filter(None, [base, *settings])) or "default"


def _names_world(override: str) -> bool:
    """What happens after a violation is a matter of the method, which may set it itself."""
    return override.startswith("env.") and not override.startswith("env.on_violation=")


def _named(overrides: list[str], unnamed: set[str]) -> list[str]:
    return sorted(entry for entry in overrides if not {re.split(r"[.=@]", entry)[0], entry.split("=")[0]} & unnamed)


def _flat(content: Any, prefix: str) -> dict[str, float]:
    """Numbers of a nested object by dotted name; null is NaN, text and lists are left out."""
    if isinstance(content, dict):
        return {
            name: value for key, inner in content.items() for name, value in _flat(inner, f"{prefix}.{key}").items()
        }
    if content is None:
        return {prefix: np.nan}
    return {prefix: content} if isinstance(content, int | float) and not isinstance(content, bool) else {}


def _training_numbers(content: dict, run: Run) -> dict[str, float]:
    names = ("frames", "episodes", "wall_time_s", "frames_per_second")
    numbers = {name: content[name] for name in names} | {"n_seeds": content.get("n_seeds", 1)}
    numbers |= {"train.robot_steps": content["frames"] * run.n_agents}
    train = _flat(content["train"], "train") | _flat(content["filter"], "train.filter")
    return numbers | train | _flat(content["eval"], "eval")


def _evaluation_numbers(content: dict) -> dict[str, float]:
    beside = {"filter", "env", "safety", "certificate", "steps", "num_envs", "seed", "adversary", "wall_time_s"}
    metrics = {name: value for name, value in content.items() if name not in beside}
    metrics["coverage_cost"] = content["coverage_cost"]  # KeyError if this is another program's file
    return {"wall_time_s": content["wall_time_s"]} | _flat(metrics, "eval") | _flat(content["filter"], "eval.filter")


def check_runs(runs: list[Run], *, incomplete: bool = False) -> tuple[list[Run], list[str]]:
    """The runs to report and what the reader must know about them.

    Args:
        runs: from :func:`find_runs`.
        incomplete: report what there is where runs are unfinished or seeds missing.

    Returns:
        The finished runs and the warnings, one line each.

    Raises:
        ReportError: unfinished or missing runs (not with ``incomplete``), several runs of one seed, or several
            configurations under one name.
    """
    finished, groups = [run for run in runs if run.finished], defaultdict(list)
    for run in finished:
        groups[run.world, run.method].append(run)
    twice = [
        f"{same[0].label} ({', '.join(run.name for run in same)})"
        for group in groups.values()
        for seed in sorted({run.seed for run in group})
        if len(same := [run for run in group if run.seed == seed]) > 1
    ]
    mixed = [
        f"{world} / {method} ({_count(run.config_hash for run in group)})"
        for (world, method), group in groups.items()
        if len({run.config_hash for run in group}) > 1
    ]
    if twice or mixed:
        lines = [_listed("several runs of one seed", twice), _listed("configuration hashes that differ", mixed)]
        raise ReportError("\n".join(["runs that are no replications of each other:", *filter(None, lines)]))
    unfinished = [run.name for run in runs if not run.finished]
    missing = []
    started = {(run.world, run.method, run.seed) for run in runs}
    for world, method in sorted({key[:2] for key in started}):
        seeds = sorted({run.seed for run in runs if run.world == world})
        missing += [f"{world} / {method} / seed {s}" for s in seeds if (world, method, s) not in started]
    lines = [_listed("unfinished", unfinished), _listed("missing, though other methods have the seed", missing)]
    if any(lines) and not incomplete:
        head = "the sweep is incomplete (incomplete=true reports what there is):"
        raise ReportError("\n".join([head, *filter(None, lines)]))
    if not finished:
        raise ReportError(f"none of the {len(runs)} runs is finished.")
    unlisted = [_listed("unfinished", unfinished, None), _listed("missing seeds", missing, None)]
    return finished, [*filter(None, unlisted), *_warnings(finished)]


def _warnings(runs: list[Run]) -> list[str]:
    """Differences between runs that do not forbid a comparison but may decide it."""
    lines = []
    if len({run.git_hash for run in runs}) > 1:
        lines.append(f"runs of different commits: {_count(run.git_hash[:12] for run in runs)}")
    for world in sorted({run.world for run in runs}):
        own = [run for run in runs if run.world == world]
        if len({run.protocol for run in own}) > 1:
            lines.append(f"world {world}: J is measured over {_count(run.protocol for run in own)}")
        for name in sorted({name for run in own for name in run.env}):
            if len({str(run.env.get(name)) for run in own}) > 1:
                lines.append(f"world {world}: env.{name} is {_count(str(run.env.get(name)) for run in own)}")
        budgets = [f"{run.numbers['frames']} frames" for run in own if run.learned]
        if len(set(budgets)) > 1:
            lines.append(f"world {world}: trained for {_count(budgets)}")
    together = [run for run in runs if run.numbers.get("n_seeds", 1) > 1]
    if together:
        lines.append(
            f"times of {len(together)} runs are those of programs that trained several seeds at once (n_seeds in runs.csv)"
        )
    unmeasured = [run.label for run in runs if not np.isfinite(run.numbers["eval.coverage_cost"])]
    return [*lines, *filter(None, [_listed("no finite J", unmeasured, None)])]


def _count(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(f"{name} ({names.count(name)} runs)" for name in sorted(set(names)))


def _listed(title: str, names: list[str], shown: int | None = SHOWN) -> str:
    if not names:
        return ""
    more = f" and {len(names) - shown} more" if shown and len(names) > shown else ""
    return f"{title}: {', '.join(names[:shown])}{more}"


@dataclass
class Events:
    """What a training run logged, by TensorBoard tag."""

    start: float = 0.0
    """Wall time of the first event, s."""
    points: dict[str, np.ndarray] = field(default_factory=dict)
    """``(T, 3)``: frames (ascending, no two the same), wall time (s), value."""

    def curves(self) -> dict[str, np.ndarray]:
        """The points with seconds since the first event in the place of wall times."""
        return {tag: points - (0.0, self.start, 0.0) for tag, points in self.points.items()}


def read_events(folder: Path, tags: Collection[str]) -> Events:
    """What the run in ``folder`` logged of ``tags``; nothing where there are no events."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    logged = Events()
    for tag in sorted(set(tags).intersection(events.Tags()["scalars"])):
        logged.start = events.FirstEventTimestamp()
        last = {entry.step: (entry.wall_time, entry.value) for entry in events.Scalars(tag)}  # of a resumed run
        logged.points[tag] = np.array([(step, *last[step]) for step in sorted(last)], dtype=float)
    return logged
