"""The MADDPG update on TorchRL's ``DDPGLoss``; independent DDPG is its case without centralised critics.

Critic of robot i: ``y = r_i + gamma (1 - terminated) Q'_i(s', pi'_1(s'_1), .., pi'_N(s'_N))``, mean squared error; with
n-step targets r_i is the discounted sum of n rewards, gamma is gamma^n and s' the state n steps on (fewer at an episode's
end).
Actor of robot i: ``grad_theta_i = mean [ grad pi_i(o_i)  grad_a_i Q_i(s, a_1, .., a_N) |_{a_i = pi_i(o_i)} ]`` with the
other robots' actions taken from the replay sample.
The actions are the executed ones, as in the paper, or the nominal ones, which makes the safety filter a part of the
environment (``agent.critic_action``).

Source: Lowe et al., Multi-agent actor-critic for mixed cooperative-competitive environments, arXiv 1706.02275;
Lillicrap et al., Continuous control with deep reinforcement learning, arXiv 1509.02971.
"""

import functools
import itertools
import math

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from agents.config import AgentConfig
from agents.networks import STATE_ACTION_VALUE, Layers, layers_of
from agents.pipeline import STEPS
from envs import SurveillanceConfig, keys
from envs.dynamics import limit_speed
from safety import SafetyConfig, SafetyFilter


