"""One learner per seed, or several updated as one batch.

The tensors of stacked learners are slices of larger ones: every learner keeps modules of its own, whose parameters share
memory with the stack's, so that checkpoints and evaluations see single learners and one update serves all. Nothing is added
up across learners. On a CPU each comes out as it would alone, to the bit, where the matrix products of a batch have the bits
of single ones: so with the default's layers and robots; not with one robot, in float64 or with layers of odd sizes, where
it is to rounding.
"""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import SoftUpdate

from agents.config import AgentConfig
from agents.maddpg import MADDPGLoss, make_loss, make_optimizers, update_step
from agents.networks import make_actor, make_critic
from envs import SurveillanceConfig
from envs.graphs import Graphed
from safety import SafetyConfig

NETWORKS = (
    "actor_network_params",
    "value_network_params",
    "target_actor_network_params",
    "target_value_network_params",
)


def steps_taken(moments: Mapping) -> int:
    """Steps of an optimiser, by its state of each parameter; the same for all."""
    first = next(iter(moments.values()), None)
    return int(first["step"]) if first else 0


@dataclass
class Learner:
    """Networks, losses and optimisers of one seed, or of several stacked."""

    actor: TensorDictModule
    loss: MADDPGLoss
    optimizers: dict[str, torch.optim.Optimizer]
    target_updater: SoftUpdate

    @property
    def updates(self) -> tuple[MADDPGLoss, dict[str, torch.optim.Optimizer], SoftUpdate]:
        """What :func:`agents.maddpg.update_step` needs."""
        return self.loss, self.optimizers, self.target_updater

    @property
    def n_updates(self) -> int:
        """Updates so far, as its critics' optimiser counted them when the moments were last shared."""
        return steps_taken(self.optimizers["loss_value"].state)

    def gather_moments(self) -> None:
        """Nothing: the optimisers are the learner's own."""

    def share_moments(self) -> None:
        """Nothing, as before."""


def make_learner(
    n_observation: int,
    world: SurveillanceConfig,
    agent: AgentConfig,
    safety: SafetyConfig,
    device: torch.device,
    *,
    seed: int | None = None,
    n_learners: int = 1,
    cuda_graphs: bool = False,
) -> Learner:
    """Build a learner; with ``seed`` the global random stream starts there, which draws the initial weights.

    With ``cuda_graphs`` its update can be recorded (:func:`make_update`).
    """
    if seed is not None:
        torch.manual_seed(seed)
    actor = make_actor(n_observation, world, agent, n_learners).to(device)
    critic = make_critic(n_observation, world, agent, n_learners).to(device)
    loss, target_updater = make_loss(actor, critic, agent, safety, world)
    return Learner(actor, loss, make_optimizers(loss, agent, cuda_graphs=cuda_graphs), target_updater)


class LearnerStack(Learner):
    """Several learners as one: :func:`agents.maddpg.update_step` updates them all, each by minibatches of its own.

    Args:
        parts: the learners; their tensors become views of the stack's.
        whole: a learner made with ``n_learners=len(parts)``.
    """

    def __init__(self, parts: Sequence[Learner], whole: Learner) -> None:
        super().__init__(whole.actor, whole.loss, whole.optimizers, whole.target_updater)
        self.parts = list(parts)
        for name in NETWORKS:
            stacked = getattr(whole.loss, name)
            for key in stacked.keys(True, True):
                for part, piece in zip(self.parts, self._pieces(stacked.get(key).data), strict=True):
                    own = getattr(part.loss, name).get(key)
                    piece = piece.view(own.shape)
                    piece.copy_(own.data)
                    own.data = piece

    def gather_moments(self) -> None:
        """Take over the optimisers' moments of the parts, which were restored from checkpoints of equal age."""
        for name, optimizer in self.optimizers.items():
            for j, parameter in enumerate(optimizer.param_groups[0]["params"]):
                found = [part.optimizers[name] for part in self.parts]
                states = [own.state[own.param_groups[0]["params"][j]] for own in found]
                if not all(states):  # before the first update
                    continue
                stacked = {key: torch.stack([state[key] for state in states]) for key in states[0]}
                steps = {"step": states[0]["step"].clone()}  # the same for all
                moments = {key: value.view(parameter.shape) for key, value in stacked.items() if key != "step"}
                optimizer.state[parameter] = steps | moments
        self.share_moments()

    def share_moments(self) -> None:
        """Show each part's optimisers its slice of the moments, for checkpoints."""
        for name, optimizer in self.optimizers.items():
            for j, parameter in enumerate(optimizer.param_groups[0]["params"]):
                for key, value in optimizer.state.get(parameter, {}).items():
                    pieces = [value] * len(self.parts) if key == "step" else self._pieces(value)
                    for part, piece in zip(self.parts, pieces, strict=True):
                        own = part.optimizers[name]
                        target = own.param_groups[0]["params"][j]
                        own.state[target][key] = piece if key == "step" else piece.view(target.shape)

    def _pieces(self, stacked: Tensor) -> tuple[Tensor, ...]:
        return stacked.unflatten(0, (len(self.parts), -1)).unbind()


def make_learners(*args: object, seeds: Sequence[int], cuda_graphs: bool = False) -> tuple[list[Learner], Learner]:
    """A learner per seed, and what is updated: the only one, or their stack.

    Args:
        args: the positional arguments of :func:`make_learner`.
        seeds: one for each.
        cuda_graphs: as there.
    """
    parts = [make_learner(*args, seed=seed, cuda_graphs=cuda_graphs) for seed in seeds]  # pyright: ignore[reportArgumentType]
    if len(parts) == 1:
        return parts, parts[0]
    whole = make_learner(*args, n_learners=len(parts), cuda_graphs=cuda_graphs)  # pyright: ignore[reportArgumentType]
    return parts, LearnerStack(parts, whole)


def make_update(
    learner: Learner, agent: AgentConfig, safety: SafetyConfig, *, cuda_graphs: bool = False
) -> Callable[[Iterable[TensorDictBase]], dict[str, Tensor]]:
    """:func:`agents.maddpg.update_step` of a learner by one minibatch after the other, as a function of them.

    Args:
        learner: with ``cuda_graphs`` if asked for here.
        agent: reduction and clipping.
        safety: the filter; one inside the loss solves programs whose number depends on the data, and is not recorded.
        cuda_graphs: record the update and replay it (:mod:`envs.graphs`).

    Returns:
        A function that returns what the last update measured.
    """
    reads = learner.loss.reads

    def update_on(*tensors: Tensor, measure: bool) -> dict[str, Tensor]:
        observation = tensors[0]
        batch = TensorDict(dict(zip(reads, tensors, strict=True)), observation.shape[:-2], observation.device)
        return update_step(batch, *learner.updates, agent, measure=measure)

    steps = [functools.partial(update_on, measure=measure) for measure in (False, True)]
    if cuda_graphs and not safety.in_loss:
        steps = [Graphed(step, learns=True) for step in steps]

    def update(minibatches: Iterable[TensorDictBase]) -> dict[str, Tensor]:
        waiting: list[Tensor] = []
        for batch in minibatches:
            if waiting:
                steps[False](*waiting)
            waiting = [batch[key] for key in reads]
        return steps[True](*waiting) if waiting else {}

    return update
