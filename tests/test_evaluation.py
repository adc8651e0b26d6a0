"""evaluate_policy against a stored rollout measured by loops."""

import math

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import step_mdp

from agents import make_controller
from agents.evaluation import Evaluator, evaluate_policy
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

torch.set_num_threads(1)
B, N = 6, 3


def policy_of(name, world, **safety):
    return TensorDictSequential(make_controller(name, world, seed=3), SafetyFilter(SafetyConfig(**safety), world))


def store(name, world, steps, **safety):
    """The same rollout as :func:`evaluate_policy`, kept step by step."""
    env, policy = SurveillanceEnv(world, B, seed=5), policy_of(name, world, **safety)
    td, rows = env.reset(), []
    with torch.no_grad():
        for _ in range(steps):
            td = env.step(policy(td))
            rows.append(td.clone())
            td = step_mdp(td)
    return rows


def closest(before, after):
    """Least distance of two robots on a step's straight segments, by dense sampling."""
    t = torch.linspace(0, 1, 51, dtype=torch.float64)[:, None, None]
    p = (1 - t) * before.double() + t * after.double()
    return min((p[:, i] - p[:, j]).norm(dim=-1).min().item() for i in range(N) for j in range(i))


def count_charges(energy, world):
    """Intervals of rising energy that gain at least 20 % of the range, of one robot."""
    charges, start = 0, 0
    for k in range(1, len(energy) + 1):
        if k == len(energy) or energy[k] <= energy[k - 1]:
            charges += energy[k - 1] - energy[start] >= 0.2 * (world.energy_max - world.energy_min)
            start = k
    return charges


def by_hand(rows, world):
    cost, reward, steps = 0.0, 0.0, 0
    counts = dict.fromkeys(keys.VIOLATION_KINDS, 0)
    energy_margin = distance_margin = math.inf
    ended, died = 0, {}
    charges = 0
    for b in range(B):
        history = [[rows[0][keys.ENERGY][b, i, 0].item()] for i in range(N)]
        for k, td in enumerate(rows):
            following = td["next"]
            steps += 1
            cost += following[keys.COVERAGE_COST][b, 0].item()
            reward += following[keys.REWARD][b].mean().item()
            for i in range(N):
                energy = following[keys.ENERGY][b, i, 0].item()
                history[i].append(energy)
                energy_margin = min(energy_margin, energy - world.energy_min, world.energy_max - energy)
                for kind in counts:
                    counts[kind] += following[(*keys.VIOLATION, kind)][b, i, 0].item()
            gap = closest(td[keys.POSITION][b], following[keys.POSITION][b]) - world.safety_distance
            distance_margin = min(distance_margin, gap)
            if following["terminated"][b, 0]:
                ended, died[b] = ended + 1, k
                break
        charges += sum(count_charges(h, world) for h in history)
    metrics = {
        "coverage_cost": cost / steps,
        "episode_reward": reward / B,
        "charges_per_robot": charges / (B * N),
        "min_energy_margin": energy_margin,
        "robot_steps": steps * N,
        "terminated_worlds": ended,
    }
    return metrics, counts, distance_margin, died


@pytest.mark.parametrize(
    ("name", "mode", "on_violation", "steps"),
    [
        ("random", "none", "terminate", 60),
        ("random", "none", "continue", 60),
        ("charge_when_low", "paper", "terminate", 110),
    ],
)
def test_metrics_are_those_of_the_stored_rollout(name, mode, on_violation, steps):
    world = SurveillanceConfig(on_violation=on_violation, dtype="float64")
    expected, counts, distance, died = by_hand(store(name, world, steps, mode=mode), world)
    metrics, _, history = evaluate_policy(SurveillanceEnv(world, B, seed=5), policy_of(name, world, mode=mode), steps)
    assert history is None
    assert {key: metrics[key] for key in expected} == pytest.approx(expected, rel=1e-9)
    assert metrics["violations"] == counts
    assert metrics["min_distance_margin"] == pytest.approx(distance, abs=1e-3)
    if name == "random":
        assert sum(counts.values()) > 0
        assert (len(died) >= 3) == (on_violation == "terminate")
        if died:
            assert min(died.values()) < steps - 1  # a world ends early and does not count on
            assert metrics["robot_steps"] < B * steps * N
    else:
        assert metrics["charges_per_robot"] >= 1
        assert metrics["robot_steps"] == B * steps * N  # the time limit (100) ends nothing
        assert sum(counts.values()) == 0


@pytest.mark.parametrize("density", ["uniform", "moving"])
def test_a_drained_robot_watches_nothing(density):
    world = SurveillanceConfig(on_violation="continue", density=density, resolution=6)
    env, steps = SurveillanceEnv(world, B, seed=5), 100
    points, moment, total, nobody = env.density.points, env.density.cell_moment, 0.0, 0
    rows = store("gather", world, steps, mode="none")
    for td in rows:
        state = td["next"]
        params = state[keys.DENSITY] if density == "moving" else torch.zeros(B, 0)
        weights = env.density.weights(params).expand(B, -1)
        for b in range(B):
            awake = [
                p
                for p, e in zip(state[keys.POSITION][b], state[keys.ENERGY][b, :, 0], strict=True)
                if e >= world.energy_min
            ]
            nobody += not awake
            near = [
                min([float((p - q).square().sum()) for p in awake], default=8.0) for q in points
            ]  # 8: a square of 2 m
            total += float(torch.tensor(near) @ weights[b]) + moment
    metrics, _, _ = evaluate_policy(env, policy_of("gather", world, mode="none"), steps)
    assert metrics["powered_coverage_cost"] == pytest.approx(total / (B * steps), rel=1e-4)
    assert metrics["powered_coverage_cost"] > 1.2 * metrics["coverage_cost"]
    assert nobody
    safe, _, _ = evaluate_policy(env, policy_of("random", world), 20)
    assert safe["powered_coverage_cost"] == safe["coverage_cost"]


