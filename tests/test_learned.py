"""The learned adversary: its reward, its training, the shipped one and what it does behind the filters."""

import json
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

import evaluate
import train
from agents import AgentConfig, make_controller
from agents.adversary_reward import BARRIERS, AdversaryReward
from agents.checkpoint import CheckpointError, load_checkpoint
from agents.learned import SHIPPED, actor_layers, export_actor
from agents.networks import make_actor
from agents.pipeline import STORED, to_transitions
from agents.training_config import TrainConfig
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

torch.set_num_threads(1)


def roll_out(name, safety, worlds=32, steps=200, seed=5):
    """Violating robot-steps and the mean over robots and time of what the adversary's reward is minus of."""
    world = SurveillanceConfig(on_violation="continue")
    env, nominal = SurveillanceEnv(world, worlds, seed=seed), make_controller(name, world, seed=1)
    safety_filter, reward = SafetyFilter(safety, world), AdversaryReward(world, SafetyConfig(), TrainConfig().attack)
    td, violations, margin = env.reset(), 0, 0.0
    with torch.no_grad():
        for _ in range(steps):
            td = env.step(safety_filter(nominal(td)))
            flags = [td["next"][(*keys.VIOLATION, kind)] for kind in keys.VIOLATION_KINDS]
            violations += int(torch.stack(flags).any(dim=0).sum())
            margin -= float(reward(td["next"]).mean()) / steps
            td = step_mdp(td)
    return violations, margin


# ---- reward ------------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def batch():
    world = SurveillanceConfig()
    policy = SafetyFilter(SafetyConfig(), world)
    return SurveillanceEnv(world, 4, seed=0).rollout(6, lambda td: policy(make_controller("random", world)(td)))


def test_coverage_stores_the_environments_reward(batch):
    stored = to_transitions(batch)
    assert (stored == batch.select(*STORED)).all()
    assert torch.equal(stored["next"][keys.REWARD].flatten(), batch["next"][keys.REWARD].flatten())


def test_adversary_replaces_the_reward_and_nothing_else(batch):
    before = batch.clone()
    reward = AdversaryReward(SurveillanceConfig(), SafetyConfig(), BARRIERS)
    stored, plain = to_transitions(batch, adversary=reward), to_transitions(batch)
    assert (batch == before).all()
    assert stored["next"][keys.REWARD].shape == plain["next"][keys.REWARD].shape
    assert torch.equal(stored["next"][keys.REWARD].flatten(0, 1), reward(plain["next"].reshape(-1)))
    assert (stored["next"][keys.REWARD] <= 0).all()  # certified states
    assert (stored.exclude(("next", *keys.REWARD)) == plain.exclude(("next", *keys.REWARD))).all()


def by_hand(world, position, energy, slot):
    """Margins of three robots, in Python floats; the closest approach by stepping home finely."""
    g, slots, rows = world.homing, world.slot_positions, []
    span, length = world.energy_max - world.energy_min, world.length_scale
    homes = [slots[k] for k in slot]
    way = [math.dist(p, s) for p, s in zip(position, homes, strict=True)]

    def place(i, t):  # after t steps at full homing speed, straight between samples
        def at(k):
            left = max(0.0, way[i] - k * g.speed * g.dt)
            return [s + (p - s) * left / way[i] for p, s in zip(position[i], homes[i], strict=True)]

        return [a + (t % 1) * (b - a) for a, b in zip(at(math.floor(t)), at(math.floor(t) + 1), strict=True)]

    for i in range(3):
        others = [j for j in range(3) if j != i]
        needed = g.drain_rate / g.speed * max(0.0, way[i] - g.reserve_radius)
        closest = min(math.dist(place(i, k / 50), place(j, k / 50)) for j in others for k in range(3000))
        rows.append(
            (
                (energy[i] - world.energy_min - needed) / span,
                (world.energy_max - energy[i]) / span,
                (min(math.dist(position[i], position[j]) for j in others) - world.safety_distance) / length,
                (closest - g.clearance) / length,
            )
        )
    return rows


def test_reward_against_a_hand_computation():
    world = SurveillanceConfig(dtype="float64")
    gen = torch.Generator().manual_seed(0)
    position = 1.6 * torch.rand(5, 3, 2, generator=gen, dtype=torch.float64) - 0.8
    energy = 0.3 + 0.6 * torch.rand(5, 3, generator=gen, dtype=torch.float64)
    slot = torch.stack([torch.randperm(3, generator=gen) for _ in range(5)])
    state = TensorDict({keys.POSITION: position, keys.ENERGY: energy[..., None], keys.SLOT: slot[..., None]}, [5])
    expected = torch.tensor(
        [by_hand(world, *rows) for rows in zip(position.tolist(), energy.tolist(), slot.tolist(), strict=True)]
    ).double()
    for attack in (BARRIERS, *([name] for name in BARRIERS), ["overcharge", "collision"]):
        columns = [BARRIERS.index(name) for name in attack]
        got = AdversaryReward(world, SafetyConfig(), attack)(state).squeeze(-1)
        torch.testing.assert_close(got, -expected[..., columns].amin(-1), atol=1e-4, rtol=0)
    without = AdversaryReward(world, SafetyConfig(mode="paper"), BARRIERS)(state).squeeze(-1)
    torch.testing.assert_close(without, -expected[..., :3].amin(-1), atol=1e-4, rtol=0)


