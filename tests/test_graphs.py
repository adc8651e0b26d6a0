"""Recorded functions, steps and updates give what they give unrecorded; a stand-in records where there is no GPU."""

import contextlib
import copy

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential

from agents.collection import make_collection
from agents.config import AgentConfig
from agents.divergence import WATCHED
from agents.evaluation import Evaluator
from agents.learners import make_learners, make_update
from agents.networks import acting, make_actor, make_policies
from agents.noise import noises_of
from agents.pipeline import MultiStep, to_transitions
from agents.recorder import BatchCounter, TrainingRecorder
from agents.replay import Replay
from agents.seeds import minibatches
from agents.training_config import Config
from conf.naming import config_hash
from envs import SurveillanceConfig, SurveillanceEnv, graphs, keys, metrics
from envs.dynamics import other_indices, own_pairs, pair_indices
from envs.graphs import MOST, WARM_UP, Graphed
from safety import SafetyConfig, SafetyFilter
from tests.standin_recording import StandInRecording
from tests.test_recorder import Look, counted_batch

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

    fast = Graphed(function, learns=True)
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
    fast = Graphed(lambda x: x + 1, learns=True)
    for size in range(1, MOST + 9):
        for _ in range(WARM_UP + 2):
            assert fast(torch.ones(size)).tolist() == size * [2]
    assert StandInRecording.made == MOST


def test_gradients_flow_whatever_was_recorded_without(recording):
    weight = torch.ones(2, requires_grad=True)
    fast = Graphed(lambda x: x * weight)
    for k in range(2 * WARM_UP):
        with torch.no_grad():
            assert not fast(torch.ones(2)).requires_grad
        weight.grad = None
        fast(torch.full((2,), float(k))).sum().backward()
        assert weight.grad.tolist() == [k, k]  # pyright: ignore[reportOptionalMemberAccess]
    assert StandInRecording.made == 1


def test_inference_tensors_are_not_mixed_with_others(recording):
    fast = Graphed(lambda x: x + 1)
    for mode in (torch.inference_mode, torch.no_grad, torch.inference_mode):
        for _ in range(WARM_UP + 2):
            with mode():
                assert fast(torch.ones(2)).tolist() == [2, 2]
    assert StandInRecording.made == 2


def test_what_recordings_know_by_address_is_kept(recording):
    """The stand-in holds all tensors; a CUDA graph does not."""
    made = [make(3, CPU) for make in (other_indices, pair_indices, own_pairs, metrics._pairs)]
    for n in range(4, 90):
        for make in (other_indices, pair_indices, own_pairs, metrics._pairs):
            make(n, CPU)
    again = [make(3, CPU) for make in (other_indices, pair_indices, own_pairs, metrics._pairs)]
    assert all(old is new for old, new in zip(made, again, strict=True))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x[x > 0],
        lambda x: x * float(x.sum()),
        lambda x: x + torch.tensor([1.0, 2.0]),
        lambda x: x + torch.randn(2),
        torch.randn_like,
        lambda x: x.clone().exponential_(),
        lambda x: torch.bernoulli(x / 2),
        lambda x: torch.nn.functional.dropout(x, training=True),
        lambda x: x.unique(),
        lambda x: x.long().bincount(),
        lambda x: (x > 0).nonzero(),
        lambda x: x[(x > 0).nonzero(as_tuple=True)],
        lambda x: x if (x > 0).any() else -x,
    ],
    ids=[
        "masks",
        "reads",
        "brings",
        "randn",
        "like",
        "exponential",
        "bernoulli",
        "dropout",
        "unique",
        "counts",
        "selects",
        "selects as tuple",
        "asks",
    ],
)
@pytest.mark.parametrize("mode", [contextlib.nullcontext, torch.inference_mode])
def test_what_a_graph_cannot_hold_raises(recording, function, mode):
    fast = Graphed(function, learns=True)
    with mode():
        for _ in range(WARM_UP):
            fast(torch.ones(2))
        with pytest.raises(RuntimeError, match="cannot be recorded"):
            fast(torch.ones(2))


