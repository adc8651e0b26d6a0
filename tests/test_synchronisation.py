"""How often an iteration of training waits for the device: as often whatever the number of worlds and robots.

On a GPU an operation whose result the host needs (a Python number, a size that depends on the data) waits until the queue is
empty. Here a CPU counts them, where they cost nothing.
"""

from collections import Counter

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from agents.collection import make_collection
from agents.learners import make_learners
from agents.maddpg import update_step
from agents.networks import make_policies
from agents.noise import noises_of
from agents.pipeline import MultiStep, draw, make_buffer, store, to_transitions
from agents.recorder import BatchCounter, TrainingRecorder
from agents.training_config import Config
from envs import SurveillanceConfig, SurveillanceEnv
from tests.standin_recording import by_mask

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


def waits(world: SurveillanceConfig, num_envs: int, *, fixed_sizes: bool = False) -> dict[str, float]:
    """Waits per iteration of each part of the training loop."""
    config = Config(env=world, fixed_sizes=fixed_sizes)
    config.collector.num_envs = num_envs
    learners, learner = make_learners(
        SurveillanceEnv(world).n_observation, world, config.agent, config.safety, CPU, seeds=[0]
    )
    _, explore = make_policies(learner.actor, world, config.safety, config.agent, [0], CPU, **config.computing)
    noises = noises_of(explore)
    collection = make_collection(config, [0], learners, explore, noises, CPU, print)
    batches = collection.batches(100 * num_envs, resumed=False)
    multi_step, buffer = MultiStep(config.agent.n_steps, config.agent.gamma), make_buffer(10**4, CPU, 0)
    counter, recorder, counts = BatchCounter(world), TrainingRecorder(world, num_envs, CPU), dict.fromkeys(MOST, 0.0)
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
            recorder.update(batch, *counter(batch))
            spent("count")
            steps = multi_step(to_transitions(batch))
            if len(steps):
                store(buffer, steps)
            spent("store")
        if k >= 8:
            with mode, readings:
                minibatch = draw(buffer, 256, learner.loss.reads)
                update_step(minibatch, *learner.updates, config.agent)
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


def test_a_step_of_fixed_sizes_does_not_wait_in_space():
    world = SurveillanceConfig(dimension=3, horizon=100, on_violation="continue")
    assert waits(world, 16, fixed_sizes=True)["collect"] == 0