def test_statistics_count_living_worlds_only():
    world = SurveillanceConfig()
    steps, name, mode = 60, "random", "none"
    rows = store(name, world, steps, mode=mode)
    outside = 0
    for b in range(B):
        for td in rows:
            barriers = [
                td[key][b, :, 0] for key in (keys.BARRIER_ENERGY, keys.BARRIER_OVERCHARGE, keys.BARRIER_COLLISION)
            ]
            outside += int(sum((h < 0).long() for h in barriers).clamp(max=1).sum())
            if td["next", "terminated"][b, 0]:
                break
    _, statistics, _ = evaluate_policy(SurveillanceEnv(world, B, seed=5), policy_of(name, world, mode=mode), steps)
    assert statistics["outside"] == outside
    assert statistics["intervention_rate"] == 0


def test_same_seed_same_result():
    world = SurveillanceConfig()
    results = []
    for seed in (5, 5, 6):
        env = SurveillanceEnv(world, B, seed=seed)
        results.append(evaluate_policy(env, policy_of("random", world), 20)[0]["coverage_cost"])
    assert results[0] == results[1] != results[2]


def test_single_robot_has_no_distance():
    world = SurveillanceConfig(n_agents=1)
    metrics, _, _ = evaluate_policy(SurveillanceEnv(world, 2), policy_of("lloyd", world), 3)
    assert metrics["min_distance_margin"] is None


@pytest.mark.parametrize("density", ["gaussian_mixture", "age"])
def test_record_is_the_first_world(density):
    world = SurveillanceConfig(density=density)
    rows = store("charge_when_low", world, 30)
    env = SurveillanceEnv(world, B, seed=5)
    _, _, history = evaluate_policy(env, policy_of("charge_when_low", world), 30, record=True)
    for k, td in enumerate(rows):
        following = td["next"]
        assert (history.position[k] == following[keys.POSITION][0].numpy()).all()
        assert (history.energy[k] == following[keys.ENERGY][0, :, 0].numpy()).all()
        assert (history.slot[k] == following[keys.SLOT][0, :, 0].numpy()).all()
        assert (history.charging[k] == (following[keys.ENERGY] > td[keys.ENERGY])[0, :, 0].numpy()).all()
        assert history.coverage_cost[k] == following[keys.COVERAGE_COST][0, 0].item()
    assert history.position.shape == (30, N, 2)
    assert len(history.density) == (30 if density == "age" else 1)
    assert history.density.sum(-1) == pytest.approx(1, abs=1e-5)
    assert history.dt == pytest.approx(world.dt)


def test_restarted_worlds_go_on_counting():
    world, steps = SurveillanceConfig(), 80
    once, _, _ = evaluate_policy(SurveillanceEnv(world, B, seed=5), policy_of("flee", world, mode="none"), steps)
    seen = []

    def check(td, alive):
        assert alive.all()
        seen.append(td["next", "terminated"].clone())
        if len(seen) > 1:  # a world that ended stands at a fresh start, the others go on
            assert ((td[keys.STEP_COUNT] == 0) == seen[-2]).all()

    policy = policy_of("flee", world, mode="none")
    again, _, _ = evaluate_policy(SurveillanceEnv(world, B, seed=5), policy, steps, restart=True, check=check)
    assert len(seen) == steps
    assert once["robot_steps"] < again["robot_steps"] == B * steps * N
    assert again["terminated_worlds"] == int(sum(ended.sum() for ended in seen)) > once["terminated_worlds"]
    assert sum(again["violations"].values()) > sum(once["violations"].values())


def test_what_is_not_a_number():
    """Margins of NaN are none at all, barriers those of the states that had some."""
    world = SurveillanceConfig(on_violation="continue")
    policy = TensorDictSequential(make_controller("lloyd", world), SafetyFilter(SafetyConfig(mode="none"), world))
    env, calls = SurveillanceEnv(world, B, seed=5), []

    def wild(td):
        calls.append(0)
        td = policy(td)
        return td.set(keys.ACTION, td[keys.ACTION] * (math.nan if len(calls) == 3 else 1.0))

    metrics, statistics, _ = evaluate_policy(env, wild, 6)
    assert metrics["min_distance_margin"] is metrics["coverage_cost"] is None
    assert metrics["violations"]["collision"] > 0
    assert math.isfinite(statistics["min_h_s"])


def test_as_many_seeds_as_blocks():
    for seeds in ([1], [1, 2, 3]):
        with pytest.raises(ValueError, match="zip"):
            Evaluator(SurveillanceEnv(num_envs=4, seed=[0, 0]))(lambda td: td, 1, seeds=seeds)


@pytest.mark.parametrize(
    ("name", "mode", "density"), [("charge_when_low", "certified", "moving"), ("flee", "none", "uniform")]
)
def test_the_worlds_of_several_seeds_are_evaluated_as_each_alone(name, mode, density):
    world = SurveillanceConfig(density=density)
    policy, seeds, options = policy_of(name, world, mode=mode), [5, 9, 2], {"record": True}
    together = Evaluator(SurveillanceEnv(world, 3 * B, seed=[0, 0, 0]))(policy, 60, seeds=seeds, **options)
    for seed, found in zip(seeds, together, strict=True):
        alone = evaluate_policy(SurveillanceEnv(world, B, seed=seed), policy, 60, seeds=[seed], **options)
        assert found.metrics == alone[0]
        assert found.statistics == alone[1]
        for field, value in vars(alone[2]).items():
            assert np.array_equal(getattr(found.trajectory, field), value), field
