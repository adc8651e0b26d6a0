"""Step, replay and update on a device that is not the processor: nothing is mixed up, nothing is read back.

PyTorch's meta device stands in for a GPU. It computes shapes only; operations on tensors of two devices raise, and so does
everything that needs a number on the host.
"""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from agents import make_controller
from agents.config import AgentConfig
from agents.divergence import check_batch
from agents.evaluation import evaluate_policy
from agents.incident import check_violations
from agents.learners import make_learners
from agents.maddpg import update_step
from agents.networks import make_policies
from agents.noise import ExplorationNoise
from agents.pipeline import MultiStep, to_transitions
from agents.recorder import BatchCounter, TrainingRecorder
from agents.replay import Replay
from agents.training_config import Config
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.blocks import WorldBlock
from envs.density import Density
from envs.randomness import restore_generator
from envs.starts import draw_starts
from safety import SafetyConfig, SafetyFilter

META = torch.device("meta")
WORLDS = {
    "default": {},
    "five robots in 3-D": {"n_agents": 5, "dimension": 3},
    "density per world, centroids": {
        "density": "gaussian_mixture",
        "density_per_world": True,
        "observe_centroid": True,
    },
    "moving density, no episodes": {"density": "moving", "horizon": 0},
}


class AskedGenerator(torch.Generator):
    """The processor's generator in the place of one for the stand-in, which has none; it knows what was asked for."""

    def __new__(cls, device="cpu"):
        made = super().__new__(cls, device="cpu")
        made.asked = torch.device(device)
        return made

    def __init__(self, device="cpu"):
        pass

    @property
    def device(self):
        return self.asked


class DrawsOnItsDevice(torch.overrides.TorchFunctionMode):
    """Fails where random numbers for one device are drawn by a generator for another, as PyTorch does with a GPU."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        out, generator = func(*args, **(kwargs or {})), (kwargs or {}).get("generator")
        if generator is not None:
            assert generator.asked.type == out.device.type, func
        return out


class ReadsZeros(torch.overrides.TorchFunctionMode):
    """What the host reads of the stand-in's tensors is true or 0: for code that counts a batch, which has to read."""

    READS = (
        torch.Tensor.tolist,
        torch.Tensor.item,
        torch.Tensor.__bool__,
        torch.Tensor.__int__,
        torch.Tensor.__float__,
    )

    def __init__(self, truth):
        super().__init__()
        self.count, self.truth = 0, truth

    def __torch_function__(self, func, types, args=(), kwargs=None):
        to_host = func is torch.Tensor.cpu or (func is torch.Tensor.to and args[1] == "cpu")
        if (func in self.READS or to_host) and args[0].device == META:
            self.count += 1
            read = torch.zeros(args[0].shape, dtype=args[0].dtype)
            args = (read | self.truth if read.dtype == torch.bool else read,)
        return func(*args, **(kwargs or {}))


@pytest.fixture(autouse=True)
def generators(monkeypatch):
    monkeypatch.setattr(torch, "Generator", AskedGenerator)
    monkeypatch.setattr(Density, "reference_cost", lambda self: 1.0)  # a number, read once at the start
    monkeypatch.setattr(torch.Tensor, "is_set_to", lambda *_: False)  # of TorchRL's targets
    with DrawsOnItsDevice():
        yield


def moved(thing):
    """An environment or density with its tensors on the stand-in; they are made on the processor, which may read them."""
    for name, value in vars(thing).items():
        if isinstance(value, torch.Tensor | TensorDict):
            vars(thing)[name] = value.to(META)
        elif isinstance(value, Density):
            moved(value)
    return thing


def world_of(name):
    return SurveillanceConfig(**{"resolution": 5, "on_violation": "continue", "horizon": 50} | WORLDS[name])


def filter_inputs():
    """Nominal actions, positions, energies and slots of six worlds."""
    vectors = (torch.empty(6, 3, 2, device=META) for _ in range(2))
    return *vectors, torch.empty(6, 3, device=META), torch.zeros(6, 3, dtype=torch.int64, device=META)


def on_the_stand_in(tensordict):
    return all(value.device == META for value in tensordict.values(True, True))


def learners_on_the_stand_in(n_observation, config, seeds):
    """Made there: modules cannot be moved to it as they are to a GPU, which keeps their parameters."""
    with META:
        return make_learners(n_observation, config.env, config.agent, config.safety, META, seeds=seeds)


def roll_out(world, config, steps):
    """Collected steps ``(4, steps)``: policy, noise, filter, world."""
    env = SurveillanceEnv(world, 4, seed=0, fixed_sizes=True)
    td = env.reset().to(META)
    moved(env)
    env._device = META
    _, learner = learners_on_the_stand_in(env.n_observation, config, [0])
    _, explore = make_policies(learner.actor, world, config.safety, config.agent, 0, META, fixed_sizes=True)
    batch = []
    with torch.no_grad():
        for _ in range(steps):
            explore(td)
            following = env._step(td)
            batch.append(td.clone().set("next", following))
            td = following.exclude(keys.REWARD)
    return torch.stack(batch, dim=1), learner


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("noise", ["ou", "gaussian"])
def test_steps_replay_and_updates(name, noise):
    world = world_of(name)
    config = Config(env=world, agent=AgentConfig(noise=noise))
    batch, learner = roll_out(world, config, 8)
    assert on_the_stand_in(batch)
    multi_step = MultiStep(config.agent.n_steps, config.agent.gamma)
    replay = Replay(1000, [0], META)
    for part in batch.split(2, dim=1):
        replay.store(multi_step(to_transitions(part, violation_penalty=1.0)))
    assert len(replay.parts[0]) == 4 * (8 - config.agent.n_steps + 1)
    rows = replay.draw(64, learner.loss.reads)
    assert on_the_stand_in(rows)
    losses = update_step(rows, *learner.updates, config.agent)
    assert all(loss.device == META for loss in losses.values())


