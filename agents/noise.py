"""Exploration noise on nominal actions, before the filter: of one learner, or of several, each on its block of the worlds."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from agents.config import AgentConfig
from envs import SurveillanceConfig, keys
from envs.dynamics import constant
from envs.randomness import restore_generator


class ExplorationNoise(TensorDictModuleBase):
    """Adds exploration noise to the nominal action, before the filter; restarted at each episode, annealed in frames.

    Gaussian: ``sigma xi``. Ornstein-Uhlenbeck: ``n+ = (1 - theta) n + sigma sqrt(1 - (1 - theta)^2) xi``, so that sigma
    is its stationary standard deviation too. With ``agent.noise_spread`` every world has a size of its own (as the actors
    of Horgan et al., Distributed prioritized experience replay, arXiv 1803.00933).

    Args:
        agent: kind, size and annealing.
        world: unit of the noise (max_speed).
        seed: seed of its own generator.
        device: where the generator lives.
    """

    def __init__(
        self, agent: AgentConfig, world: SurveillanceConfig, seed: int, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__()
        self.in_keys = [keys.NOMINAL_ACTION, keys.STEP_COUNT]
        self.out_keys = [keys.NOMINAL_ACTION]
        self.agent = agent
        self.max_speed = world.max_speed
        self.generator = torch.Generator(device=device).manual_seed(seed)
        self.frames = 0
        self.process: Tensor | None = None

    @property
    def sigma(self) -> float:
        """Standard deviation now, share of ``max_speed``."""
        agent = self.agent
        progress = min(1.0, self.frames / agent.noise_frames) if agent.noise_frames else 1.0
        return agent.noise_initial + progress * (agent.noise_final - agent.noise_initial)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add noise to ("agents", "nominal_action") in place of it."""
        return explore([self], tensordict)

    def get_extra_state(self) -> dict:
        """Generator, annealing and process, for checkpoints."""
        return {
            "generator": self.generator.get_state(),
            "frames": self.frames,
            "process": None if self.process is None else self.process.clone(),
        }

    def set_extra_state(self, state: dict) -> None:
        """Restore what :meth:`get_extra_state` returned."""
        restore_generator(self.generator, state["generator"])
        self.frames, process = state["frames"], state["process"]
        self.process = None if process is None else process.to(self.generator.device)


def noises_of(policy: nn.Module) -> list[ExplorationNoise]:
    """The exploration noise in a policy, one per learner."""
    return [module for module in policy.modules() if isinstance(module, ExplorationNoise)]


class NoiseOfSeeds(TensorDictModuleBase):
    """Exploration noise of several learners, each on its block of the worlds.

    Args:
        parts: the noise of each.
    """

    def __init__(self, parts: list[ExplorationNoise]) -> None:
        super().__init__()
        self.in_keys, self.out_keys = parts[0].in_keys, parts[0].out_keys
        self.parts = nn.ModuleList(parts)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add noise to ("agents", "nominal_action") in place of it."""
        return explore(list(self.parts), tensordict)


def explore(parts: list[ExplorationNoise], tensordict: TensorDictBase) -> TensorDictBase:
    """Add the noise of learners, who have all seen as many frames, to the nominal actions of their blocks of the worlds.

    Args:
        parts: the noise of each.
        tensordict: nominal actions ``(B, N, d)`` and steps since the episodes began ``(B, 1)``.
    """
    first, action, step = parts[0], tensordict[keys.NOMINAL_ACTION], tensordict[keys.STEP_COUNT]
    if any(part.frames != first.frames for part in parts):
        raise ValueError(f"the learners' noise has seen {[part.frames for part in parts]} frames: they go on together.")
    noise = torch.empty_like(action, memory_format=torch.contiguous_format)
    blocks = noise.chunk(len(parts))
    for part, block in zip(parts, blocks, strict=True):
        torch.randn(block.shape, generator=part.generator, out=block)
    if first.agent.noise == "ou":
        keep = 1 - first.agent.ou_theta
        noise = noise * (1 - keep**2) ** 0.5
        before = [part.process for part in parts if part.process is not None]
        if len(before) == len(parts) and before[0].shape == blocks[0].shape:
            whole = before[0] if len(before) == 1 else torch.cat(before)
            noise = noise + keep * torch.where((step == 0).unsqueeze(-1), 0.0, whole)
        for part, block in zip(parts, noise.chunk(len(parts)), strict=True):
            part.process = block
    spread = spread_of_worlds(
        len(action) // len(parts), len(parts), first.agent.noise_spread, action.dtype, action.device
    )
    size = first.sigma * first.max_speed * spread
    for part in parts:
        part.frames += step.numel() // len(parts)
    return tensordict.set(keys.NOMINAL_ACTION, action + size * noise)


@constant
def spread_of_worlds(worlds: int, copies: int, noise_spread: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Share of sigma for each world, evenly over ``[1 - noise_spread, 1]``, of so many blocks, ``(copies * worlds, 1, 1)``."""
    rank = torch.arange(1, worlds + 1, dtype=dtype, device=device) / worlds
    return (1 - noise_spread * (1 - rank)).repeat(copies).reshape(-1, 1, 1)