class MADDPGLoss(DDPGLoss):
    """``DDPGLoss`` with robot i's own actor gradient; losses keep the shape ``(batch, N)``, one entry per robot.

    Parameters, targets and keys are ``DDPGLoss``'s. The networks are evaluated on its parameters directly: passing them
    through TensorDict modules takes longer than the networks themselves.

    Args:
        actor_network: :func:`agents.networks.make_actor`, then what writes ("agents", "action").
        value_network: joint action, then critic (:func:`agents.networks.make_critic`).
        agent: gradient form, discount and correction penalty.
        max_speed: unit of the correction penalty, m/s.
        nominal: value the replay's nominal actions (cut to the speed ball) instead of its executed ones.
        filtered: ``actor_network`` ends with the filter.
    """

    def __init__(
        self,
        actor_network: TensorDictSequential,
        value_network: TensorDictSequential,
        agent: AgentConfig,
        max_speed: float,
        *,
        nominal: bool,
        filtered: bool,
    ) -> None:
        super().__init__(actor_network, value_network, delay_actor=True, delay_value=True, reduction="none")
        self.agent = agent
        self.max_speed = max_speed
        self.nominal = nominal
        self.filtered = filtered
        self.set_keys(
            state_action_value=STATE_ACTION_VALUE, reward=keys.REWARD, done=keys.DONE, terminated=keys.TERMINATED
        )
        self.make_value_estimator(ValueEstimators.TD0, gamma=agent.gamma)

    @functools.cached_property
    def layers(self) -> dict[str, Layers]:
        """Weights and biases by network; optimisers, soft update and ``load_state_dict`` write into these tensors."""
        actor, value = ("module", "0", "module", "net", "params"), ("module", "1", "module", "net", "params")
        return {
            "actor": layers_of(self.actor_network_params[actor]),
            "target_actor": layers_of(self.target_actor_network_params[actor]),
            "value": layers_of(self.value_network_params[value]),
            "target_value": layers_of(self.target_value_network_params[value]),
        }

    @property
    def reads(self) -> list[NestedKey]:
        """What :meth:`forward` reads of a minibatch."""
        state = [keys.POSITION, keys.ENERGY, keys.SLOT] if self.filtered else []
        both = [keys.OBSERVATION, *state]
        following = [*both, keys.REWARD, keys.TERMINATED]
        action = keys.NOMINAL_ACTION if self.nominal else keys.ACTION
        steps = [STEPS] if self.agent.n_steps > 1 else []
        return [*both, action, *steps, *(("next", *key) for key in following)]

    def __getstate__(self) -> dict:
        """A copy finds its own layers."""
        return {name: value for name, value in super().__getstate__().items() if name != "layers"}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses of a minibatch.

        Args:
            tensordict: ``(batch,)`` transitions.

        Returns:
            "loss_actor", "loss_value", "pred_value" and "target_value", ``(batch, N)`` each.
        """
        observation, following = tensordict[keys.OBSERVATION], tensordict["next"]
        action = tensordict[keys.NOMINAL_ACTION if self.nominal else keys.ACTION]
        action = limit_speed(action, self.max_speed) if self.nominal else action
        value = self.evaluate(self.layers["value"], observation, action, action)
        with torch.no_grad():
            next_action, _ = self.act(self.layers["target_actor"], following)
            future = self.evaluate(self.layers["target_value"], following[keys.OBSERVATION], next_action, next_action)
            steps = tensordict.get(STEPS, None)
            discount = self.agent.gamma if steps is None else self.agent.gamma ** steps.squeeze(-1)
            reward, terminated = (following[key].squeeze(-1) for key in (keys.REWARD, keys.TERMINATED))
            target = reward + torch.where(terminated, 0.0, discount * future)
        own, correction = self.act(self.layers["actor"], tensordict)
        others = action if self.agent.gradient == "per_agent" else own
        fixed = [(weight.detach(), bias.detach()) for weight, bias in self.layers["value"]]
        loss_actor = -self.evaluate(fixed, observation, own, others)
        if self.agent.correction_penalty:
            loss_actor = loss_actor + self.agent.correction_penalty * (correction / self.max_speed).square()
        return TensorDict(
            {
                "loss_actor": loss_actor,
                "loss_value": (value - target).square(),
                "pred_value": value,
                "target_value": target,
            }
        )

    def act(self, layers: Layers, tensordict: TensorDictBase) -> tuple[Tensor, Tensor | float]:
        """Actions ``(batch, N, d)`` of the policy with these layers, and what the filter corrected ``(batch, N)``."""
        actor, safety_filter = self.actor_network  # pyright: ignore[reportGeneralTypeIssues]  a TensorDictSequential
        action = actor.module(tensordict[keys.OBSERVATION], layers)
        if not self.filtered:
            return action, 0.0
        # the filter's gradients lie otherwise in memory: sums over them would depend on the number of learners
        if action.requires_grad:
            action.register_hook(torch.Tensor.contiguous)
        state = tensordict.select(keys.POSITION, keys.ENERGY, keys.SLOT).set(keys.NOMINAL_ACTION, action)
        state = safety_filter(state)
        return state[keys.ACTION], state[keys.CORRECTION].squeeze(-1)

    def evaluate(self, layers: Layers, observation: Tensor, own: Tensor, others: Tensor) -> Tensor:
        """``Q_i(s, own_i, others)`` of the critics with these layers, ``(batch, N)``."""
        critic = self.value_network[-1].module  # pyright: ignore[reportIndexIssue]
        return critic.values(observation, own, others, layers).squeeze(-1)


class LayersUpdate(SoftUpdate):
    """``SoftUpdate`` on the networks' layers: on TensorDicts it takes five times as long.

    Args:
        loss: the losses.
        tau: share of the networks that the targets take over.
    """

    def __init__(self, loss: MADDPGLoss, *, tau: float) -> None:
        super().__init__(loss, tau=tau)
        self.layers = loss.layers

    @torch.no_grad()
    def step(self) -> None:
        """Move all targets by one step."""
        for name in ("actor", "value"):
            for target, source in zip(self.layers[f"target_{name}"], self.layers[name], strict=True):
                for mine, theirs in zip(target, source, strict=True):
                    mine.lerp_(theirs, 1 - self.eps)


def check_loss(agent: AgentConfig, safety: SafetyConfig) -> None:
    """Raise a ``ValueError`` if the loss cannot be what both ask for."""
    if agent.correction_penalty and not safety.in_loss:
        raise ValueError(
            f"agent.correction_penalty={agent.correction_penalty} needs the filter inside the loss: "
            "set safety.in_loss=true, or the penalty to 0."
        )
    if agent.critic_action == "nominal" and safety.in_loss:
        raise ValueError(
            "safety.in_loss=true differentiates the value of the executed action through the filter: "
            "agent.critic_action=nominal must be executed or auto."
        )


def make_loss(
    actor: TensorDictModule,
    critic: TensorDictSequential,
    agent: AgentConfig,
    safety: SafetyConfig,
    world: SurveillanceConfig,
) -> tuple[MADDPGLoss, SoftUpdate]:
    """Loss module and target updater.

    With ``safety.in_loss`` the filter is part of the policy inside the loss and of the target policy, and the gradient
    flows through the quadratic program; otherwise the policy's nominal action stands for the executed one.

    Raises:
        ValueError: if a correction penalty is asked for without ``safety.in_loss``, or nominal actions with it.
    """
    check_loss(agent, safety)
    filtered = safety.in_loss
    unfiltered = TensorDictModule(nn.Identity(), in_keys=[keys.NOMINAL_ACTION], out_keys=[keys.ACTION])
    policy = TensorDictSequential(actor, SafetyFilter(safety, world) if filtered else unfiltered)
    nominal = agent.critic_action != "executed" and not filtered
    loss = MADDPGLoss(policy, critic, agent, world.max_speed, nominal=nominal, filtered=filtered)
    return loss, LayersUpdate(loss, tau=agent.tau)


def make_optimizers(
    loss: MADDPGLoss, agent: AgentConfig, *, cuda_graphs: bool = False
) -> dict[str, torch.optim.Optimizer]:
    """One Adam per loss key: ``{"loss_actor": .., "loss_value": ..}``; with ``cuda_graphs`` one that can be recorded."""
    networks = {
        "loss_actor": (loss.actor_network_params, agent.actor_lr),
        "loss_value": (loss.value_network_params, agent.critic_lr),
    }
    made: dict[str, torch.optim.Optimizer] = {}
    for name, (parameters, lr) in networks.items():
        weights = list(parameters.values(True, True))
        # fused: all of a step in one kernel, which reads the count of steps where the weights are
        recorded = {"fused": True, "capturable": weights[0].is_cuda} if cuda_graphs else {}
        made[name] = torch.optim.Adam(weights, lr=lr, **recorded)
        made[name].register_load_state_dict_pre_hook(_keep_own_way)
    return made


def _keep_own_way(optimizer: torch.optim.Optimizer, state_dict: dict) -> dict:
    """The state of a checkpoint for an optimiser that computes in its own way, whatever the checkpoint's did."""
    own = optimizer.param_groups[0]
    groups = [group | {name: own[name] for name in ("fused", "capturable")} for group in state_dict["param_groups"]]
    state = state_dict["state"]
    if not own["fused"]:  # the count of steps is the host's
        state = {key: moments | {"step": moments["step"].cpu()} for key, moments in state.items()}
    return state_dict | {"param_groups": groups, "state": state}


