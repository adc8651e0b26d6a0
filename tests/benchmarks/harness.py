"""What the benchmark programs share: options, interleaved timing within a budget, worlds, states and Markdown tables.

All solvers of a cell are timed in turn, round after round in one process, so that a noisy machine disturbs their ratio
little; the numbers are medians. Nothing is ever asserted about time.
"""

import argparse
import contextlib
import importlib
import io
import logging
import os
import platform
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from tensordict import TensorDictBase

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the programs are run as files

from agents import make_controller
from conf.versions import git_hash
from envs import SurveillanceConfig, SurveillanceEnv
from safety import SafetyConfig, SafetyFilter

DASH = "–"
NAMES = 2  # the tables' column of names, the wide one
FILTERS = {
    "none": SafetyConfig(mode="none"),
    "certified": SafetyConfig(),
    "stacked": SafetyConfig(mode="paper"),
    "paper": SafetyConfig(mode="paper", composition="min", split="full", sampled_data=False),
    "joint": SafetyConfig(mode="paper", split="joint"),
}
"""The filters that are compared, by the names of docs/results.md; ``paper`` is its literal reading."""

Chain = Sequence[Callable]
"""Phases of one run: the first takes nothing, every other one what the phase before it returned."""


# ---- options --------------------------------------------------------------------------------------------------------
def make_parser(doc: str | None, *, batches: str, robots: str, repeats: int = 5) -> argparse.ArgumentParser:
    """Parser with the options that every program has; ``doc`` is the program's docstring."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=integers, default=integers(batches), help=f"sizes, default {batches}")
    parser.add_argument("--robots", type=integers, default=integers(robots), help=f"numbers, default {robots}")
    parser.add_argument("--dimension", type=int, default=2, choices=(2, 3), help="of the world, default 2")
    parser.add_argument("--device", default="cpu", help="cpu or cuda, default cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="CPU threads for every solver")
    parser.add_argument("--repeats", type=int, default=repeats, help=f"most rounds per cell, default {repeats}")
    parser.add_argument("--seconds", type=float, default=20.0, help="time per cell and solver, default 20")
    return parser


def integers(text: str) -> list[int]:
    """``"64,512" -> [64, 512]``, ascending."""
    return sorted({int(part) for part in text.split(",")})


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse, set the number of threads, print what the numbers depend on."""
    options = parser.parse_args(arguments)
    os.environ["RAYON_NUM_THREADS"] = str(options.threads)  # moreau's; read when it first solves
    torch.set_num_threads(options.threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    print(f"{machine(options.device)}\n")
    return options


def machine(device: str) -> str:
    """CPU (and GPU), cores, threads, versions and commit."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), name)
    gpu = [torch.cuda.get_device_name(device)] if torch.device(device).type == "cuda" else []
    commit, _, changed = git_hash().partition("-")
    commit = f"commit {commit[:10]}" + (" with local changes" if changed else "")
    parts = [*gpu, name, f"{os.cpu_count()} cores", f"{torch.get_num_threads()} threads"]
    return ", ".join([*parts, f"torch {torch.__version__}", commit])


def optional(name: str) -> ModuleType | None:
    """A baseline's module, None if it is not installed (``pip install -e .[bench]``)."""
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stderr(io.StringIO()),
    ):  # gym, which VMAS needs, complains at length
        warnings.simplefilter("ignore")
        try:
            return importlib.import_module(name)
        except ImportError:
            return None


def missing(*names: str) -> str:
    """A note on the baselines that are not installed, or empty."""
    absent = [name for name in names if optional(name) is None]
    return (
        f"Not installed: {', '.join(absent)} (.venv/bin/pip install -c constraints.txt -e '.[bench]')."
        if absent
        else ""
    )