def trained(
    iterations: int, n_seeds: int = 1, device: torch.device = CPU, *, on: bool = True, **settings
) -> dict[str, torch.Tensor]:
    """Collect and update, by graphs if ``on``; everything that comes of it. The optimisers are those of graphs either way."""
    config = Config(fixed_sizes=True, cuda_graphs=on, **settings)
    config.collector.num_envs = 4
    seeds, world, agent = list(range(n_seeds)), config.env, config.agent
    n_observation = SurveillanceEnv(world).n_observation
    learners, learner = make_learners(n_observation, world, agent, config.safety, device, seeds=seeds, cuda_graphs=True)
    update = make_update(learner, agent, config.safety, cuda_graphs=on)
    _, explore = make_policies(learner.actor, world, config.safety, agent, seeds, device, **config.computing)
    collection = make_collection(config, seeds, learners, explore, noises_of(explore), device, print)
    replay, multi_step = Replay(1000, seeds, device), MultiStep(agent.n_steps, agent.gamma)
    counter = BatchCounter(world, n_seeds, cuda_graphs=on)
    recorders = [TrainingRecorder(world, 4, device) for _ in seeds]
    found: dict[str, torch.Tensor] = {}
    for k, batch in enumerate(collection.batches(4 * n_seeds * iterations, resumed=False)):
        for recorder, counted in zip(recorders, counter(batch), strict=True):
            recorder.update(counted)
        replay.store(multi_step(to_transitions(batch)))
        if len(replay.parts[0]):
            losses = update(
                minibatches(replay, 2, 8 * (3 if agent.minibatch == "per_agent" else 1), learner.loss.reads)
            )
            found |= {f"{k} {name}": value for name, value in losses.items()}
        found |= {f"{k} {name}": value.clone() for name, value in batch.flatten_keys().items()}
    for seed, recorder in zip(seeds, recorders, strict=True):
        numbers = recorder.summary()["filter"] | recorder.violations | recorder.scalars()
        found |= {f"{seed} {name}": torch.tensor(value) for name, value in numbers.items()}
    return found | {name: value for name, value in learner.loss.state_dict().items() if isinstance(value, torch.Tensor)}


@pytest.mark.parametrize(
    ("settings", "recordings"),
    [
        ({}, 6),
        ({"n_seeds": 2, "agent": AgentConfig(n_steps=1)}, 6),
        ({"agent": AgentConfig(n_steps=1, share_params=False, minibatch="per_agent", max_grad_norm=1.0)}, 6),
        ({"env": SurveillanceConfig(n_agents=5, dimension=3, horizon=6, on_violation="continue")}, 6),
        ({"env": SurveillanceConfig(density="moving", observe_centroid=True)}, 6),
        ({"safety": SafetyConfig(split="half")}, 6),
        ({"safety": SafetyConfig(in_loss=True), "agent": AgentConfig(n_steps=1)}, 4),
        ({"safety": SafetyConfig(mode="paper")}, 6),
        ({"safety": SafetyConfig(mode="none")}, 6),
        ({"safety": SafetyConfig(mode="dalal", dalal_steps=3)}, 6),
    ],
    ids=["default", "seeds", "own networks", "space", "moving", "half", "in loss", "paper", "none", "dalal"],
)
def test_training_is_the_same(recording, settings, recordings):
    found = trained(16, **settings)
    assert StandInRecording.made == recordings  # actor, filter, step, counting, update, measured update
    assert StandInRecording.replays >= 6 * recordings
    expected = trained(16, on=False, **settings)
    assert not [name for name, value in expected.items() if not torch.equal(found[name], value)]


@pytest.mark.parametrize("restart", [False, True])
@pytest.mark.parametrize("mode", ["certified", "none"])
def test_evaluation_is_the_same(recording, restart, mode):
    world, safety = SurveillanceConfig(density="moving"), SafetyConfig(mode=mode)
    actor = make_actor(SurveillanceEnv(world).n_observation, world, AgentConfig())

    def evaluated(*, on: bool) -> tuple:
        sizes = {"fixed_sizes": True, "cuda_graphs": on}
        env = SurveillanceEnv(world, 6, seed=[2, 7], **sizes)
        policy = TensorDictSequential(acting(actor, cuda_graphs=on), SafetyFilter(safety, world, **sizes))
        evaluator = Evaluator(env, cuda_graphs=on)
        found = [own for _ in range(2) for own in evaluator(policy, 60, record=True, restart=restart)]
        return [own.metrics | own.statistics for own in found], [own.trajectory.position for own in found]

    with torch.no_grad():
        found, positions = evaluated(on=True)
        assert StandInRecording.made == 4  # actor, filter, step and measuring
        expected, expected_positions = evaluated(on=False)
    assert found == expected
    for own, expected_own in zip(positions, expected_positions, strict=True):
        assert (own == expected_own).all()
    assert sum(expected[0]["violations"].values()) > 0 or mode == "certified"


