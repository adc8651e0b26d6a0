"""How often an iteration of training waits for the device: as often whatever the number of worlds and robots.

On a GPU an operation whose result the host needs (a Python number, a size that depends on the data) waits until the queue is
empty. Here a CPU counts them, where they cost nothing.
"""

from collections import Counter

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from agents import make_controller
from agents.collection import make_collection
from agents.evaluation import Evaluator
from agents.learners import make_learners
from agents.maddpg import update_step
from agents.networks import make_policies
from agents.noise import noises_of
from agents.pipeline import MultiStep, to_transitions
from agents.recorder import BatchCounter, TrainingRecorder
from agents.replay import Replay
from agents.training_config import Config
from envs import SurveillanceConfig, SurveillanceEnv
from safety import SafetyConfig, SafetyFilter
from tests.standin_recording import by_mask, in_parts

CPU = torch.device("cpu")
ATEN = torch.ops.aten
WAITS = {ATEN._local_scalar_dense, ATEN.nonzero, ATEN.masked_select, ATEN.equal, ATEN.repeat_interleave, ATEN._unique2}
MOST = {"collect": 18, "count": 1, "store": 0, "update": 0}
"""Waits of an iteration without resets. Of collecting, two are TorchRL's (is any world done?), the others select the worlds,
pairs and rows that the filter and the reassignment of slots have to look at."""


class Waits(TorchDispatchMode):
    """Counts operations that wait for a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.found = Counter()
        self.on_host: dict[int, torch.Tensor] = {}
        """By id: the optimisers' counts of steps, which stay on the host."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if (parts := in_parts(self, func, args, kwargs)) is not NotImplemented:
            return parts
        packet = func.overloadpacket
        if (packet in WAITS or by_mask(func, args)) and id(args[0]) not in self.on_host:
            self.found[str(packet)] += 1
        return func(*args, **(kwargs or {}))


class Readings(TorchFunctionMode):
    """Counts what is read off as Python numbers without an operation, into the same counts."""

    def __init__(self, found: Counter) -> None:
        super().__init__()
        self.found = found

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func in (torch.Tensor.tolist, torch.Tensor.cpu, torch.Tensor.numpy):
            self.found[func.__name__] += 1
        return func(*args, **(kwargs or {}))


def waits(world: SurveillanceConfig, num_envs: int, *, fixed_sizes: bool = False, n_seeds: int = 1) -> dict[str, float]:
    """Waits per iteration of each part of the training loop."""
    config = Config(env=world, fixed_sizes=fixed_sizes)
    config.collector.num_envs = num_envs
    seeds = list(range(n_seeds))
    learners, learner = make_learners(
        SurveillanceEnv(world).n_observation, world, config.agent, config.safety, CPU, seeds=seeds
    )
    _, explore = make_policies(learner.actor, world, config.safety, config.agent, seeds, CPU, **config.computing)
    noises = noises_of(explore)
    collection = make_collection(config, seeds, learners, explore, noises, CPU, print)
    batches = collection.batches(100 * num_envs * n_seeds, resumed=False)
    multi_step, replay = MultiStep(config.agent.n_steps, config.agent.gamma), Replay(10**4, seeds, CPU)
    counter, counts = BatchCounter(world, n_seeds), dict.fromkeys(MOST, 0.0)
    recorders = [TrainingRecorder(world, num_envs, CPU) for _ in seeds]
    mode = Waits()
    readings = Readings(mode.found)
    for k in range(20):
        before = Counter(mode.found)

        def spent(part: str, k: int = k) -> None:
            nonlocal before
            if k >= 10:  # the multi-step window is full, the optimisers have begun
                counts[part] += sum((mode.found - before).values()) / 10
            before = Counter(mode.found)

        with mode, readings:
            batch = next(batches)
            spent("collect")
            for recorder, counted in zip(recorders, counter(batch), strict=True):
                recorder.update(counted)
            spent("count")
            replay.store(multi_step(to_transitions(batch)))
            spent("store")
        if k >= 8:
            with mode, readings:
                update_step(replay.draw(256, learner.loss.reads), *learner.updates, config.agent)
            spent("update")
            steps = [state["step"] for own in learner.optimizers.values() for state in own.state.values()]
            mode.on_host = {id(step): step for step in steps}
    return counts


@pytest.mark.parametrize(("n_agents", "num_envs"), [(3, 64), (3, 256), (6, 64)])
def test_waits_of_an_iteration(n_agents, num_envs):
    found = waits(SurveillanceConfig(n_agents=n_agents, horizon=100), num_envs)
    assert all(found[part] <= most for part, most in MOST.items()), found
    assert found["collect"] > 5  # the counting counts


@pytest.mark.parametrize(("n_agents", "num_envs"), [(3, 64), (3, 256), (6, 64)])
@pytest.mark.parametrize(("on_violation", "most"), [("continue", 0), ("terminate", 1)])  # 1: is any world done?
def test_a_step_of_fixed_sizes_does_not_wait(n_agents, num_envs, on_violation, most):
    world = SurveillanceConfig(n_agents=n_agents, horizon=100, on_violation=on_violation)
    found = waits(world, num_envs, fixed_sizes=True)
    assert found["collect"] == pytest.approx(most), found


def test_several_seeds_wait_as_often_as_one():
    world = SurveillanceConfig(horizon=100, on_violation="continue")
    expected = {"collect": 0, "count": 1, "store": 0, "update": 0}
    assert waits(world, 16, fixed_sizes=True, n_seeds=3) == pytest.approx(expected)


@pytest.mark.parametrize("recorded", [False, True])
def test_an_evaluation_is_read_at_its_end(recorded):
    world, counts = SurveillanceConfig(on_violation="continue"), []
    policy = TensorDictSequential(
        make_controller("lloyd", world), SafetyFilter(SafetyConfig(), world, fixed_sizes=True)
    )
    for steps in (5, 25):
        env, mode = SurveillanceEnv(world, 8, seed=[0, 1], fixed_sizes=True), Waits()
        with mode, Readings(mode.found):
            Evaluator(env, cuda_graphs=recorded)(policy, steps, record=True)
        counts.append(sum(mode.found.values()))
    assert counts[1] - counts[0] == (0 if recorded else 20)  # unrecorded it asks whether all robots have power
    assert counts[0] > 0


def test_a_step_of_fixed_sizes_does_not_wait_in_space():
    world = SurveillanceConfig(dimension=3, horizon=100, on_violation="continue")
    assert waits(world, 16, fixed_sizes=True)["collect"] == 0
