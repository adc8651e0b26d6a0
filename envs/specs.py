"""TorchRL's specs of the surveillance worlds: shapes, types and ranges of all keys."""

import torch
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from envs import keys
from envs.config import SurveillanceConfig


def make_specs(
    config: SurveillanceConfig, num_envs: int, n_observation: int, n_density: int, n_slots: int, device: torch.device
) -> tuple[Composite, Composite, Composite, Composite]:
    """Specs of ``num_envs`` worlds.

    Args:
        config: the world.
        num_envs: number of worlds B.
        n_observation: size of a robot's observation.
        n_density: parameters of a world's density.
        n_slots: slots of all stations.
        device: where the tensors live.

    Returns:
        Those of observations, actions, rewards and done flags.
    """
    b, n = num_envs, config.n_agents
    factory = {"dtype": config.torch_dtype, "device": device}

    def unbounded(*shape: int) -> Unbounded:
        return Unbounded(shape=(b, *shape), **factory)

    def flag(*shape: int) -> Binary:
        return Binary(n=1, shape=(b, *shape), dtype=torch.bool, device=device)

    def composite(**entries) -> Composite:
        return Composite(entries, shape=(b,), device=device)

    robots = composite(
        observation=unbounded(n, n_observation),
        position=unbounded(n, config.dimension),
        energy=unbounded(n, 1),
        slot=Categorical(n=n_slots, shape=(b, n, 1), dtype=torch.int64, device=device),
        violation=composite(**{kind: flag(n, 1) for kind in keys.VIOLATION_KINDS}),
    )
    observation = composite(**{keys.AGENTS: robots})
    observation[keys.COVERAGE_COST] = unbounded(1)
    observation[keys.STEP_COUNT] = Unbounded(shape=(b, 1), dtype=torch.int64, device=device)
    if n_density:
        observation[keys.DENSITY] = unbounded(n_density)
    # A box around the speed ball: the environment's actuators cut what lies outside the ball.
    speed = Bounded(-config.max_speed, config.max_speed, shape=(b, n, config.dimension), **factory)
    done = composite(**{name: flag(1) for name in ("done", "terminated", "truncated")})
    done[keys.AGENTS] = composite(**{name: flag(n, 1) for name in ("done", "terminated", "truncated")})
    return (
        observation,
        composite(**{keys.AGENTS: composite(action=speed)}),
        composite(**{keys.AGENTS: composite(reward=unbounded(n, 1))}),
        done,
    )
