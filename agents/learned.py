"""A policy trained by this pipeline to break the filter (``train.objective=adversary``), as a controller.

The package ships one for the default world, trained behind the certified filter. It was made, and is remade, by

    python train.py experiment=adversary
    python -c "from agents.learned import SHIPPED, Path, export_actor; export_actor(Path('<run folder>'), SHIPPED)"
"""

import json
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from agents.base import Controller
from agents.checkpoint import check_world, latest_checkpoint, load_checkpoint, save_checkpoint, world_sizes
from agents.config import AgentConfig
from agents.networks import make_actor
from envs import SurveillanceConfig, SurveillanceEnv, keys

SHIPPED = Path(__file__).with_name("learned_adversary.pt")
REMEDY = (
    "Train an adversary for this world with the same env options (python train.py experiment=adversary env=…) and name its "
    "run: adversary=<run folder>."
)


class Learned(Controller):
    """The actor of a training run, without noise: a deterministic function of the observations.

    Args:
        world: the world; the actor's sizes must fit it.
        seed: not used, there is no randomness.
        adversary: folder of a run of train.py, whose newest checkpoint is read; None = the shipped one.

    Raises:
        CheckpointError: if the checkpoint is missing, damaged or of another world.
    """

    def __init__(self, world: SurveillanceConfig, seed: int = 0, adversary: str | Path | None = None) -> None:
        super().__init__(world, seed)
        self.in_keys = [keys.OBSERVATION]
        path = SHIPPED if adversary is None else latest_checkpoint(Path(adversary))
        content, sizes = load_checkpoint(path), world_sizes(SurveillanceEnv(world))
        check_world(path, content["world"], sizes, REMEDY)
        state = content["actor"]
        self.actor: TensorDictModule = make_actor(sizes["n_observation"], world, actor_layers(state))
        self.actor.load_state_dict(state)
        self.actor.requires_grad_(False)

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """See the class."""
        observation = tensordict[keys.OBSERVATION]
        return self.actor.to(observation.device)(tensordict.select(keys.OBSERVATION))[keys.NOMINAL_ACTION]


def actor_layers(state: dict) -> AgentConfig:
    """Hidden units and sharing of the actor whose ``state_dict`` is ``state``."""
    layers = {int(name.split(".")[-2]): value for name, value in state.items() if name.endswith(".weight")}
    weights = [layers[k] for k in sorted(layers)]  # ([N,] out, in)
    return AgentConfig(actor_cells=[w.shape[-2] for w in weights[:-1]], share_params=weights[0].dim() == 2)


def export_actor(run: Path, path: Path) -> Path:
    """Write the actor of a finished run, and where it comes from, as a checkpoint that holds nothing else.

    Args:
        run: folder of the run.
        path: file to write.

    Returns:
        The path.
    """
    content, summary = load_checkpoint(latest_checkpoint(run)), json.loads((run / "summary.json").read_text())
    actor = {
        name: value.to(torch.float32) if isinstance(value, Tensor) and value.is_floating_point() else value
        for name, value in content["actor"].items()
    }
    small = {
        "world": content["world"],
        "actor_cells": actor_layers(actor).actor_cells,
        "actor": actor,
        "origin": {name: summary[name] for name in ("config_hash", "git_hash", "seed", "frames")},
    }
    return save_checkpoint(path, small)
