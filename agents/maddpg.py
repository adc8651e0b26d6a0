"""The MADDPG update on TorchRL's ``DDPGLoss``; independent DDPG is its case without centralised critics.

Critic of robot i: ``y = r_i + gamma (1 - terminated) Q'_i(s', pi'_1(s'_1), .., pi'_N(s'_N))``, mean squared error.
Actor of robot i: ``grad_theta_i = mean [ grad pi_i(o_i)  grad_a_i Q_i(s, a_1, .., a_N) |_{a_i = pi_i(o_i)} ]`` with the
other robots' actions taken from the replay sample.

Source: Lowe et al., Multi-agent actor-critic for mixed cooperative-competitive environments, arXiv 1706.02275;
Lillicrap et al., Continuous control with deep reinforcement learning, arXiv 1509.02971.
"""

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from agents.config import AgentConfig
from agents.networks import JOINT_ACTION, STATE_ACTION_VALUE, joint_action
from envs import SurveillanceConfig, keys
from safety import SafetyConfig, SafetyFilter


class DivergedError(ValueError):
    """Losses or gradients that are not finite; the message names them and the remedy."""


def check_finite(metrics: dict[str, float], frames: int) -> None:
    """Raise :class:`DivergedError` if a number of :func:`update_step` is not finite."""
    bad = [name for name, value in metrics.items() if not math.isfinite(value)]
    if bad:
        raise DivergedError(
            f"training diverged at frame {frames}: {', '.join(bad)} not finite. The last checkpoint is kept. Lower agent.actor_lr "
            "and agent.critic_lr, set agent.max_grad_norm, or look for a policy that produces NaN behind safety=none."
        )


class MADDPGLoss(DDPGLoss):
    """``DDPGLoss`` with robot i's own actor gradient; losses keep the shape ``(batch, N)``, one entry per robot.

    Args:
        actor_network: policy that writes ("agents", "action").
        value_network: joint action, then critic (``make_critic``).
        agent: gradient form, discount and correction penalty.
        max_speed: unit of the correction penalty, m/s.
    """

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        value_network: TensorDictSequential,
        agent: AgentConfig,
        max_speed: float,
    ) -> None:
        super().__init__(actor_network, value_network, delay_actor=True, delay_value=True, reduction="none")
        self.agent = agent
        self.max_speed = max_speed
        self.set_keys(
            state_action_value=STATE_ACTION_VALUE, reward=keys.REWARD, done=keys.DONE, terminated=keys.TERMINATED
        )
        self.make_value_estimator(ValueEstimators.TD0, gamma=agent.gamma)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict]:
        """``-Q_i`` at the own action, ``(batch, N)``; see the module's formula."""
        replay_action = tensordict[keys.ACTION].detach()
        td = tensordict.select(*self.actor_in_keys, keys.OBSERVATION).detach()
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            td = self.actor_network(td)
        action = td[keys.ACTION]
        others = replay_action if self.agent.gradient == "per_agent" else action
        td.set(JOINT_ACTION, joint_action(action, others, centralized=self.agent.algorithm == "maddpg"))
        with self._cached_detached_value_params.to_module(self.value_network, preserve_module_state=False):
            td = self.value_network[-1](td)  # pyright: ignore[reportIndexIssue]  the critic alone: the joint action is there
        loss = -td[STATE_ACTION_VALUE].squeeze(-1)
        if self.agent.correction_penalty:
            loss = loss + self.agent.correction_penalty * (td[keys.CORRECTION] / self.max_speed).square().squeeze(-1)
        return loss, {}


def check_penalty(agent: AgentConfig, safety: SafetyConfig) -> None:
    """Raise a ``ValueError`` if a correction penalty is asked for while the loss does not contain the filter."""
    if agent.correction_penalty and not safety.in_loss:
        raise ValueError(
            f"agent.correction_penalty={agent.correction_penalty} needs the filter inside the loss: "
            "set safety.in_loss=true, or the penalty to 0."
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
    flows through the quadratic program; otherwise the nominal action stands for the executed one.

    Raises:
        ValueError: if a correction penalty is asked for without ``safety.in_loss``.
    """
    check_penalty(agent, safety)
    if safety.in_loss:
        executed: TensorDictModuleBase = SafetyFilter(safety, world)
    else:
        executed = TensorDictModule(nn.Identity(), in_keys=[keys.NOMINAL_ACTION], out_keys=[keys.ACTION])
    loss = MADDPGLoss(TensorDictSequential(actor, executed), critic, agent, world.max_speed)
    return loss, SoftUpdate(loss, tau=agent.tau)


def make_optimizers(loss: MADDPGLoss, agent: AgentConfig) -> dict[str, torch.optim.Optimizer]:
    """One Adam per loss key: ``{"loss_actor": .., "loss_value": ..}``."""
    return {
        "loss_actor": torch.optim.Adam(list(loss.actor_network_params.values(True, True)), lr=agent.actor_lr),
        "loss_value": torch.optim.Adam(list(loss.value_network_params.values(True, True)), lr=agent.critic_lr),
    }


def reduce_robots(loss: Tensor, agent: AgentConfig) -> Tensor:
    """Mean over the minibatch, sum over the robots (each has its own parameters), ``(batch, N) -> ()``.

    With ``minibatch=per_agent`` the batch is N consecutive minibatches and robot i counts in the i-th only.
    """
    if agent.minibatch == "per_agent":
        n = loss.shape[-1]
        return loss.unflatten(0, (n, -1)).diagonal(dim1=0, dim2=-1).mean(dim=0).sum()
    return loss.mean(dim=0).sum()


def update_step(
    batch: TensorDictBase,
    loss_module: MADDPGLoss,
    optimizers: dict[str, torch.optim.Optimizer],
    target_updater: SoftUpdate,
    agent: AgentConfig,
) -> dict[str, Tensor]:
    """One gradient step of all critics and all actors, then the soft update of the targets.

    Args:
        batch: ``(batch,)`` transitions (``N x batch`` of them with ``minibatch=per_agent``).
        loss_module: the losses.
        optimizers: from :func:`make_optimizers`.
        target_updater: soft update of the target networks.
        agent: reduction and clipping.

    Returns:
        Detached scalars: losses, mean Q and target, gradient norms.
    """
    losses = loss_module(batch)
    metrics: dict[str, Tensor] = {
        "q_value": losses["pred_value"].detach().mean(),
        "target": losses["target_value"].detach().mean(),
    }
    for name, optimizer in optimizers.items():  # only loss_* keys: pred_value carries a graph too
        loss = reduce_robots(losses[name], agent)
        optimizer.zero_grad()
        loss.backward()
        parameters = optimizer.param_groups[0]["params"]
        limit = agent.max_grad_norm or float("inf")
        metrics[f"grad_norm_{name.removeprefix('loss_')}"] = nn.utils.clip_grad_norm_(parameters, limit)
        optimizer.step()
        metrics[name.removeprefix("loss_")] = loss.detach()
    target_updater.step()
    return metrics
