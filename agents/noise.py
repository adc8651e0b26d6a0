"""Exploration noise on nominal actions, before the filter: of one learner, or of several, each on its block of the worlds."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from agents.config import AgentConfig
from envs import SurveillanceConfig, keys
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
        action, step = tensordict[keys.NOMINAL_ACTION], tensordict[keys.STEP_COUNT]
        return tensordict.set(keys.NOMINAL_ACTION, self.explore(action, step))

    def explore(self, action: Tensor, step: Tensor) -> Tensor:
        """``(B, N, d)`` nominal actions and ``(B, 1)`` steps since the episodes began; returns the noisy actions."""
        noise = torch.randn(action.shape, generator=self.generator, dtype=action.dtype, device=action.device)
        if self.agent.noise == "ou":
            keep = 1 - self.agent.ou_theta
            noise = noise * (1 - keep**2) ** 0.5
            if self.process is not None and self.process.shape == action.shape:
                noise = noise + keep * torch.where((step == 0).unsqueeze(-1), 0.0, self.process)
            self.process = noise
        size = self.sigma * self.max_speed * self.spread(action)
        self.frames += step.numel()
        return action + size * noise

    def spread(self, action: Tensor) -> Tensor:
        """Share of sigma for each world, evenly over ``[1 - noise_spread, 1]``, ``(*B, 1, 1)``."""
        worlds = action.shape[0]
        rank = torch.arange(1, worlds + 1, dtype=action.dtype, device=action.device) / worlds
        return (1 - self.agent.noise_spread * (1 - rank)).reshape(-1, *[1] * (action.dim() - 1))

    def get_extra_state(self) -> dict:
        """Generator, annealing and process, for checkpoints."""
        return {"generator": self.generator.get_state(), "frames": self.frames, "process": self.process}

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
        blocks = [tensordict[key].chunk(len(self.parts)) for key in (keys.NOMINAL_ACTION, keys.STEP_COUNT)]
        noisy = [noise.explore(*block) for noise, *block in zip(self.parts, *blocks, strict=True)]
        return tensordict.set(keys.NOMINAL_ACTION, torch.cat(noisy))
