"""Blocks of an environment's worlds that have a random generator each: several seeds step as one batch.

Block k of an environment with K seeds is its k-th K-th part of the worlds. It draws the same start states as an environment
of its own with that seed, and its state is the state of that environment: checkpoints fit both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.randomness import restore_generator

if TYPE_CHECKING:
    from envs.surveillance import SurveillanceEnv


class WorldBlock:
    """Block ``k`` of an environment's worlds.

    Args:
        env: the environment.
        k: which block.
        generator: its random generator.
    """

    def __init__(self, env: SurveillanceEnv, k: int, generator: torch.Generator) -> None:
        self.env, self.generator = env, generator
        size = env.batch_size[0] // env.n_blocks
        self.worlds = slice(k * size, (k + 1) * size)

    def draw_index(self, mask: Tensor) -> Tensor:
        """Indices ``(M,)``, among all worlds, of the block's worlds in ``mask`` ``(B,)``."""
        return mask[self.worlds].nonzero().squeeze(-1) + self.worlds.start

    def state_dict(self) -> dict:
        """State of the block's worlds and of its generator: restoring it continues the same random stream."""
        return {"state": self.env.state[self.worlds].clone().to_dict(), "generator": self.generator.get_state()}

    def load_state_dict(self, state_dict: dict) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if the state belongs to another world or another number of worlds.
        """
        given, own = TensorDict(state_dict["state"], []), self.env.state[self.worlds]
        for name, value in own.items():
            if name not in given or given[name].shape != value.shape:
                raise ValueError(
                    f"state {name!r} has shape {tuple(given[name].shape) if name in given else None}, this environment needs "
                    f"{tuple(value.shape)}: the checkpoint is of another world or another collector.num_envs."
                )
        for name in own.keys():  # noqa: SIM118  a TensorDict iterates over its rows
            value = self.env.state[name].clone()
            value[self.worlds] = given[name].to(value)
            self.env.state[name] = value
        self.env.sure_steps = 0.0
        restore_generator(self.generator, state_dict["generator"])

    def continue_from(self, state_dict: dict) -> None:
        """:meth:`load_state_dict`, and the next reset of all worlds returns their state instead of drawing start states.

        So a collector, which begins with a reset, goes on where another one was stopped.

        Raises:
            ValueError: as :meth:`load_state_dict`.
        """
        self.load_state_dict(state_dict)
        self.env.continue_at_reset()