@pytest.mark.parametrize(
    "agent", [{"max_grad_norm": 1.0}, {"share_params": False}, {"critic_action": "executed"}], ids=str
)
def test_updates_of_several_learners(agent):
    world = world_of("default")
    config = Config(env=world, agent=AgentConfig(n_steps=1, **agent))
    batch, _ = roll_out(world, config, 3)
    learners, learner = learners_on_the_stand_in(batch[keys.OBSERVATION].shape[-1], config, [0, 1])
    rows = to_transitions(batch).reshape(-1)
    losses = update_step(torch.stack([rows, rows]), *learner.updates, config.agent)
    assert all(loss.shape == (2,) and loss.device == META for loss in losses.values())
    learner.share_moments()
    learner.gather_moments()
    assert len(learners) == 2


@pytest.mark.parametrize(
    "safety", [{}, {"split": "half"}, {"mode": "paper"}, {"mode": "dalal", "dalal_steps": 3}, {"mode": "none"}]
)
def test_filters(safety):
    world = world_of("default")
    f = SafetyFilter(SafetyConfig(**safety), world, fixed_sizes=True)
    with torch.no_grad():
        assert all(out.device == META for out in f.filter(*filter_inputs()))


@pytest.mark.parametrize("name", WORLDS)
def test_counting_and_checking_a_batch(name, tmp_path):
    world = world_of(name)
    batch, _ = roll_out(world, Config(env=world), 3)
    counter, recorder = BatchCounter(world), TrainingRecorder(world, 4, META)
    for step in batch.split(1, dim=1):
        with ReadsZeros(truth=False) as reads:
            recorder.update(*counter(step))
            check_violations(step, world=world, safety=SafetyConfig(), folder=tmp_path)
        assert reads.count == 2
        with ReadsZeros(truth=True):
            check_batch(step, recorder.frames)
    assert recorder.frames == 12
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", WORLDS)
def test_start_states(name):
    world = world_of(name)
    env = moved(SurveillanceEnv(world, 4))
    generator = AskedGenerator(META)
    starts = draw_starts(5, world, env.geometry, env.slots, env.bounds, generator)
    assert all(value.device == META for value in (*starts, env.density.sample(5, generator)))


@pytest.mark.parametrize("name", WORLDS)
def test_evaluation(name, monkeypatch):
    world = world_of(name)
    env = moved(SurveillanceEnv(world, 4, seed=0, fixed_sizes=True))
    env._device = META
    monkeypatch.setattr(WorldBlock, "draw_index", lambda self, mask: torch.arange(4, device=META))
    env.blocks[0].generator = AskedGenerator(META)
    monkeypatch.setattr(env, "reset", lambda *_: env._reset())
    monkeypatch.setattr(env, "step", lambda td: td.set("next", env._step(td)))
    controller = make_controller("lloyd", world)
    policy = TensorDictSequential(controller, SafetyFilter(SafetyConfig(), world, fixed_sizes=True))
    with torch.no_grad(), ReadsZeros(truth=False):
        metrics, statistics, _ = evaluate_policy(env, policy, 3)
    assert metrics["robot_steps"] == 0  # everything that is read is
    assert statistics


def test_the_stand_in_would_tell():
    with pytest.raises(RuntimeError, match="device"):
        torch.zeros(3, device=META) + torch.zeros(3)
    with pytest.raises((RuntimeError, NotImplementedError)):
        bool(torch.zeros(3, device=META).any())
    with pytest.raises(AssertionError):
        torch.rand(3, generator=AskedGenerator(), device=META)
    selecting = SafetyFilter(SafetyConfig(), world_of("default"))
    with torch.no_grad(), pytest.raises((RuntimeError, NotImplementedError)):
        selecting.filter(*filter_inputs())


def test_a_state_of_another_kind_of_device_seeds_the_generator():
    gpu = torch.arange(16, dtype=torch.uint8)  # the size of a GPU's
    draws = []
    for state in (gpu, gpu, gpu + 1):
        generator = torch.Generator().manual_seed(5)
        restore_generator(generator, state)
        draws.append(torch.rand(4, generator=generator))
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    source, target = torch.Generator().manual_seed(3), torch.Generator()
    restore_generator(target, source.get_state())
    assert torch.equal(torch.rand(4, generator=source), torch.rand(4, generator=target))


def test_noise_of_a_checkpoint_goes_on_where_the_generator_is():
    world = world_of("default")
    noise = ExplorationNoise(AgentConfig(noise="ou"), world, 0, META)
    action, step = torch.empty(4, 3, 2, device=META), torch.zeros(4, 1, dtype=torch.int64, device=META)
    td = TensorDict({keys.NOMINAL_ACTION: action, keys.STEP_COUNT: step}, [4])
    assert noise(td)[keys.NOMINAL_ACTION].device == META
    again = ExplorationNoise(AgentConfig(noise="ou"), world, 1, META)
    again.set_extra_state(noise.get_extra_state())
    assert again(td)[keys.NOMINAL_ACTION].device == META
