"""NaN and infinity stop a run, with what went wrong named, before a checkpoint could hold it."""

import math

import torch
from tensordict import TensorDictBase
from torch import nn

from envs import keys

WATCHED = {
    "observations": keys.OBSERVATION,
    "nominal actions": keys.NOMINAL_ACTION,
    "executed actions": keys.ACTION,
    "next observations": ("next", *keys.OBSERVATION),
    "rewards": ("next", *keys.REWARD),
}


class DivergedError(ValueError):
    """Numbers that are not finite; the message names them and the remedy."""

    def __init__(self, frames: int, culprits: list[str]) -> None:
        super().__init__(
            f"training diverged at frame {frames}: {', '.join(culprits)} not finite. The last checkpoint is kept. Lower "
            "agent.actor_lr and agent.critic_lr, set agent.max_grad_norm, or look for a policy that produces NaN behind "
            "safety=none."
        )


def check_finite(metrics: dict[str, float], frames: int) -> None:
    """Raise :class:`DivergedError` if a number of :func:`agents.maddpg.update_step` is not finite."""
    if bad := [name for name, value in metrics.items() if not math.isfinite(value)]:
        raise DivergedError(frames, bad)


def check_batch(batch: TensorDictBase, frames: int) -> None:
    """Raise :class:`DivergedError` if a collected batch holds an observation, action or reward that is not finite."""
    finite = torch.stack([batch[key].isfinite().all() for key in WATCHED.values()])
    if not finite.all():
        raise DivergedError(frames, [name for name, good in zip(WATCHED, finite.tolist(), strict=True) if not good])


def check_weights(module: nn.Module, frames: int) -> None:
    """Raise :class:`DivergedError` if a weight of the networks or of their targets is not finite."""
    state = {name: value for name, value in module.state_dict().items() if isinstance(value, torch.Tensor)}
    if bad := [f"weights {name}" for name, value in state.items() if not value.isfinite().all()]:
        raise DivergedError(frames, bad[:3])
