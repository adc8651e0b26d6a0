"""The updates of an iteration are those of its minibatches, one after the other; learning begins when warm-up is over."""

import itertools

import pytest
import torch
from tensordict import TensorDictBase

import train
from agents.checkpoint import checkpoints, load_checkpoint
from agents.config import AgentConfig
from agents.learners import make_learners, make_update
from agents.maddpg import update_step
from agents.training_config import Config
from envs import SurveillanceEnv
from tests.test_graphs import make_rows

CPU = torch.device("cpu")


@pytest.mark.parametrize("max_grad_norm", [0.0, 0.5])
@pytest.mark.parametrize("seeds", [[0], [0, 1]], ids=str)
@pytest.mark.parametrize("count", [0, 1, 3, 17])
def test_updates_by_minibatches_in_order(count, seeds, max_grad_norm):
    config = Config(agent=AgentConfig(n_steps=1, max_grad_norm=max_grad_norm))
    world, agent, safety = config.env, config.agent, config.safety
    n_observation, rows = SurveillanceEnv(world).n_observation, make_rows(world, 64)
    generator = torch.Generator().manual_seed(0)
    shape = (len(seeds), 8) if len(seeds) > 1 else (8,)
    minibatches: list[TensorDictBase] = [rows[torch.randint(64, shape, generator=generator)] for _ in range(count)]

    def learner():
        return make_learners(n_observation, world, agent, safety, CPU, seeds=seeds)[1]

    mine, theirs = learner(), learner()
    found, expected = make_update(mine, agent, safety)(iter(minibatches)), {}
    for minibatch in minibatches:
        expected = update_step(minibatch, *theirs.updates, agent)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    for a, b in zip(mine.loss.parameters(), theirs.loss.parameters(), strict=True):
        assert torch.equal(a, b)
    for name in mine.optimizers:
        moments = (
            itertools.chain(*(state.values() for state in own.optimizers[name].state.values()))
            for own in (mine, theirs)
        )
        assert all(torch.equal(a, b) for a, b in zip(*moments, strict=True))
    others = list(mine.loss.parameters())
    assert (count > 0) == any(not torch.equal(a, b) for a, b in zip(others, learner().loss.parameters(), strict=True))


@pytest.mark.parametrize(("warmup", "batches"), [(0, 8), (32, 5), (36, 4), (64, 1), (1000, 0)])
def test_learning_begins_with_the_batch_that_ends_warm_up(program, tmp_path, warmup, batches):
    arguments = ("experiment=smoke", "collector.num_envs=8", "collector.steps_per_batch=1", "collector.total_frames=64")
    quiet = ("agent.n_steps=1", "log.gif=false", "log.figures=false", "device=cpu")
    code, output = program(train.main, *arguments, *quiet, f"train.warmup_frames={warmup}", "train.n_updates=2")
    assert code == 0, output
    (folder,) = tmp_path.glob("runs/*/*_seed0/checkpoints")
    states = load_checkpoint(checkpoints(folder)[-1])["parts"]["optimizers"]["loss_value"]["state"]
    assert {int(state["step"]) for state in states.values()} == ({2 * batches} if batches else set())