def reduce_robots(loss: Tensor, agent: AgentConfig) -> Tensor:
    """Mean over the minibatch, sum over the robots, ``(*B, batch, N) -> (*B,)``.

    With ``minibatch=per_agent`` the batch is N consecutive minibatches and robot i counts in the i-th only.
    """
    if agent.minibatch == "per_agent":
        loss = loss.unflatten(-2, (loss.shape[-1], -1)).diagonal(dim1=-3, dim2=-1)
    return loss.mean(dim=-2).sum(-1)


def clip_gradients(parameters: list[Tensor], limit: float, n_learners: int) -> Tensor:
    """Cut every learner's gradient to a norm of ``limit``; returns the norms before that, ``()``, or ``(K,)`` of several."""
    if n_learners == 1:
        gradients = [weight.grad for weight in parameters if weight.grad is not None]
        norm = nn.utils.get_total_norm(gradients)
        if limit != math.inf:
            nn.utils.clip_grads_with_norm_(parameters, limit, norm)
        return norm
    norms = []
    gradients = [weight.grad.unflatten(0, (n_learners, -1)) for weight in parameters if weight.grad is not None]
    for own in zip(*gradients, strict=True):  # one by one: its bits are those of a learner alone
        norms.append(nn.utils.get_total_norm(own))
        for gradient in own if limit != math.inf else ():
            gradient.mul_((limit / (norms[-1] + 1e-6)).clamp(max=1.0))
    return torch.stack(norms)


def update_step(
    batch: TensorDictBase,
    loss_module: MADDPGLoss,
    optimizers: dict[str, torch.optim.Optimizer],
    target_updater: SoftUpdate,
    agent: AgentConfig,
    *,
    measure: bool = True,
) -> dict[str, Tensor]:
    """One gradient step of all critics and all actors, then the soft update of the targets.

    Args:
        batch: ``(batch,)`` transitions (``N x batch`` of them with ``minibatch=per_agent``); ``(K, batch)`` for the
            networks of K learners (:mod:`agents.learners`), each updated by its own row.
        loss_module: the losses.
        optimizers: from :func:`make_optimizers`.
        target_updater: soft update of the target networks.
        agent: reduction and clipping.
        measure: otherwise return nothing, in less time.

    Returns:
        Detached losses, mean Q and target, gradient norms: ``()`` each, or ``(K,)``.
    """
    losses = loss_module(batch)
    n_learners = batch.shape[:-1].numel()
    reduced = {name: reduce_robots(losses[name], agent) for name in optimizers}
    weights = {name: optimizer.param_groups[0]["params"] for name, optimizer in optimizers.items()}
    for weight in itertools.chain(*weights.values()):  # as zero_grad, which takes ten times as long
        weight.grad = None
    torch.autograd.backward([loss.sum() for loss in reduced.values()])  # no weight is in both
    norms = {}
    for name, optimizer in optimizers.items():
        if measure or agent.max_grad_norm:
            norms[name] = clip_gradients(weights[name], agent.max_grad_norm or math.inf, n_learners)
        optimizer.step()
    target_updater.step()
    if not measure:
        return {}
    metrics = {name.removeprefix("loss_"): reduced[name].detach() for name in optimizers}
    metrics |= {f"grad_norm_{name.removeprefix('loss_')}": norm for name, norm in norms.items()}
    means = {"q_value": "pred_value", "target": "target_value"}
    return metrics | {name: losses[key].detach().mean((-2, -1)) for name, key in means.items()}