@pytest.mark.parametrize("seeds", [[0], [0, 1]], ids=["one", "two"])
@pytest.mark.parametrize("first", [False, True])
def test_optimisers_go_on_from_checkpoints_of_the_other_kind(seeds, first):
    config = Config(agent=AgentConfig(n_steps=1))
    world, agent, safety = config.env, config.agent, config.safety
    n_observation = SurveillanceEnv(world).n_observation
    rows = make_rows(world, 8)
    batch = rows if len(seeds) == 1 else torch.stack([rows] * len(seeds))

    def made(*, on: bool):
        parts, whole = make_learners(n_observation, world, agent, safety, CPU, seeds=seeds, cuda_graphs=on)
        return parts, whole, make_update(whole, agent, safety)

    parts, whole, update = made(on=first)
    update([batch] * 4)
    whole.share_moments()
    saved = [copy.deepcopy({"loss": part.loss.state_dict(), **states(part)}) for part in parts]
    update([batch] * 3)
    others, other, go_on = made(on=not first)
    for part, content in zip(others, saved, strict=True):
        part.loss.load_state_dict(content["loss"])
        for name, optimizer in part.optimizers.items():
            optimizer.load_state_dict(content[name])
            assert bool(optimizer.param_groups[0]["fused"]) != first
    other.gather_moments()
    go_on([batch] * 3)
    for mine, theirs in zip(whole.loss.parameters(), other.loss.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-6)


def make_rows(world: SurveillanceConfig, count: int) -> TensorDictBase:
    """Transitions ``(count,)`` of an untrained policy."""
    config = Config(env=world, agent=AgentConfig(n_steps=1))
    config.collector.num_envs = count
    learners, learner = make_learners(
        SurveillanceEnv(world).n_observation, world, config.agent, config.safety, CPU, seeds=[0]
    )
    _, explore = make_policies(learner.actor, world, config.safety, config.agent, [0], CPU)
    collection = make_collection(config, [0], learners, explore, noises_of(explore), CPU, print)
    return to_transitions(next(collection.batches(count, resumed=False))).reshape(-1).clone()


def states(learner) -> dict:
    """Of its optimisers, by name."""
    return {name: optimizer.state_dict() for name, optimizer in learner.optimizers.items()}


def test_a_recorded_count_tells_what_is_to_be_looked_at(recording):
    world = SurveillanceConfig(n_agents=2)
    look = Look(world, BatchCounter(world, cuda_graphs=True))
    for _ in range(WARM_UP + 2):
        assert not look(counted_batch())
    assert StandInRecording.made == 1
    for key in [keys.OUTSIDE, *(("next", *keys.VIOLATION, kind) for kind in keys.VIOLATION_KINDS)]:
        batch = counted_batch()
        batch[key][0, 1, 0] = True
        assert look(batch), key
    for key in WATCHED.values():
        batch = counted_batch()
        batch[key][0, 0, 1] = float("nan")
        assert look(batch), key
    assert not look(counted_batch())
    assert look.recorder.violations == dict.fromkeys(keys.VIOLATION_KINDS, 1)


def test_graphs_need_fixed_sizes():
    for make in (
        lambda: SurveillanceEnv(cuda_graphs=True),
        lambda: SafetyFilter(SafetyConfig(), SurveillanceConfig(), cuda_graphs=True),
    ):
        with pytest.raises(ValueError, match="fixed_sizes=true too"):
            make()


def test_graphs_bring_fixed_sizes():
    assert Config(cuda_graphs=True).computing == Config(fixed_sizes=True, cuda_graphs=True).computing
    alone, both = OmegaConf.create({"cuda_graphs": True}), OmegaConf.create({"cuda_graphs": True, "fixed_sizes": True})
    assert config_hash(alone) == config_hash(both)
    with pytest.raises(ValueError, match="fixed_sizes"):
        Config(cuda_graphs=True, safety=SafetyConfig(mode="paper", split="joint"))
