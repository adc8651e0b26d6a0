"""Timings of the hot paths: ``make bench`` prints medians and ratios of one process. Nothing is asserted about time."""

import statistics
import time

import pytest
import torch
from tensordict.nn import TensorDictSequential

from agents import AgentConfig, make_controller
from agents.maddpg import make_loss, make_optimizers, update_step
from agents.networks import make_actor, make_critic, make_policies
from agents.pipeline import to_transitions
from envs import SurveillanceConfig, SurveillanceEnv
from envs.homing import reassign_slots
from safety import SafetyConfig, SafetyFilter, solve_qp

pytestmark = pytest.mark.benchmark


def median_ms(call, repeats=20):
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


@pytest.mark.parametrize("n_agents", [3, 8])
@pytest.mark.parametrize("num_envs", [100, 512])
def test_step(n_agents, num_envs):
    world = SurveillanceConfig(n_agents=n_agents)
    env = SurveillanceEnv(world, num_envs)
    filters = {
        "none": SafetyConfig(mode="none"),
        "paper": SafetyConfig(mode="paper", composition="min", split="full", sampled_data=False),
        "stacked": SafetyConfig(mode="paper"),
        "certified": SafetyConfig(),
    }
    td = SafetyFilter(filters["none"], world)(make_controller("random", world)(env.reset()))
    print(f"\nN={n_agents} B={num_envs} threads={torch.get_num_threads()}")
    step = median_ms(lambda: env.step(td.clone()))
    print(f"  world step, coverage, observation  {step:8.2f} ms  {num_envs / step:8.1f} k world-steps/s")
    for name, safety in filters.items():
        policy = SafetyFilter(safety, world)
        spent = median_ms(lambda policy=policy: policy(td.clone()))
        print(f"  filter {name:28s}{spent:8.2f} ms  {spent / step:8.2f} x world step")
    arguments = (td["agents", "position"], td["agents", "energy"].squeeze(-1), td["agents", "slot"].squeeze(-1))
    spent = median_ms(lambda: reassign_slots(*arguments, env.slots, env.geometry, env.bounds))
    print(f"  of the step: slot reassignment     {spent:8.2f} ms  {spent / step:8.2f} x world step")


@pytest.mark.parametrize("n_agents", [3, 8])
def test_qp_exact_against_qpth(n_agents):
    generator = torch.Generator().manual_seed(0)
    batch, rows = 512 * n_agents, n_agents
    target = 0.2 * torch.randn(batch, 2, generator=generator)
    G = torch.randn(batch, rows, 2, generator=generator)
    h = 0.1 * torch.rand(batch, rows, generator=generator)
    Q = torch.eye(2)
    exact = median_ms(lambda: solve_qp(Q, -target, G, h, solver="exact"), 5)
    qpth = median_ms(lambda: solve_qp(Q, -target, G, h, solver="qpth"), 3)
    print(
        f"\nper-robot problems N={n_agents} B=512: exact {exact:.2f} ms, qpth {qpth:.1f} ms, ratio {qpth / exact:.0f}"
    )


@pytest.mark.parametrize("controller", ["random", "patrol"])
@pytest.mark.parametrize("n_agents", [3, 5, 8])
@pytest.mark.parametrize("num_envs", [128, 512, 4096])
def test_certified_filter_against_stacked(n_agents, num_envs, controller):
    """On states that a roll-out behind the certified filter reaches."""
    world = SurveillanceConfig(n_agents=n_agents)
    filters = [SafetyFilter(safety, world) for safety in (SafetyConfig(), SafetyConfig(mode="paper"))]
    env, nominal, states = SurveillanceEnv(world, num_envs, seed=1), make_controller(controller, world), []
    with torch.no_grad():
        td = env.reset()
        for k in range(60):
            td = filters[0](nominal(td))
            if k % 10 == 9:
                states.append(td.clone())
            td = env.step(td)["next"]
        certified, stacked = (median_ms(lambda f=f: [f(td.clone()) for td in states], 5) / 6 for f in filters)
    print(
        f"\nN={n_agents} B={num_envs} {controller}: certified {certified:.2f} ms, stacked {stacked:.2f} ms, "
        f"ratio {certified / stacked:.2f}"
    )


def test_update():
    world, agent, safety = SurveillanceConfig(), AgentConfig(), SafetyConfig()
    env = SurveillanceEnv(world, 256)
    actor = make_actor(env.n_observation, world, agent)
    critic = make_critic(env.n_observation, world, agent)
    _, explore = make_policies(actor, world, safety, agent, 0, torch.device("cpu"))
    with torch.no_grad():
        batch = to_transitions(env.rollout(1, explore))
    print()
    for in_loss in (False, True):
        loss, updater = make_loss(actor, critic, agent, SafetyConfig(in_loss=in_loss), world)
        optimizers = make_optimizers(loss, agent)
        spent = median_ms(lambda: update_step(batch, loss, optimizers, updater, agent))  # noqa: B023
        print(f"update, minibatch 256, filter in loss {in_loss!s:5}: {spent:.2f} ms")


def test_rollout_against_unfiltered():
    print()
    world = SurveillanceConfig()
    base = None
    for name, safety in {
        "none": SafetyConfig(mode="none"),
        "stacked": SafetyConfig(mode="paper"),
        "certified": SafetyConfig(),
    }.items():
        env = SurveillanceEnv(world, 512)
        policy = TensorDictSequential(make_controller("lloyd", world), SafetyFilter(safety, world))
        spent = median_ms(lambda env=env, policy=policy: env.rollout(20, policy, break_when_any_done=False), 3) / 20
        base = base or spent
        print(f"rollout behind {name:9s} {spent:.2f} ms/step  {spent / base:.2f} x unfiltered")
