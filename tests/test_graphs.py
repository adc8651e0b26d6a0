"""Recorded functions, steps and updates give what they give unrecorded; a stand-in records where there is no GPU."""

import pytest
import torch
from tensordict.nn import TensorDictSequential

from agents.collection import make_collection
from agents.config import AgentConfig
from agents.evaluation import evaluate_policy
from agents.learners import make_learners, make_update
from agents.networks import acting, make_actor, make_policies
from agents.noise import noises_of
from agents.pipeline import MultiStep, draw, make_buffer, to_transitions
from agents.recorder import TrainingRecorder
from agents.training_config import Config
from envs import SurveillanceConfig, SurveillanceEnv, graphs
from envs.graphs import MOST, WARM_UP, Graphed
from safety import SafetyConfig, SafetyFilter
from tests.standin_recording import StandInRecording

CPU = torch.device("cpu")


@pytest.fixture
def recording(monkeypatch):
    monkeypatch.setattr(graphs, "recorder_for", lambda tensor: StandInRecording)
    monkeypatch.setattr(StandInRecording, "made", 0)
    monkeypatch.setattr(StandInRecording, "replays", 0)


def test_a_function_is_recorded_once_per_shape(recording):
    calls, total = [], torch.zeros(2)

    def function(x, y):
        calls.append(len(x))
        total.add_(1)
        return x + y, (x * y).sum()

    fast = Graphed(function)
    for k in range(10):
        x, y = torch.full((3,), float(k)), torch.ones(1)
        added, product = fast(x, y)
        assert torch.equal(added, x + 1)
        assert product == 3 * k
        x.zero_()  # the caller's own
        assert added[0] == k + 1
    assert len(calls) == WARM_UP + 1
    assert total.tolist() == [10, 10]
    first = fast(torch.ones(3), torch.ones(1))[0]
    fast(torch.zeros(3), torch.ones(1))
    assert first.tolist() == [2, 2, 2]
    for _ in range(5):
        fast(torch.ones(4), torch.ones(1))
    assert len(calls) == 2 * (WARM_UP + 1)


def test_there_are_not_more_and_more_recordings(recording):
    fast = Graphed(lambda x: x + 1)
    for size in range(1, MOST + 9):
        for _ in range(WARM_UP + 2):
            assert fast(torch.ones(size)).tolist() == size * [2]
    assert StandInRecording.made == MOST


def test_gradients_are_not_recorded(recording):
    fast = Graphed(lambda x: x * 2)
    for _ in range(6):
        x = torch.ones(2, requires_grad=True)
        fast(x).sum().backward()
        assert x.grad.tolist() == [2, 2]  # pyright: ignore[reportOptionalMemberAccess]
    assert not StandInRecording.made


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x[x > 0],
        lambda x: x * float(x.sum()),
        lambda x: x + torch.randn(2),
        lambda x: x + torch.tensor([1.0, 2.0]),
    ],
    ids=["selects", "reads", "draws", "brings"],
)
def test_what_a_graph_cannot_hold_raises(recording, function):
    fast = Graphed(function)
    for _ in range(WARM_UP):
        fast(torch.ones(2))
    with pytest.raises(RuntimeError, match="cannot be recorded"):
        fast(torch.ones(2))


