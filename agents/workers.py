"""A worker: worlds that are stepped behind the filter in a process of their own, with the policy they are sent.

It answers with the batch and the state that its worlds and noise are in after it: whoever holds the last answer can start a
dead worker anew just where it was.
"""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from agents.config import AgentConfig
from agents.networks import make_actor, make_policies
from agents.noise import noises_of
from agents.pipeline import COLLECTOR_OPTIONS, InferenceCollector, use_threads
from agents.replay import flat
from envs import SurveillanceConfig, SurveillanceEnv
from safety import SafetyConfig

Weights = dict[tuple[str, ...], Tensor]


@dataclass(frozen=True)
class WorkerTask:
    """What a worker collects: a block of worlds of each seed.

    Args:
        world: the worlds.
        agent: the actors; ``noise_frames`` are the block's.
        safety: the filter.
        env_seeds: seed of each block's start states.
        noise_seeds: seed of each block's noise.
        num_envs: worlds of a block.
        steps: vector steps of a batch.
        device: where it computes.
        threads: CPU threads.
        computing: how worlds and filter compute (:attr:`agents.training_config.Config.computing`).
        deterministic: refuse operations that may differ between runs.
    """

    world: SurveillanceConfig
    agent: AgentConfig
    safety: SafetyConfig
    env_seeds: list[int]
    noise_seeds: list[int]
    num_envs: int
    steps: int
    device: str = "cpu"
    threads: int = 1
    computing: dict[str, bool] = field(default_factory=dict)
    deterministic: bool = False


class WorldsCollector(InferenceCollector):
    """TorchRL's collector in a worker, built at the first batch: an error then reaches the learner as what it is, while Ray takes
    one of a constructor for a dead worker.

    Args:
        task: a function that returns the :class:`WorkerTask` (TorchRL's collectors are given functions that make things).
        states: of :meth:`collect`, to go on from; None starts the worlds anew.
        options: TorchRL's, most of them those of its :class:`torchrl.collectors.distributed.RayCollector`.
    """

    def __init__(self, task: Callable[[], WorkerTask], *, states: bytes | None, **options: Any) -> None:
        self.closed, self.total_frames = True, 0  # what TorchRL and Ray ask of an unfinished one
        options.pop("policy_factory", None)
        self._unbuilt = (task(), states, options)

    def _build(self, task: WorkerTask, states: bytes | None, options: dict[str, Any]) -> None:
        use_threads(task.threads, deterministic=task.deterministic)
        n_blocks, device = len(task.env_seeds), torch.device(task.device)
        worlds = SurveillanceEnv(*(task.world, n_blocks * task.num_envs, device, task.env_seeds), **task.computing)
        actor = make_actor(worlds.n_observation, task.world, task.agent, n_blocks).to(device)
        _, policy = make_policies(
            *(actor, task.world, task.safety, task.agent, task.noise_seeds, device), **task.computing
        )
        self.actor_weights = weights_of(actor)
        self.noises = noises_of(policy)
        going_on: list[dict] = [] if states is None else loads(states)
        for block, state in zip(worlds.blocks, going_on, strict=bool(going_on)):
            block.continue_from(state["worlds"])
        own = {"frames_per_batch": worlds.batch_size[0] * task.steps, "total_frames": -1, "device": device}
        super().__init__(worlds, policy, **options | COLLECTOR_OPTIONS | own)
        for noise, state in zip(self.noises, going_on, strict=bool(going_on)):
            noise.set_extra_state(state["noise"])  # after the collector's trial of its policy, which draws some

    def collect(self, weights: bytes) -> bytes:
        """Collect a batch.

        Args:
            weights: pickled list of the actor's weights of each seed (:func:`weights_of`).

        Returns:
            Pickled batch (batch size and :func:`flat`) and list of each block's state after it, "worlds" and "noise".
        """
        if self._unbuilt is not None:
            self._build(*self._unbuilt)
            self._unbuilt = None
        own = loads(weights)
        for name, value in self.actor_weights.items():
            value.copy_(torch.stack([part[name] for part in own]).view_as(value))
        batch = cast(TensorDictBase, self.next())
        blocks = zip(self.env.blocks, self.noises, strict=True)
        states = [{"worlds": block.state_dict(), "noise": noise.get_extra_state()} for block, noise in blocks]
        return dumps(((list(batch.batch_size), flat(batch)), states))


def weights_of(actor: TensorDictModuleBase) -> Weights:
    """The tensors of an actor, by name; no copies."""
    return flat(TensorDict.from_module(actor).data)


def copied(weights: Weights) -> Weights:
    """Copies on the CPU, which later updates leave alone."""
    return {name: value.to("cpu", copy=True) for name, value in weights.items()}


def unflat(shape: Sequence[int], tensors: Weights) -> TensorDict:
    """The tensordict of this batch size whose tensors :func:`flat` returned."""
    rows = TensorDict(batch_size=shape)
    for name, value in tensors.items():
        rows.set(name, value)
    return rows


def dumps(tree: Any) -> bytes:
    """Pickle nested lists, tuples and dictionaries of tensors as arrays: several times faster, and of any device."""
    return pickle.dumps(_mapped(tree, lambda leaf: leaf.cpu().numpy() if isinstance(leaf, Tensor) else leaf))


def loads(data: bytes) -> Any:
    """What :func:`dumps` was given, its tensors on the CPU."""
    return _mapped(pickle.loads(data), lambda leaf: torch.from_numpy(leaf) if isinstance(leaf, np.ndarray) else leaf)


def _mapped(tree: Any, change: Callable[[Any], Any]) -> Any:
    if isinstance(tree, dict):
        return {name: _mapped(value, change) for name, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_mapped(value, change) for value in tree)
    return change(tree)
