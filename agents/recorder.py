"""What a training run measures: violations, episodes and filter over the batches, in numbers for log and summary."""

import functools
import math
import time
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn

from agents.divergence import WATCHED
from envs import SurveillanceConfig, keys
from envs.graphs import graphed
from envs.metrics import EpisodeTracker
from safety.statistics import FILTER_READS, FilterStatistics, filter_numbers

COUNTED: list[NestedKey] = [
    *(*WATCHED.values(), *FILTER_READS),
    *(("next", *keys.VIOLATION, kind) for kind in keys.VIOLATION_KINDS),
    *(("next", keys.COVERAGE_COST), ("next", "done")),
]
"""What :class:`BatchCounter` reads of a batch."""


class Every:
    """Whether another ``interval`` has passed; never where the interval is 0."""

    def __init__(self, interval: int) -> None:
        self.interval = interval
        self.next = interval

    def __call__(self, count: int) -> bool:
        """True once each time ``count`` reaches the next multiple (several passed at once count as one)."""
        if not self.interval or count < self.next:
            return False
        self.next = count - count % self.interval + self.interval
        return True

    def state_dict(self) -> dict:
        """When it is due next, for checkpoints."""
        return {"next": self.next}

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.next = state["next"]


class Seconds:
    """Wall time by what it was spent on, over all the processes that a run took.

    Args:
        names: what time is spent on.
    """

    def __init__(self, *names: str) -> None:
        self.totals = dict.fromkeys(names, 0.0)
        self.inside: dict[str, float] = {}
        """Shares of "collect": see :meth:`watch`."""
        self._mark = time.perf_counter()
        self._watched: dict[str, float] = {}

    def spent(self, name: str) -> None:
        """The time since the last call went to ``name``."""
        now = time.perf_counter()
        self.totals[name] += now - self._mark
        self._mark = now
        for part, value in self._watched.items():
            self.inside[part] += value if name == "collect" else 0.0
            self._watched[part] = 0.0

    def watch(self, name: str, module: nn.Module) -> None:
        """Measure the calls of a module as a share of "collect" (on a GPU: until its work is queued)."""
        self.inside[name], self._watched[name] = 0.0, 0.0
        starts = []

        def begin(*_: object) -> None:
            starts.append(time.perf_counter())

        def end(*_: object) -> None:
            self._watched[name] += time.perf_counter() - starts.pop()

        module.register_forward_pre_hook(begin)
        module.register_forward_hook(end)

    def total(self) -> float:
        """Sum of all."""
        return sum(self.totals.values())

    def scalars(self, frames: int) -> dict[str, float]:
        """Seconds and frames per second, of all and of each part, by TensorBoard tag.

        Collection splits into the filter, the policy's networks and noise (inference), and the environment with the collector.
        """
        parts = dict(self.totals)
        if {"policy", "filter"} <= self.inside.keys():
            policy, chosen = self.inside["policy"], self.inside["filter"]
            parts |= {"filter": chosen, "inference": policy - chosen, "env": self.totals["collect"] - policy}
        rates = {f"time/frames_per_second_{name}": frames / value for name, value in parts.items() if value > 0}
        seconds = {f"time/{name}_s": value for name, value in parts.items()}
        return {"time/frames_per_second": frames / max(self.total(), 1e-9)} | seconds | rates

    def state_dict(self) -> dict:
        """The totals, for checkpoints."""
        return {"totals": dict(self.totals), "inside": dict(self.inside)}

    def load_state_dict(self, state: dict) -> None:
        """Go on counting from what :meth:`state_dict` returned."""
        self.totals = {name: state["totals"].get(name, 0.0) for name in self.totals}
        self.inside = {name: state["inside"].get(name, 0.0) for name in self.inside}


class Reading:
    """Numbers on their way from the device to the host, which need not wait for what the device is asked afterwards.

    Args:
        values: of any shape.
    """

    def __init__(self, values: Tensor) -> None:
        self._values = values.to("cpu", non_blocking=True)
        self._arrival = torch.cuda.current_stream(values.device).record_event() if values.is_cuda else None

    @functools.cached_property
    def numbers(self) -> list:
        """The values, once they have come."""
        if self._arrival is not None:
            self._arrival.synchronize()
        return self._values.tolist()