# ---- time -----------------------------------------------------------------------------------------------------------
def clock(device: str) -> float:
    """Seconds, once the device has finished."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def run(chain: Chain, device: str) -> list[float]:
    """Seconds of every phase of one run."""
    times, result = [], ()
    for phase in chain:
        start = clock(device)
        result = (phase(*result),)
        times.append(clock(device) - start)
    return times


class Budget:
    """What one run of a solver will take, from its runs at smaller sizes, against the time that a cell may take."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.seconds, self.device, self.repeats = options.seconds, options.device, options.repeats
        self.seen: dict[Any, tuple[int, float]] = {}
        self.skipped: set[str] = set()

    def allows(self, key: Any, size: int) -> bool:
        """Whether a run at ``size`` is expected within the budget; True if nothing is known."""
        known, seconds = self.seen.get(key, (1, 0.0))
        return seconds * max(1.0, size / known) <= self.seconds

    def probe(self, key: Any, size: int, chain_of: Callable[[int], Chain], smallest: int = 8) -> bool:
        """Run at growing sizes below ``size`` until it is clear whether ``size`` is affordable."""
        known = self.seen.get(key, (smallest // 8, 0.0))[0]
        while not self.allows(key, size) or key not in self.seen:
            known *= 8
            if known >= size or not self.allows(key, known):
                break
            self.seen[key] = (known, sum(run(chain_of(known), self.device)))
        return self.allows(key, size)

    def medians(self, chains: dict[str, Chain | None], size: int, key: Any = None) -> dict[str, list[float] | None]:
        """Median milliseconds per phase, solvers interleaved; None for None and for what the budget does not allow.

        Args:
            chains: the runs by name.
            size: number of problems, for the expectation at larger sizes.
            key: what besides the name the expectation depends on.
        """
        allowed = {name: c for name, c in chains.items() if c is not None and self.allows((name, key), size)}
        self.skipped |= chains.keys() - allowed.keys()
        rounds = {}
        for name, chain in allowed.items():  # the warm-up tells how many rounds fit into the budget
            spent = sum(run(chain, self.device))
            self.seen[name, key] = (size, spent)
            rounds[name] = max(1, min(self.repeats, int(self.seconds / max(spent, 1e-9))))
        times: dict[str, list[list[float]]] = {name: [] for name in allowed}
        for k in range(self.repeats):
            for name, chain in allowed.items():
                if k < rounds[name]:
                    times[name].append(run(chain, self.device))
        for name, rows in times.items():
            self.seen[name, key] = (size, statistics.median(map(sum, rows)))
        middle = {n: [1e3 * statistics.median(t) for t in zip(*rows, strict=True)] for n, rows in times.items()}
        return {name: middle.get(name) for name in chains}

    def footnote(self) -> str:
        """What the dashes mean; empty if nothing was skipped."""
        if not self.skipped:
            return ""
        names = "; ".join(sorted(self.skipped))
        return (
            f"{DASH}: one run is expected to take more than {self.seconds:g} s, or more memory than is free ({names})."
        )


def free_memory(device: str) -> int:
    """Bytes that are free on the device."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    with contextlib.suppress(ValueError, OSError):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 2**33


# ---- worlds and states ----------------------------------------------------------------------------------------------
def make_world(n_agents: int, dimension: int = 2) -> SurveillanceConfig:
    """The default world, or ``env=aerial``."""
    if dimension == 2:
        return SurveillanceConfig(n_agents=n_agents)
    arena = [[-1.0, 1.0], [-1.0, 1.0], [0.0, 1.0]]
    return SurveillanceConfig(n_agents=n_agents, dimension=3, arena=arena, density="age")


@torch.no_grad()
def rollout(
    world: SurveillanceConfig, num_envs: int, *, behind: str, controller: str = "random", device: str = "cpu"
) -> Iterator[TensorDictBase]:
    """States with nominal actions, step after step without end, of worlds behind a filter; each a copy of its own.

    Worlds that end are reset, as in training.
    """
    env, nominal = SurveillanceEnv(world, num_envs, device, seed=1), make_controller(controller, world)
    policy = SafetyFilter(FILTERS[behind], world)
    td = env.reset()
    while True:
        td = nominal(td)
        yield td.clone()
        _, td = env.step_and_maybe_reset(policy(td))


# ---- tables ---------------------------------------------------------------------------------------------------------
def number(value: float | None, digits: int = 3) -> str:
    """Three significant digits without exponent; a dash for None."""
    if value is None:
        return DASH
    if value != value or value in (float("inf"), float("-inf")):
        return str(value)
    size = abs(value)
    places = 0 if size >= 100 else 1 if size >= 10 else 2 if size >= 1 else digits
    return f"{value:,.{places}f}"


def ratio(value: float | None, base: float | None) -> float | None:
    """``value / base``, None without either."""
    return None if value is None or base is None else value / base


def table(title: str, header: Sequence[str], rows: Iterable[Sequence[Any]], *notes: str | Callable[[], str]) -> None:
    """Print a Markdown table row by row as they are measured; cells are strings, integers, floats or None (a dash).

    Notes that are functions are called once the rows are there.
    """
    widths = [max(9, len(name)) if k != NAMES else 25 for k, name in enumerate(header)]
    print(f"### {title}\n")
    print("| " + " | ".join(h.ljust(w) for h, w in zip(header, widths, strict=True)) + " |")
    print("|" + "|".join("-" * (w + 2) for w in widths) + "|", flush=True)
    for row in rows:
        cells = [number(x) if isinstance(x, float) or x is None else str(x) for x in row]
        print("| " + " | ".join(x.rjust(w) for x, w in zip(cells, widths, strict=True)) + " |", flush=True)
    texts = [note() if callable(note) else note for note in notes]
    print("".join(f"\n{text}" for text in texts if text) + "\n", flush=True)