def trained(iterations: int, n_seeds: int = 1, device: torch.device = CPU, **settings) -> dict[str, torch.Tensor]:
    """Collect and update; everything that comes of it."""
    config = Config(fixed_sizes=True, cuda_graphs=True, **settings)
    config.collector.num_envs = 4
    seeds, world, agent = list(range(n_seeds)), config.env, config.agent
    n_observation = SurveillanceEnv(world).n_observation
    learners, learner = make_learners(n_observation, world, agent, config.safety, device, seeds=seeds, cuda_graphs=True)
    update = make_update(learner, agent, config.safety, cuda_graphs=True)
    _, explore = make_policies(learner.actor, world, config.safety, agent, seeds, device, **config.computing)
    collection = make_collection(config, seeds, learners, explore, noises_of(explore), device, print)
    buffer, multi_step = make_buffer(1000, device, 0), MultiStep(agent.n_steps, agent.gamma)
    recorder = TrainingRecorder(world, 4 * n_seeds, device, cuda_graphs=True)
    found: dict[str, torch.Tensor] = {}
    for k, batch in enumerate(collection.batches(4 * n_seeds * iterations, resumed=False)):
        recorder.update(batch)
        rows = to_transitions(batch)
        if len(steps := multi_step(rows)):
            buffer.extend(steps)
            minibatch = draw(buffer, 8 * n_seeds * (3 if agent.minibatch == "per_agent" else 1), learner.loss.reads)
            losses = update(minibatch.reshape(n_seeds, -1) if n_seeds > 1 else minibatch)
            found |= {f"{k} {name}": value for name, value in losses.items()}
        found |= {f"{k} {name}": value.clone() for name, value in batch.flatten_keys().items()}
    numbers = recorder.summary()["filter"] | recorder.violations | {"cost": recorder.scalars()["train/coverage_cost"]}
    found |= {name: torch.tensor(value) for name, value in numbers.items()}
    return found | {name: value for name, value in learner.loss.state_dict().items() if isinstance(value, torch.Tensor)}


@pytest.mark.parametrize(
    ("settings", "recordings"),
    [
        ({}, 5),
        ({"n_seeds": 2, "agent": AgentConfig(n_steps=1)}, 5),
        ({"agent": AgentConfig(n_steps=1, share_params=False, minibatch="per_agent", max_grad_norm=1.0)}, 5),
        ({"env": SurveillanceConfig(n_agents=5, dimension=3, horizon=6, on_violation="continue")}, 5),
        ({"env": SurveillanceConfig(density="moving", observe_centroid=True)}, 5),
        ({"safety": SafetyConfig(split="half")}, 5),
        ({"safety": SafetyConfig(in_loss=True), "agent": AgentConfig(n_steps=1)}, 4),
        ({"safety": SafetyConfig(mode="paper")}, 5),
        ({"safety": SafetyConfig(mode="none")}, 5),
        ({"safety": SafetyConfig(mode="dalal", dalal_steps=3)}, 5),
    ],
    ids=["default", "seeds", "own networks", "space", "moving", "half", "in loss", "paper", "none", "dalal"],
)
def test_training_is_the_same(recording, settings, recordings, monkeypatch):
    found = trained(16, **settings)
    assert StandInRecording.made == recordings  # actor, filter, step, counting and update
    assert StandInRecording.replays >= 6 * recordings
    monkeypatch.setattr(graphs, "recorder_for", lambda tensor: None)
    expected = trained(16, **settings)
    assert not [name for name, value in expected.items() if not torch.equal(found[name], value)]


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize("mode", ["certified", "none"])
def test_evaluation_is_the_same(recording, restart, mode, monkeypatch):
    world, safety = SurveillanceConfig(density="moving"), SafetyConfig(mode=mode)
    actor = make_actor(SurveillanceEnv(world).n_observation, world, AgentConfig())

    def evaluated() -> tuple:
        sizes = {"fixed_sizes": True, "cuda_graphs": True}
        env = SurveillanceEnv(world, 6, seed=2, **sizes)
        policy = TensorDictSequential(acting(actor, cuda_graphs=True), SafetyFilter(safety, world, **sizes))
        found = [evaluate_policy(env, policy, 60, record=True, restart=restart) for _ in range(2)]
        return [metrics | statistics for metrics, statistics, _ in found], found[1][2].position

    with torch.no_grad():
        found, positions = evaluated()
        assert StandInRecording.made == 3  # actor, filter and step
        monkeypatch.setattr(graphs, "recorder_for", lambda tensor: None)
        expected, expected_positions = evaluated()
    assert found == expected
    assert (positions == expected_positions).all()
    assert sum(expected[0]["violations"].values()) > 0 or mode == "certified"


def test_graphs_need_fixed_sizes():
    for make in (
        lambda: SurveillanceEnv(cuda_graphs=True),
        lambda: SafetyFilter(SafetyConfig(), SurveillanceConfig(), cuda_graphs=True),
        lambda: Config(cuda_graphs=True),
    ):
        with pytest.raises(ValueError, match="fixed_sizes=true too"):
            make()