@dataclass
class Counted:
    """What :class:`BatchCounter` finds in the batch of one learner."""

    reading: Reading
    """The sums of all learners."""
    names: list[str]
    """Of the sums."""
    violating: Tensor
    """Violating robots of each step, ``(num_envs, T)``."""
    reward: Tensor
    """Reward that all robots have in common, ``(num_envs, T)``."""
    done: Tensor
    """Whether the episode ends, ``(num_envs, T)``."""
    whole: TensorDictBase
    """The batch of all learners."""
    k: int
    """Which learner."""

    @functools.cached_property
    def sums(self) -> dict[str, float]:
        """Violations by kind, "cost", "done" and "finite" (1 or 0), and what :meth:`FilterStatistics.add` takes.

        The first to ask waits for the device.
        """
        return dict(zip(self.names, self.reading.numbers[self.k], strict=True))

    @property
    def batch(self) -> TensorDictBase:
        """The learner's own batch ``(num_envs, T)``."""
        worlds = len(self.done)
        return self.whole[self.k * worlds : (self.k + 1) * worlds]


class BatchCounter:
    """Sums over collected batches. Whoever wants to know them waits for the device, once a batch for all learners.

    Args:
        world: the world.
        n_learners: learners, each with its block of the batch's worlds.
        cuda_graphs: record the counting and replay it (:mod:`envs.graphs`).
    """

    def __init__(self, world: SurveillanceConfig, n_learners: int = 1, *, cuda_graphs: bool = False) -> None:
        self.world, self.n_learners = world, n_learners
        self._count = graphed(self._count_tensors, enabled=cuda_graphs)
        self._keys: list[NestedKey] = []

    @torch.inference_mode()
    def __call__(self, batch: TensorDictBase) -> list[Counted]:
        """``(n_learners * num_envs, T)``: what each learner's worlds hold."""
        self._keys = self._keys or [key for key in COUNTED if key in batch.keys(True)]
        sums, violating = self._count(*(batch[key] for key in self._keys))
        reading = Reading(sums)
        steps = (violating, batch["next", *keys.REWARD][..., 0, 0], batch["next", "done"].squeeze(-1))
        own = zip(*(value.chunk(self.n_learners) for value in steps), strict=True)
        return [Counted(reading, self._names, *parts, batch, k) for k, parts in enumerate(own)]

    def _count_tensors(self, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        """Of tensors ``(n_learners * num_envs, T, ...)`` in the order of ``_keys``.

        Returns:
            ``(n_learners, sums)`` float64 in the order of ``_names``, and the violating robots of each step.
        """

        def blocks(x: Tensor) -> Tensor:
            return x.reshape(self.n_learners, -1)

        batch = TensorDict(dict(zip(self._keys, tensors, strict=True)), tensors[0].shape[:2])
        following = batch["next"]
        flags = [following[(*keys.VIOLATION, kind)].squeeze(-1) for kind in keys.VIOLATION_KINDS]
        found = {kind: blocks(flag).sum(-1) for kind, flag in zip(keys.VIOLATION_KINDS, flags, strict=True)}
        found["cost"] = blocks(following[keys.COVERAGE_COST]).sum(-1, dtype=torch.float64)
        found["done"] = blocks(following["done"]).any(-1)
        # finite only if all terms are; an overflow is looked at more closely
        found["finite"] = torch.stack([blocks(batch[key]).sum(-1) for key in WATCHED.values()]).isfinite().all(0)
        found |= filter_numbers(batch, self.world.max_speed, n_blocks=self.n_learners)
        self._names = list(found)
        violating = torch.stack(flags).any(dim=0).sum(-1)  # a robot may violate twice at once
        return torch.stack([value.double() for value in found.values()], dim=-1), violating


class TrainingRecorder:
    """Takes in every collected transition once.

    Args:
        world: the world.
        num_envs: number of worlds.
        device: where the per-world sums live.
    """

    def __init__(self, world: SurveillanceConfig, num_envs: int, device: torch.device | None) -> None:
        self.world = world
        self.frames = 0
        self.violations = dict.fromkeys(keys.VIOLATION_KINDS, 0)
        self.episodes = EpisodeTracker(num_envs, device)
        self.filter = FilterStatistics()
        self._recent = FilterStatistics()
        self._cost = [0.0, 0]
        self._violations_recent = dict.fromkeys(keys.VIOLATION_KINDS, 0)
        self.evaluation: dict = {}
        """Metrics of the last evaluation."""
        self.best_cost = math.inf
        """Least coverage cost of the evaluations."""

    def evaluated(self, metrics: dict) -> bool:
        """Take in the metrics of an evaluation; True if its coverage cost is the least so far."""
        self.evaluation, cost = metrics, metrics["coverage_cost"]
        if cost is None or cost >= self.best_cost:
            return False
        self.best_cost = cost
        return True

    def update(self, counted: Counted) -> bool:
        """Take in what was found in a collected batch; waits for it, and for the device where episodes end.

        Returns:
            Whether there is something in it that ought not to be: a violation, a state outside the filter's set, or a number
            that may not be finite.
        """
        found = counted.sums
        for kind in keys.VIOLATION_KINDS:
            self.violations[kind] += int(found[kind])
            self._violations_recent[kind] += int(found[kind])
        self.episodes.update(counted.reward, counted.violating, counted.done, any_done=found["done"] > 0)
        self.filter.add(found)
        self._recent.add(found)
        self._cost[0] += found["cost"]
        self._cost[1] += counted.done.numel()
        self.frames += counted.done.numel()
        return any(found[kind] > 0 for kind in (*keys.VIOLATION_KINDS, "outside")) or not found["finite"]

    def scalars(self) -> dict[str, float]:
        """Numbers since the last call, by TensorBoard tag; starts a new interval."""
        returns = self.episodes.finished["return"][-100:]
        counts = self.episodes.finished["violations"][-100:]
        recent, robot_steps = self._recent.summary(), max(self._cost[1] * self.world.n_agents, 1)
        scalars = {
            "train/episodes": self.episodes.episodes,
            "train/coverage_cost": self._cost[0] / max(self._cost[1], 1),
            **{f"train/violations_{kind}": count for kind, count in self.violations.items()},
            **{f"train/violation_rate_{kind}": count / robot_steps for kind, count in self._violations_recent.items()},
            "filter/hold_rate": recent["fallback_rate"] - recent["homing_rate"],
            **{f"filter/{name}": recent[name] for name in recent},
        }
        if returns:
            scalars["train/return"] = sum(returns) / len(returns)
            scalars["train/violations_per_episode"] = sum(counts) / len(counts)
        self._recent = FilterStatistics()
        self._cost, self._violations_recent = [0.0, 0], dict.fromkeys(keys.VIOLATION_KINDS, 0)
        return scalars

    def progress(self, scalars: dict[str, float]) -> str:
        """What the progress bar shows beside frames per second."""
        shown = f"return {scalars.get('train/return', float('nan')):.1f} J {scalars['train/coverage_cost']:.3f}"
        return f"{shown} violations {sum(self.violations.values())}"

    def summary(self) -> dict:
        """The part of summary.json that training itself decides."""
        return {
            "frames": self.frames,
            "episodes": self.episodes.episodes,
            "train": {"violations": self.violations},
            "filter": self.filter.summary(),
        }

    def state_dict(self) -> dict:
        """Everything counted so far, the running episodes too, for checkpoints."""
        return {
            "frames": self.frames,
            "violations": dict(self.violations),
            "episodes": self.episodes.state_dict(),
            "filter": self.filter.state_dict(),
            "recent": self._recent.state_dict(),
            "cost": list(self._cost),
            "violations_recent": dict(self._violations_recent),
            "evaluation": self.evaluation,
            "best_cost": self.best_cost,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.frames, self.violations, self._cost = state["frames"], dict(state["violations"]), list(state["cost"])
        self._violations_recent = dict(state["violations_recent"])
        self.evaluation, self.best_cost = state["evaluation"], state["best_cost"]
        self.episodes.load_state_dict(state["episodes"])
        self.filter.load_state_dict(state["filter"])
        self._recent.load_state_dict(state["recent"])
