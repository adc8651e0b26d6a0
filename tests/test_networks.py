"""Actors, critics, the joint action and the exploration noise."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MultiAgentMLP

from agents import AgentConfig
from agents.networks import (
    JOINT_ACTION,
    STATE_ACTION_VALUE,
    BallActor,
    BatchedMLP,
    Critic,
    joint_action,
    make_actor,
    make_critic,
    make_policies,
)
from agents.noise import ExplorationNoise, NoiseOfSeeds
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

torch.set_num_threads(1)
N_OBS, B = 11, 5
RAW = {"critic_state": "concatenated", "foresight": 0}  # observations of any size, all of them
SHARED = pytest.mark.parametrize("share", [False, True])
DIMENSIONS = pytest.mark.parametrize("d", [2, 3])


def world_of(d=2, **fields):
    return SurveillanceConfig(dimension=d, **fields)


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def seeded(make, *args):
    torch.manual_seed(0)
    return make(*args)


# ---- actors ----------------------------------------------------------------------------------------------------------
@DIMENSIONS
def test_actor_stays_in_the_ball(d):
    actor = seeded(BallActor, N_OBS, world_of(d, max_speed=0.3), AgentConfig())
    calm, wild = actor(randn(200, 3, N_OBS)), actor(1e4 * randn(200, 3, N_OBS))
    assert calm.shape == (200, 3, d)
    assert calm.norm(dim=-1).max() < 0.3
    assert wild.norm(dim=-1).max() <= 0.3 * (1 + 1e-6)
    assert wild.norm(dim=-1).min() > 0.29  # full speed can be reached
    assert actor(torch.zeros(3, N_OBS)).isfinite().all()


def test_first_policy_is_slow():
    actor = seeded(BallActor, N_OBS, world_of(max_speed=0.3), AgentConfig())
    assert actor(randn(500, 3, N_OBS)).norm(dim=-1).mean() < 0.1 * 0.3


@SHARED
def test_parameters_are_shared_only_on_request(share):
    agent = AgentConfig(share_params=share)
    observation = randn(B, 1, N_OBS).expand(B, 3, N_OBS)
    action = seeded(BallActor, N_OBS, world_of(), agent)(observation)
    value = seeded(Critic, N_OBS, world_of(), agent)(observation, randn(B, 1, 6).expand(B, 3, 6))
    for output in (action, value):
        same = [torch.allclose(output[:, 0], output[:, j]) for j in (1, 2)]
        assert same == [share, share]


def test_robot_acts_on_its_own_observation_alone():
    actor = seeded(BallActor, N_OBS, world_of(), AgentConfig())
    observation = randn(B, 3, N_OBS)
    changed = observation.clone()
    changed[:, 1] += 1
    difference = (actor(changed) - actor(observation)).abs().sum((0, 2))
    assert difference[0] == difference[2] == 0
    assert difference[1] > 0


def test_layers_and_type_follow_the_configuration():
    agent = AgentConfig(actor_cells=[7, 5, 4], critic_cells=[9], **RAW)
    world = world_of(dtype="float64")
    actor, critic = BallActor(N_OBS, world, agent), Critic(N_OBS, world, agent)
    shapes = sorted(tuple(p.shape) for p in actor.parameters() if p.ndim == 3)
    assert shapes == sorted([(3, 7, N_OBS), (3, 5, 7), (3, 4, 5), (3, 2, 4)])
    shapes = sorted(tuple(p.shape) for p in critic.parameters() if p.ndim == 3)
    assert shapes == sorted([(3, 9, 3 * (N_OBS + 2)), (3, 1, 9)])
    assert all(p.dtype == torch.float64 for p in (*actor.parameters(), *critic.parameters()))


# ---- joint action and critics ----------------------------------------------------------------------------------------
@DIMENSIONS
def test_joint_action_replaces_the_own_entry_only_and_puts_it_first(d):
    own, others = randn(B, 4, d), randn(B, 4, d, seed=1)
    joint = joint_action(own, others, centralized=True)
    assert joint.shape == (B, 4, 4 * d)
    for i in range(4):
        expected = others.clone()
        expected[:, i] = own[:, i]
        assert torch.equal(joint[:, i], expected.roll(-i, 1).reshape(B, 4 * d))
    assert torch.equal(joint_action(own, others, centralized=False), own)


@SHARED
def test_networks_are_torchrls(share):
    inputs = randn(B, 3, N_OBS)
    net = BatchedMLP(N_OBS, 2, 3, [7, 5], share_params=share)
    twin = MultiAgentMLP(N_OBS, 2, 3, centralized=False, share_params=share, num_cells=[7, 5], activation_class=nn.ReLU)
    twin.load_state_dict(net.state_dict())
    for x in (inputs, inputs[0], inputs[:0], inputs.reshape(1, B, 3, N_OBS)):
        torch.testing.assert_close(net(x), twin(x), rtol=1e-5, atol=1e-6)
    gradients = [torch.autograd.grad(n(inputs).square().sum(), list(n.parameters())) for n in (net, twin)]
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_values_start_at_the_expected_return():
    agents = AgentConfig(initial_reward=0.0, **RAW), AgentConfig(initial_reward=-0.5, gamma=0.98, **RAW)
    plain, shifted = (seeded(Critic, N_OBS, world_of(), agent) for agent in agents)
    observation, joint = randn(B, 3, N_OBS), randn(B, 3, 6)
    torch.testing.assert_close(shifted(observation, joint), plain(observation, joint) - 25.0)


def critic_gradients(algorithm):
    """|dQ_i / d observation_j| and |dQ_i / d action_j|, two (3, 3) matrices."""
    critic = seeded(make_critic, N_OBS, world_of(), AgentConfig(algorithm=algorithm, **RAW))
    td = TensorDict({keys.OBSERVATION: randn(B, 3, N_OBS), keys.ACTION: 0.1 * randn(B, 3, 2, seed=1)}, [B])
    for key in (keys.OBSERVATION, keys.ACTION):
        td[key].requires_grad_()
    value = critic(td)[STATE_ACTION_VALUE]
    assert value.shape == (B, 3, 1)
    rows = [
        torch.autograd.grad(value[:, i].sum(), [td[keys.OBSERVATION], td[keys.ACTION]], retain_graph=True)
        for i in range(3)
    ]
    return [torch.stack([row[k].abs().sum((0, 2)) for row in rows]) for k in range(2)]


def test_centralised_critic_sees_everybody():
    for matrix in critic_gradients("maddpg"):
        assert (matrix > 0).all()


def test_independent_critic_sees_itself_alone():
    itself = torch.eye(3, dtype=torch.bool)
    for matrix in critic_gradients("ddpg"):
        assert (matrix[itself] > 0).all()
        assert (matrix[~itself] == 0).all()


def test_critic_reads_actions_in_units_of_the_speed_limit():
    agent = AgentConfig(**RAW)
    slow, fast = (seeded(make_critic, N_OBS, world_of(max_speed=v), agent) for v in (0.2, 0.1))
    observation, action = randn(B, 3, N_OBS), 0.1 * randn(B, 3, 2, seed=1)
    values = [
        critic(TensorDict({keys.OBSERVATION: observation, keys.ACTION: a}, [B]))[STATE_ACTION_VALUE]
        for critic, a in ((slow, action), (fast, action / 2))
    ]
    torch.testing.assert_close(*values)
    td = TensorDict({keys.OBSERVATION: observation, keys.ACTION: action}, [B])
    assert torch.equal(slow(td)[JOINT_ACTION][:, 0], action.flatten(-2))


# ---- exploration noise -----------------------------------------------------------------------------------------------
def noise_of(kind="gaussian", *, seed=0, initial=0.5, final=0.5, frames=100, **fields):
    fields = {"noise_spread": 0.0} | fields
    agent = AgentConfig(noise=kind, noise_initial=initial, noise_final=final, noise_frames=frames, **fields)
    return ExplorationNoise(agent, world_of(max_speed=0.4, dt=0.1), seed)


def draw(noise, step, worlds=B, nominal=0.0):
    """Noise added to one vector step, ``(worlds, 3, 2)``; ``step`` is a number or ``(worlds, 1)``."""
    step = step if torch.is_tensor(step) else torch.full((worlds, 1), step)
    action = torch.full((len(step), 3, 2), nominal)
    td = TensorDict({keys.NOMINAL_ACTION: action, keys.STEP_COUNT: step}, [len(step)])
    return noise(td)[keys.NOMINAL_ACTION] - nominal


@pytest.mark.parametrize("kind", ["gaussian", "ou"])
def test_noise_has_its_own_generator(kind):
    torch.manual_seed(1)
    before = torch.get_rng_state()
    a, b, c = noise_of(kind, seed=5), noise_of(kind, seed=5), noise_of(kind, seed=6)
    for step in range(3):
        x, y, z = draw(a, step), draw(b, step), draw(c, step)
        assert torch.equal(x, y)
        assert not torch.equal(x, z)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("kind", ["gaussian", "ou"])
def test_noise_is_spread_over_the_worlds(kind):
    """Evenly from (1 - spread) sigma, not included, up to sigma; a world alone gets all of it."""
    noise = noise_of(kind, noise_spread=0.8)
    samples = torch.stack([draw(noise, k, worlds=4) for k in range(3000)])
    for world, share in enumerate((0.4, 0.6, 0.8, 1.0)):
        assert samples[:, world].std().item() == pytest.approx(share * 0.5 * 0.4, rel=0.05)
    alone, plain = noise_of(kind, noise_spread=1.0), noise_of(kind)
    assert torch.equal(draw(alone, 0, worlds=1), draw(plain, 0, worlds=1))


@pytest.mark.parametrize("kind", ["gaussian", "ou"])
def test_noise_has_the_stated_standard_deviation(kind):
    noise = noise_of(kind)
    for step in range(40):  # the OU process forgets its start
        sample = draw(noise, step, worlds=3000, nominal=0.1)
    assert sample.std().item() == pytest.approx(0.5 * 0.4, rel=0.03)
    assert abs(sample.mean().item()) < 0.01


def correlation(x, y):
    return ((x * y).mean() / (x.square().mean() * y.square().mean()).sqrt()).item()


@pytest.mark.parametrize("kind", ["gaussian", "ou"])
def test_noise_of_several_learners_is_that_of_each_alone(kind):
    fields = {"noise_spread": 0.7, "initial": 1.0, "final": 0.2, "frames": 60}
    alone, parts = ([noise_of(kind, seed=seed, **fields) for seed in (3, 8)] for _ in range(2))
    together = NoiseOfSeeds(parts)
    for k in range(12):
        if k == 5:  # as from a checkpoint
            for part in parts:
                part.set_extra_state(part.get_extra_state())
        step = 0 if k in (0, 7) else k
        both = draw(together, step, worlds=8)
        assert torch.equal(both, torch.cat([draw(noise, step, worlds=4) for noise in alone]))
        assert [part.frames for part in parts] == [noise.frames for noise in alone]
    assert both.abs().max() > 0
    for process in (part.get_extra_state()["process"] for part in parts if kind == "ou"):
        assert process.untyped_storage().nbytes() == process.nbytes  # a checkpoint holds nothing of the others
    parts[1].frames += 4
    with pytest.raises(ValueError, match=r"\[48, 52\] frames"):
        draw(together, 1, worlds=8)


def test_gaussian_noise_is_white_and_ou_is_not():
    for kind, expected in (("gaussian", 0.0), ("ou", 0.8)):
        noise = noise_of(kind, ou_theta=0.2)
        for step in range(30):
            draw(noise, step, worlds=2000)
        assert correlation(draw(noise, 30, 2000), draw(noise, 31, 2000)) == pytest.approx(expected, abs=0.03)


def test_ou_noise_restarts_with_each_episode():
    noise = noise_of("ou", ou_theta=0.2)
    for step in range(30):
        before = draw(noise, step, worlds=4000)
    fresh = torch.arange(4000) % 2 == 0
    after = draw(noise, torch.where(fresh, 0, 30)[:, None])
    assert correlation(before[fresh], after[fresh]) == pytest.approx(0.0, abs=0.03)
    assert correlation(before[~fresh], after[~fresh]) == pytest.approx(0.8, abs=0.03)
    assert after[fresh].std().item() == pytest.approx(0.2 * (1 - 0.8**2) ** 0.5, rel=0.04)  # it starts at 0


def test_noise_is_annealed_in_frames():
    noise = noise_of(initial=0.6, final=0.1, frames=100)
    assert noise.sigma == pytest.approx(0.6)
    for _ in range(4):
        draw(noise, 1, worlds=10)
    assert noise.frames == 40
    assert noise.sigma == pytest.approx(0.4)
    for _ in range(20):
        draw(noise, 1, worlds=10)
    assert noise.sigma == pytest.approx(0.1)
    assert noise_of(initial=0.6, final=0.1, frames=0).sigma == pytest.approx(0.1)


@pytest.mark.parametrize("kind", ["gaussian", "ou"])
def test_noise_continues_from_its_state(kind):
    noise = noise_of(kind, initial=0.6, final=0.1, frames=60)
    for step in range(4):
        draw(noise, step)
    other = noise_of(kind, seed=99, initial=0.6, final=0.1, frames=60)
    other.set_extra_state(noise.get_extra_state())
    for step in range(4, 8):
        assert torch.equal(draw(noise, step), draw(other, step))


# ---- policies --------------------------------------------------------------------------------------------------------
def policies(noise=3.0, **safety):
    world = SurveillanceConfig()
    agent = AgentConfig(noise="gaussian", noise_initial=noise, noise_final=noise, noise_spread=0.0)
    env = SurveillanceEnv(world, 32, seed=0)
    actor = seeded(make_actor, env.n_observation, world, agent)
    policy, explore = make_policies(actor, world, SafetyConfig(**safety), agent, 0, torch.device("cpu"))
    return world, env, actor, policy, explore


@torch.no_grad()
def test_noise_goes_before_the_filter():
    world, env, actor, policy, explore = policies()
    td = env.reset()
    greedy, noisy = policy(td.clone()), explore(td.clone())
    pure = actor(td.clone())[keys.NOMINAL_ACTION]
    assert torch.equal(greedy[keys.NOMINAL_ACTION], pure)
    spread = (noisy[keys.NOMINAL_ACTION] - pure).std().item()
    assert spread == pytest.approx(3.0 * world.max_speed, rel=0.15)
    again = SafetyFilter(SafetyConfig(), world)(td.clone().set(keys.NOMINAL_ACTION, noisy[keys.NOMINAL_ACTION]))
    assert torch.equal(noisy[keys.ACTION], again[keys.ACTION])
    assert torch.equal(noisy[keys.CHARGE_CURRENT], again[keys.CHARGE_CURRENT])


@pytest.mark.parametrize("mode", ["paper", "none"])
def test_explored_actions_stay_in_the_ball(mode):
    world, env, _, _, explore = policies(mode=mode)
    with torch.no_grad():
        batch = env.rollout(20, explore, break_when_any_done=False)
    assert batch[keys.ACTION].norm(dim=-1).max() <= world.max_speed
    assert batch[keys.NOMINAL_ACTION].norm(dim=-1).max() > 3 * world.max_speed


def test_exploration_through_env_restarts_the_process_at_each_reset():
    world = SurveillanceConfig(horizon=3, on_violation="continue")
    agent = AgentConfig(noise="ou", ou_theta=0.05, noise_initial=1.0, noise_final=1.0)
    env = SurveillanceEnv(world, 600, seed=0)
    actor = seeded(make_actor, env.n_observation, world, agent)
    _, explore = make_policies(actor, world, SafetyConfig(mode="none"), agent, 0, torch.device("cpu"))
    with torch.no_grad():
        batch = env.rollout(5, explore, break_when_any_done=False)
        noise = batch[keys.NOMINAL_ACTION] - actor(batch.select(keys.OBSERVATION))[keys.NOMINAL_ACTION]
    assert batch[keys.STEP_COUNT][0, :, 0].tolist() == [0, 1, 2, 0, 1]
    assert correlation(noise[:, 1], noise[:, 2]) > 0.6
    assert abs(correlation(noise[:, 2], noise[:, 3])) < 0.06
