"""What is measured: violations on the raw state, charges, episodes. Nothing here knows of the filter.

All comparisons are written so that NaN counts as a violation.
"""

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from envs.config import SurveillanceConfig
from envs.keys import VIOLATION_KINDS


def violations(
    position: Tensor, next_position: Tensor, next_energy: Tensor, slots: Tensor, config: SurveillanceConfig
) -> dict[str, Tensor]:
    """Violation flags of one transition, with tolerance zero, from the raw next state.

    depleted: ``E < E_min``. overcharged: ``E > E_max``. collision: two robots came closer than ``safety_distance``
    anywhere on the step's straight segments (both count). stranded: less energy left than the fastest way to the
    nearest slot's break-even circle costs.

    Args:
        position: ``(*B, N, d)``, m, before the step.
        next_position: ``(*B, N, d)``, m.
        next_energy: ``(*B, N)``.
        slots: ``(S, d)``, m.
        config: the world.

    Returns:
        ``{kind: (*B, N) bool}`` for the kinds of :data:`envs.keys.VIOLATION_KINDS`.
    """
    way = _length(next_position.unsqueeze(-2) - slots).amin(dim=-1)
    needed = config.drain_rate * (way - config.break_even_radius).clamp_min(0) / config.max_speed
    close = ~(_step_gap(position, next_position) >= config.safety_distance)
    i, j = _pairs(position.shape[-2], position.device)
    collision = torch.zeros_like(next_energy, dtype=torch.int64)
    collision = collision.index_add(-1, i, close.to(torch.int64)).index_add(-1, j, close.to(torch.int64))
    flags = (
        ~(next_energy >= config.energy_min),
        ~(next_energy - config.energy_min >= needed),
        ~(next_energy <= config.energy_max),
        collision > 0,
    )
    return dict(zip(VIOLATION_KINDS, flags, strict=True))


@functools.cache  # for good, as a recording knows them by their addresses
@torch.inference_mode(mode=False)
def _made_pairs(n_agents: int, device: torch.device) -> tuple[Tensor, Tensor]:
    i, j = torch.triu_indices(n_agents, n_agents, offset=1, device=device)
    return i, j


@torch.compiler.assume_constant_result
def _pairs(n_agents: int, device: torch.device) -> tuple[Tensor, Tensor]:
    return _made_pairs(n_agents, device)


def _length(x: Tensor) -> Tensor:
    """Norm over the last dimension; sums over the short dimension itself are slow."""
    return sum(component.square() for component in x.unbind(-1)).sqrt()


def _step_gap(position: Tensor, next_position: Tensor) -> Tensor:
    """Least distance of every pair of robots over the step, ``(*B, P)``: closest point of the relative segment to 0."""
    i, j = _pairs(position.shape[-2], position.device)
    start = position[..., i, :] - position[..., j, :]
    move = next_position[..., i, :] - next_position[..., j, :] - start
    long = move.square().sum(-1)
    t = torch.where(long > 0, -(start * move).sum(-1) / long.clamp_min(1e-30), torch.zeros_like(long)).clamp(0, 1)
    return _length(start + t.unsqueeze(-1) * move)


def minimum_distance(position: Tensor, next_position: Tensor) -> Tensor:
    """Least distance of any two robots over the step, ``(*B,)``, m; inf for one robot."""
    gap = _step_gap(position, next_position)
    return torch.nn.functional.pad(gap, (0, 1), value=torch.inf).amin(dim=-1)


class Charges(NamedTuple):
    """Charges so far: intervals of rising energy that gain at least 20 % of the battery's range."""

    start: Tensor
    """Energy where the interval began, ``(B, N)``."""
    counted: Tensor
    """Whether the interval has been counted, ``(B, N)`` bool."""
    count: Tensor
    """``(B, N)`` int64."""

    @classmethod
    def none(cls, energy: Tensor) -> "Charges":
        """Before the first step, of robots with ``energy`` ``(B, N)``."""
        return cls(
            energy.clone(), torch.zeros_like(energy, dtype=torch.bool), torch.zeros_like(energy, dtype=torch.int64)
        )

    def after(self, energy: Tensor, next_energy: Tensor, alive: Tensor, config: SurveillanceConfig) -> "Charges":
        """With one transition taken in, ``(B, N)`` each; ``alive`` ``(B, 1)`` masks worlds that have ended."""
        threshold = 0.2 * (config.energy_max - config.energy_min)
        rising = next_energy > energy
        counted = self.counted & rising  # a pause ends the interval
        start = torch.where(rising, self.start, next_energy)
        reached = rising & ~counted & (next_energy - start >= threshold) & alive
        return Charges(start, counted | reached, self.count + reached)

    def restarted(self, energy: Tensor, worlds: Tensor) -> "Charges":
        """Begun anew in the ``worlds`` ``(B, 1)`` bool, whose robots now have ``energy`` ``(B, N)``; the counts stay."""
        return Charges(torch.where(worlds, energy, self.start), self.counted & ~worlds, self.count)


class EpisodeTracker:
    """Sums reward and violations per world until its episode ends, and keeps the finished episodes in order."""

    def __init__(self, num_envs: int, device: torch.device | None = None) -> None:
        self.reward = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self.violations = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.finished: dict[str, list[float]] = {"return": [], "violations": []}

    def update(self, reward: Tensor, violations: Tensor, done: Tensor, *, any_done: bool = True) -> None:
        """Take in transitions in order of time.

        Args:
            reward: ``(B, T)``, team reward.
            violations: ``(B, T)``, violating robot-steps.
            done: ``(B, T)`` bool.
            any_done: False if it is known that none is: the device is then not asked.
        """
        for r, v, d in zip(reward.unbind(1), violations.unbind(1), done.unbind(1), strict=True):
            self.reward += r
            self.violations += v
            if any_done and d.any():
                self.finished["return"] += self.reward[d].tolist()
                self.finished["violations"] += self.violations[d].tolist()
                self.reward[d] = 0
                self.violations[d] = 0

    @property
    def episodes(self) -> int:
        """Number of finished episodes."""
        return len(self.finished["return"])

    def state_dict(self) -> dict:
        """Sums of the running episodes and all finished ones, for checkpoints."""
        finished = {name: list(rows) for name, rows in self.finished.items()}
        return {"reward": self.reward.clone(), "violations": self.violations.clone(), "finished": finished}

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.reward.copy_(state["reward"])
        self.violations.copy_(state["violations"])
        self.finished = {name: list(rows) for name, rows in state["finished"].items()}
