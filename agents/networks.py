"""Actors and critics of all robots, each evaluated in one batched call, and the policies made of them."""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MultiAgentMLP

from agents.config import AgentConfig
from agents.foresight import Foresight
from agents.noise import ExplorationNoise, NoiseOfSeeds
from envs import SurveillanceConfig, keys
from envs.dynamics import other_indices, take
from envs.graphs import Graphed
from safety import SafetyConfig, SafetyFilter

JOINT_ACTION = ("agents", "joint_action")
STATE_ACTION_VALUE = ("agents", "state_action_value")


Layers = list[tuple[Tensor, Tensor]]
"""Weight and bias, layer by layer; with a leading dimension (N robots, K learners, or both) for several networks."""


class BatchedMLP(MultiAgentMLP):
    """``MultiAgentMLP`` evaluated as batched matrix products, with its own or other layers.

    Same parameters and same results as its ``vmap``, at a fraction of the time for networks of this size.

    Args:
        n_in: size of a robot's input.
        n_out: size of its output.
        n_agents: number of robots.
        cells: hidden units (ReLU), layer by layer.
        share_params: one network for all robots.
        n_learners: learners K, each with networks of its own.
    """

    def __init__(
        self, n_in: int, n_out: int, n_agents: int, cells: list[int], *, share_params: bool, n_learners: int = 1
    ) -> None:
        super().__init__(
            *(n_in, n_out, n_learners * (1 if share_params else n_agents) if n_learners > 1 else n_agents),
            centralized=False,  # a robot's row already holds all that it sees
            share_params=share_params and n_learners == 1,
            num_cells=cells,
            activation_class=nn.ReLU,
        )
        self.n_learners, self.shared = n_learners, share_params

    def forward(self, x: Tensor, layers: Layers | None = None) -> Tensor:
        """``(*B, N, n_in) -> (*B, N, n_out)``, several learners' batches one after the other in the first dimension of B.

        ``layers`` take the place of the own ones. Each learner's results are those of its networks alone.
        """
        layers = layers_of(self.params) if layers is None else layers
        if self.n_learners == 1:
            return self._alone(x, layers)
        shape, k = x.shape, self.n_learners
        x = x.reshape(k, -1, *shape[-2:])  # (K, M, N, n_in)
        x = x.flatten(1, 2) if self.shared else x.transpose(1, 2).flatten(0, 1)
        for layer in layers[:-1]:
            x = torch.relu(_products(x, *layer))
        weight, bias = layers[-1]
        if weight.shape[-2] > 1:
            x = _products(x, weight, bias).unflatten(0, (k, -1))
        else:  # sums over one output are added up in another order when they are batched
            own = (part.unflatten(0, (k, -1)) for part in (x, weight, bias))
            x = torch.stack([_products(*one) for one in zip(*own, strict=True)])
        x = x if self.shared else x.transpose(1, 2)  # (K, 1, M N, n_out) or (K, M, N, n_out)
        return x.reshape(*shape[:-1], x.shape[-1])

    def _alone(self, x: Tensor, layers: Layers) -> Tensor:
        if self.shared:
            for k, (weight, bias) in enumerate(layers):
                x = nn.functional.linear(x if k == 0 else torch.relu(x), weight, bias)
            return x
        batch = x.shape[:-2]
        x = x.reshape(-1, *x.shape[-2:]).transpose(0, 1)
        for k, (weight, bias) in enumerate(layers):
            x = _products(x if k == 0 else torch.relu(x), weight, bias)
        return x.transpose(0, 1).reshape(*batch, x.shape[0], x.shape[-1])