def test_an_attack_on_nothing_is_refused(program, tmp_path):
    code, output = program(train.main, "experiment=adversary", "env.n_agents=1", "train.attack=[collision]")
    assert code == 1
    assert "train.attack=['collision'] leaves nothing to attack with env.n_agents=1" in " ".join(output.split())
    code, output = program(train.main, "train.objective=adversary", "train.violation_penalty=1")
    assert code == 1
    assert "train.violation_penalty=1" in output
    assert list(tmp_path.iterdir()) == []


# ---- the shipped one ---------------------------------------------------------------------------------------------------
def test_shipped_file_is_small_and_holds_weights_only():
    assert SHIPPED.stat().st_size < 150_000
    content = torch.load(SHIPPED, weights_only=True)
    assert content["world"] == {"n_agents": 3, "dimension": 2, "n_observation": 18}
    assert set(content["origin"]) == {"config_hash", "git_hash", "seed", "frames"}
    assert content["actor_cells"] == actor_layers(content["actor"]).actor_cells
    assert {value.dtype for value in content["actor"].values()} == {torch.float32}


@pytest.mark.parametrize("agent", [AgentConfig(actor_cells=[7, 5, 6]), AgentConfig(actor_cells=[9], share_params=True)])
def test_layers_are_read_from_the_weights(agent):
    layers = actor_layers(make_actor(18, SurveillanceConfig(), agent).state_dict())
    assert (layers.actor_cells, layers.share_params) == (agent.actor_cells, agent.share_params)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_learned_is_a_deterministic_function_of_the_observation(dtype):
    world = SurveillanceConfig(dtype=dtype)
    td = SurveillanceEnv(world, 8, seed=2).reset()
    first, again = (make_controller("learned", world, seed)(td.clone())[keys.NOMINAL_ACTION] for seed in (0, 1))
    assert torch.equal(first, again)
    assert (first.dtype, first.requires_grad) == (world.torch_dtype, False)
    assert first.norm(dim=-1).max() <= world.max_speed
    observed = td.select(keys.OBSERVATION)
    assert torch.equal(make_controller("learned", world)(observed)[keys.NOMINAL_ACTION], first)


def test_no_violation_behind_the_certified_filter_and_many_without():
    violations, margin = roll_out("learned", SafetyConfig())
    _, margin_of_random = roll_out("random", SafetyConfig(), worlds=8, steps=100)
    assert violations == 0
    assert 0 <= margin < 0.2 * margin_of_random
    learned, by_chance = (roll_out(name, SafetyConfig(mode="none"), 16, 100)[0] for name in ("learned", "random"))
    assert learned > by_chance


# ---- errors and a run of its own ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("fields", "hint"), [({"n_agents": 5}, "n_agents is 3 there, 5 here"), ({"horizon": 0}, "18 there, 17 here")]
)
def test_another_world_gives_one_clear_error_and_no_folder(program, tmp_path, fields, hint):
    with pytest.raises(CheckpointError, match=rf"{hint}.*python train.py experiment=adversary env=.*adversary="):
        make_controller("learned", SurveillanceConfig(**fields))
    overrides = [f"env.{name}={value}" for name, value in fields.items()]
    code, output = program(evaluate.main, "controller=learned", *overrides)
    assert code == 1
    assert hint in " ".join(output.split())
    assert "Traceback" not in output
    assert len(output.strip().splitlines()) <= 8
    assert list(tmp_path.iterdir()) == []


def test_train_one_and_evaluate_it(program, tmp_path):
    tiny = ("env=five_robots", "env.horizon=6", "device=cpu")
    short = ("experiment=smoke", "collector.total_frames=256", "log.figures=false", "log.gif=false", *tiny)
    code, output = program(train.main, *short, "train.objective=adversary", "agent.actor_cells=[8]", "hydra.run.dir=a")
    assert code == 0, output
    code, output = program(train.main, *short, "hydra.run.dir=b")
    assert code == 0, output
    arguments = ("controller=learned", "steps=4", "num_envs=2", "pictures=false", *tiny)
    code, output = program(evaluate.main, *arguments, f"adversary={tmp_path / 'a'}")
    assert code == 0, output
    result = next(tmp_path.glob("runs/controllers/learned_certified_five_robots_4_0_*/eval.json")).read_text()
    assert json.loads(result)["adversary"] == str(tmp_path / "a")
    files = set(tmp_path.rglob("*"))
    for adversary, hint in (("b", "train.objective=coverage"), ("c", "is not the folder of a run"), (None, "5 here")):
        code, output = program(evaluate.main, *arguments, *([f"adversary={adversary}"] if adversary else []))
        assert code == 1
        assert hint in " ".join(output.split())
    code, output = program(evaluate.main, "controller=random", "adversary=a")
    assert code == 1
    assert "goes with controller=learned" in " ".join(output.split())
    assert set(tmp_path.rglob("*")) == files
    small = load_checkpoint(export_actor(tmp_path / "a", tmp_path / "small.pt"))
    assert (small["actor_cells"], small["origin"]["frames"]) == ([8], 256)