def _products(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """``(K, M, n_in), (K, n_out, n_in), (K, n_out) -> (K, M, n_out)``."""
    return torch.baddbmm(bias.unsqueeze(1), x, weight.mT)


def layers_of(params: TensorDictBase) -> Layers:
    """Weights and biases of a ``MultiAgentMLP``'s parameters, first layer first."""
    return [(params[k]["weight"], params[k]["bias"]) for k in sorted(params.keys(), key=int)]


class BallActor(nn.Module):
    """Policy networks ``pi_i(o_i)`` of all robots, squashed into the speed ball.

    ``u = max_speed tanh(||z||) z / ||z||``: smooth, and unlike a tanh per axis never outside the ball.

    Args:
        n_observation: size of a robot's observation.
        world: number of robots, dimension, speed.
        agent: layers and sharing.
        n_learners: as :class:`BatchedMLP`'s.
    """

    def __init__(self, n_observation: int, world: SurveillanceConfig, agent: AgentConfig, n_learners: int = 1) -> None:
        super().__init__()
        self.max_speed = world.max_speed
        self.net = BatchedMLP(
            *(n_observation, world.dimension, world.n_agents, list(agent.actor_cells)),
            share_params=agent.share_params,
            n_learners=n_learners,
        ).to(world.torch_dtype)
        # Small last layers: the first policies move slowly instead of at a random full speed (DDPG, section 7).
        last = str(2 * len(agent.actor_cells))
        with torch.no_grad():
            for parameter in self.net.params[last].values():
                parameter.mul_(0.1)

    def forward(self, observation: Tensor, layers: Layers | None = None) -> Tensor:
        """``(*B, N, n_obs) -> (*B, N, d)``, m/s, norm below ``max_speed``; ``layers`` as :class:`BatchedMLP`'s."""
        z = self.net(observation, layers)
        norm = (z.square().sum(-1, keepdim=True) + 1e-12).sqrt()
        return self.max_speed * torch.tanh(norm) / norm * z


class Critic(nn.Module):
    """Action values of all robots: ``Q_i(s, a_1..a_N)``, or ``Q_i(o_i, a_i)`` for independent learners.

    The state ``s`` of critic i is robot i's own observation, which holds all places and batteries, or the concatenation
    of all observations (``agent.critic_state``), and what :class:`Foresight` tells of the actions, unless
    ``agent.foresight`` is 0. Row i lists robot i first, then i+1, i+2, .. (cyclic, as the observation does), in state and
    joint action (see :func:`joint_action`), so that one network may serve all robots. Actions enter in units of
    ``max_speed``. The value starts at ``initial_reward / (1 - gamma)``.

    Args:
        n_observation: size of a robot's observation.
        world: number of robots, dimension, speed.
        agent: algorithm, state, layers and sharing.
        n_learners: as :class:`BatchedMLP`'s.
    """

    def __init__(self, n_observation: int, world: SurveillanceConfig, agent: AgentConfig, n_learners: int = 1) -> None:
        super().__init__()
        self.world = world
        self.centralized = agent.algorithm == "maddpg"
        self.concatenated = self.centralized and agent.critic_state == "concatenated"
        self.foresight = Foresight(world, agent.foresight) if agent.foresight else None
        n = world.n_agents
        n_in = (n if self.concatenated else 1) * n_observation + (n if self.centralized else 1) * world.dimension
        n_in += self.foresight.n_features if self.foresight else 0
        self.net = BatchedMLP(
            *(n_in, 1, n, list(agent.critic_cells)), share_params=agent.share_params, n_learners=n_learners
        ).to(world.torch_dtype)
        with torch.no_grad():
            self.net.params[str(2 * len(agent.critic_cells))]["bias"].add_(agent.initial_reward / (1 - agent.gamma))

    def forward(self, observation: Tensor, joint: Tensor) -> Tensor:
        """``(*B, N, n_obs), (*B, N, k) -> (*B, N, 1)``, the joint action being :func:`joint_action`'s."""
        d, n = self.world.dimension, self.world.n_agents
        own = others = joint[..., :d]
        if self.centralized and n > 1:
            others = joint[..., d : 2 * d].roll(1, dims=-2)  # robot i comes second in the row of robot i-1
        return self.values(observation, own, others)

    def values(self, observation: Tensor, own: Tensor, others: Tensor, layers: Layers | None = None) -> Tensor:
        """Action values.

        Args:
            observation: ``(*B, N, n_obs)``.
            own: ``(*B, N, d)``, actions through which row i's gradient flows, m/s.
            others: ``(*B, N, d)``, actions of the other robots, m/s; independent critics do not look at them.
            layers: as :class:`BatchedMLP`'s.

        Returns:
            ``(*B, N, 1)``.
        """
        joint = joint_action(own, others, centralized=self.centralized)
        features = [
            joint_action(observation, observation, centralized=self.concatenated),
            joint / self.world.max_speed,
        ]
        if self.foresight:
            known = others if self.centralized else torch.zeros_like(own)  # whose action one does not know, stays
            features.append(self.foresight(observation, own, known))
        return self.net(torch.cat(features, dim=-1), layers)


def joint_action(own: Tensor, others: Tensor, *, centralized: bool) -> Tensor:
    """Joint action as each robot's critic sees it: row i is ``own_i, others_{i+1}, others_{i+2}, ..`` (cyclic).

    Args:
        own: ``(*B, N, d)``, actions through which row i's gradient flows.
        others: ``(*B, N, d)``, actions of the other robots.
        centralized: False returns ``own`` (independent critics see nothing else).

    Returns:
        ``(*B, N, N d)``, or ``(*B, N, d)`` if not centralised.
    """
    if not centralized:
        return own
    rest = take(others, other_indices(own.shape[-2], own.device), -2)
    return torch.cat([own.unsqueeze(-2), rest], dim=-2).flatten(-2)


def make_actor(
    n_observation: int, world: SurveillanceConfig, agent: AgentConfig, n_learners: int = 1
) -> TensorDictModule:
    """Actor networks as a module from observation to nominal action."""
    actor = BallActor(n_observation, world, agent, n_learners)
    return TensorDictModule(actor, in_keys=[keys.OBSERVATION], out_keys=[keys.NOMINAL_ACTION])


def make_critic(
    n_observation: int, world: SurveillanceConfig, agent: AgentConfig, n_learners: int = 1
) -> TensorDictSequential:
    """Critic networks as joint action, then value."""
    critic = Critic(n_observation, world, agent, n_learners)

    def join(action: Tensor) -> Tensor:
        return joint_action(action, action, centralized=critic.centralized)

    return TensorDictSequential(
        TensorDictModule(join, in_keys=[keys.ACTION], out_keys=[JOINT_ACTION]),
        TensorDictModule(critic, in_keys=[keys.OBSERVATION, JOINT_ACTION], out_keys=[STATE_ACTION_VALUE]),
    )


class ActorsOfBlocks(nn.Module):
    """Policy networks of several learners, each for its block of the worlds: the bits that it has alone, however few worlds.

    Args:
        parts: the networks of each.
    """

    def __init__(self, parts: Sequence[nn.Module]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)

    def forward(self, observation: Tensor) -> Tensor:
        """``(B, N, n_obs) -> (B, N, d)``, m/s."""
        blocks = observation.chunk(len(self.parts))  # copied: matrix products round by where their rows lie
        return torch.cat([part(block.clone()) for part, block in zip(self.parts, blocks, strict=True)])


def actor_of_blocks(actors: Sequence[TensorDictModule]) -> TensorDictModule:
    """The actors of several learners as one, each for its block of the worlds; a single one as it is."""
    if len(actors) == 1:
        return actors[0]
    whole = ActorsOfBlocks([actor.module for actor in actors])
    return TensorDictModule(whole, in_keys=[keys.OBSERVATION], out_keys=[keys.NOMINAL_ACTION])


def acting(actor: TensorDictModuleBase, *, cuda_graphs: bool) -> TensorDictModuleBase:
    """``actor``, or if asked for its networks as a CUDA graph (:mod:`envs.graphs`), without parameters of its own."""
    if not cuda_graphs or not isinstance(actor, TensorDictModule):
        return actor
    return TensorDictModule(Graphed(actor.module), in_keys=actor.in_keys, out_keys=actor.out_keys)


def make_policies(
    actor: TensorDictModuleBase,
    world: SurveillanceConfig,
    safety: SafetyConfig,
    agent: AgentConfig,
    seed: int | list[int],
    device: torch.device,
    *,
    deployed: TensorDictModuleBase | None = None,
    compile_functions: bool = False,
    fixed_sizes: bool = False,
    cuda_graphs: bool = False,
) -> tuple[TensorDictSequential, TensorDictSequential]:
    """Deployment policy ``actor -> filter`` and exploration policy ``actor -> noise -> filter``.

    Args:
        actor: writes the nominal action.
        world: the world.
        safety: the filter.
        agent: the noise.
        seed: seed of the noise; a list: one per learner, each with its block of the worlds.
        device: of the noise's generator.
        deployed: takes the place of ``actor`` in the deployment policy.
        compile_functions: the filter's ``compile``, see :class:`safety.SafetyFilter`.
        fixed_sizes: the filter's.
        cuda_graphs: the filter's, and the networks' too.

    Returns:
        ``(policy, explore_policy)``; both execute filtered actions only.
    """
    sizes = {"fixed_sizes": fixed_sizes, "cuda_graphs": cuda_graphs}
    safety_filter = SafetyFilter(safety, world, compile=compile_functions, **sizes)
    deployed = actor if deployed is None else deployed
    deployed, actor = (acting(own, cuda_graphs=cuda_graphs) for own in (deployed, actor))
    if isinstance(seed, list):
        noise = NoiseOfSeeds([ExplorationNoise(agent, world, own, device) for own in seed])
    else:
        noise = ExplorationNoise(agent, world, seed, device)
    return TensorDictSequential(deployed, safety_filter), TensorDictSequential(actor, noise, safety_filter)
