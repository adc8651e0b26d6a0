"""python tests/benchmarks/bench_training.py [--worlds 250] [--steps 100] [--repeats 5] [--tables training,parts] [override ...]

Training as a whole against TorchRL's MADDPG on VMAS simple_spread (needs vmas: ``pip install -e .[bench]``), 3 robots, one
process, the contestants in turn, medians of the rounds. One round of each is ``--steps`` vector steps of its worlds and
``train.n_updates`` updates per vector step; ten seeds take a fifth as many. Other words are overrides of
train.py, such as ``device=cuda cuda_graphs=true``: all contestants are then on the GPU.

The baseline does what TorchRL's sota-implementations/multiagent/maddpg_iddpg.py does, written anew from the public interfaces
of TorchRL: VmasEnv with RewardSum, MultiAgentMLP actor (TanhDelta, AdditiveGaussianModule) and centralised critic, Collector,
replay, DDPGLoss with SoftUpdate, one Adam, gradient norm cut to 40. Its two rows differ in their flow of data:

- the script's: ``--steps`` vector steps a batch, a replay of just this batch, sampled without replacement, then all updates.
  60,000 frames from 600 worlds with 100 steps each there; here as many worlds and updates as ours.
- one vector step a batch: uniform replay of ``buffer.capacity`` transitions and ``train.n_updates`` updates after each, as ours.

It deviates from the script in what the comparison has to have equal: simple_spread instead of balance, our layers (units,
ReLU, shared parameters), minibatch, discount and learning rate; no evaluation, no logger.

The work is not the same. Only ours has the coverage integral, batteries and docking, the foresight of the critics, n-step
targets, nominal beside executed actions, target actors, the counting of violations and the checks of every batch (column
"count"), and the certified filter; only VMAS simulates forces and contacts; its critics see all observations.
Both profit from the memory that :func:`agents.pipeline.use_threads` keeps. frames/s end to end is of everything: collection,
counting, storing, sampling, updates. Evaluation, logging and checkpoints are in nobody's.

Second table: parts of one iteration of train.py without these, of the default run and of ``experiment=paper``.
"""

import argparse
import logging
import statistics
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import harness
import torch
from hydra import compose, initialize_config_dir
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler, SamplerWithoutReplacement
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.libs.vmas import VmasEnv
from torchrl.modules import AdditiveGaussianModule, ProbabilisticActor, TanhDelta, ValueOperator
from torchrl.modules.models.multiagent import MultiAgentMLP
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from agents.collection import make_collection
from agents.divergence import check_batch
from agents.incident import check_violations
from agents.learners import make_learners, make_update
from agents.networks import make_policies
from agents.noise import noises_of
from agents.pipeline import MultiStep, pick_device, to_transitions, use_threads
from agents.recorder import BatchCounter, Seconds, TrainingRecorder
from agents.replay import Replay
from agents.seeds import minibatches
from agents.training_config import Config
from conf.schema import register, to_config
from envs import SurveillanceEnv

CONF = Path(__file__).resolve().parents[2] / "conf"
MANY = 10
SCRIPT, STEPWISE = "TorchRL, script's way", "TorchRL, one step a batch"
UNFILTERED, CERTIFIED, SEEDS = "ours, unfiltered", "ours, certified", f"ours, certified, {MANY} seeds"
PARTS = ("collect", "count", "store", "sample", "update")


class Contestant:
    """A training loop whose parts can be timed.

    Args:
        batches: the collector's.
        frames: frames of a batch.
        updates: updates per batch.
        store: takes a batch in.
        samples: draws minibatches.
        update: learns from them.
        end: called after the updates of a batch.
        count: counts and checks a batch.
        device: waited for at the end of each part.
    """

    def __init__(
        self,
        batches: Iterator[TensorDictBase],
        frames: int,
        updates: int,
        store: Callable[[TensorDictBase], object],
        samples: Callable[[], Iterator[TensorDictBase]],
        update: Callable[[Iterator[TensorDictBase]], object],
        end: Callable[[], object] = lambda: None,
        count: Callable[[TensorDictBase], object] = lambda batch: None,
        device: str = "cpu",
    ) -> None:
        self.device = device
        self.batches, self.frames, self.updates = batches, frames, updates
        self.store, self.samples, self.update = store, samples, update
        self.end, self.count = end, count

    def run(self, batches: int) -> dict[str, float]:
        """Seconds per frame of each part, over a number of batches."""
        spent = dict.fromkeys(PARTS, 0.0)
        mark = harness.clock(self.device)

        def done(part: str) -> None:
            nonlocal mark
            now = harness.clock(self.device)
            spent[part] += now - mark
            mark = now

        def drawn() -> Iterator[TensorDictBase]:
            for minibatch in self.samples():
                done("sample")
                yield minibatch
                done("update")

        for _ in range(batches):
            batch = next(self.batches)
            done("collect")
            self.count(batch)
            done("count")
            self.store(batch)
            done("store")
            self.update(drawn())
            self.end()
            done("update")
        return {part: seconds / (batches * self.frames) for part, seconds in spent.items()}


# ---- the baseline ---------------------------------------------------------------------------------------------------
def baseline(config: Config, steps: int) -> Contestant:
    """TorchRL's MADDPG on VMAS with batches of ``steps`` vector steps; several: the replay is the batch, as in the script."""
    torch.manual_seed(0)
    worlds, agent, n_agents = config.collector.num_envs, config.agent, config.env.n_agents
    device = pick_device(config.device)
    vmas = VmasEnv(
        "simple_spread",
        num_envs=worlds,
        n_agents=n_agents,
        continuous_actions=True,
        max_steps=100,
        device=device,
        seed=0,
    )
    env = TransformedEnv(vmas, RewardSum(in_keys=[vmas.reward_key], out_keys=[("agents", "episode_reward")]))
    spec, action_key = env.full_action_spec_unbatched, env.action_key
    n_observation, n_action = env.observation_spec["agents", "observation"].shape[-1], spec[action_key].shape[-1]

    def network(n_in: int, n_out: int, cells: list[int], *, centralized: bool) -> MultiAgentMLP:
        shared = agent.share_params
        return MultiAgentMLP(
            *(n_in, n_out, n_agents),
            centralized=centralized,
            share_params=shared,
            num_cells=cells,
            activation_class=nn.ReLU,
            device=device,
        )

    actor = network(n_observation, n_action, agent.actor_cells, centralized=False)
    space: Any = spec[action_key].space
    policy = ProbabilisticActor(
        TensorDictModule(actor, in_keys=[("agents", "observation")], out_keys=[("agents", "param")]),
        spec=spec,
        in_keys=[("agents", "param")],
        out_keys=[action_key],
        distribution_class=TanhDelta,
        distribution_kwargs={"low": space.low, "high": space.high},
        return_log_prob=False,
    )
    annealing = config.collector.total_frames // 2
    noise = AdditiveGaussianModule(spec=spec, annealing_num_steps=annealing, action_key=action_key, device=device)
    value = ("agents", "state_action_value")
    critic = ValueOperator(
        network(n_observation + n_action, 1, agent.critic_cells, centralized=True),
        in_keys=[("agents", "observation"), action_key],
        out_keys=[value],
    )

    def done_of_agents(batch: TensorDictBase) -> TensorDictBase:
        following = batch["next"]
        for name in ("done", "terminated"):
            following["agents", name] = following[name].unsqueeze(-1).expand(following[env.reward_key].shape)
        return batch

    frames, updates = worlds * steps, config.train.n_updates * steps
    explore = TensorDictSequential(policy, noise)
    options = {"postproc": done_of_agents, "auto_register_policy_transforms": False, "device": device}
    collector = Collector(env, explore, frames_per_batch=frames, total_frames=-1, **options)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames if steps > 1 else config.buffer.capacity, device=device),
        sampler=SamplerWithoutReplacement() if steps > 1 else RandomSampler(),
        batch_size=config.buffer.batch_size,
    )
    loss = DDPGLoss(policy, critic, delay_value=True)
    done, terminated = ("agents", "done"), ("agents", "terminated")
    loss.set_keys(state_action_value=value, reward=env.reward_key, done=done, terminated=terminated)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=agent.gamma)
    target, optimizer = SoftUpdate(loss, tau=agent.tau), torch.optim.Adam(loss.parameters(), lr=agent.actor_lr)

    def samples() -> Iterator[TensorDictBase]:
        return (buffer.sample() for _ in range(updates))

    def update(minibatches: Iterator[TensorDictBase]) -> None:
        for minibatch in minibatches:
            losses = loss(minibatch)
            (losses["loss_actor"] + losses["loss_value"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 40.0)
            optimizer.step()
            optimizer.zero_grad()
            target.step()

    def end() -> None:
        noise.step(frames)
        collector.update_policy_weights_()

    def store(batch: TensorDictBase) -> None:
        buffer.extend(batch.reshape(-1))

    return Contestant(iter(collector), frames, updates, store, samples, update, end, device=device.type)


# ---- ours -----------------------------------------------------------------------------------------------------------
def ours(config: Config, n_seeds: int = 1) -> tuple[Contestant, Seconds]:
    """The loop of train.py, and the clock that watches the parts of its collection."""
    seeds, device, worlds = list(range(n_seeds)), pick_device(config.device), config.collector.num_envs
    n_observation = SurveillanceEnv(config.env).n_observation
    arguments, graphs = (config.env, config.agent, config.safety, device), {"cuda_graphs": config.cuda_graphs}
    learners, learner = make_learners(n_observation, *arguments, seeds=seeds, **graphs)
    update = make_update(learner, config.agent, config.safety, **graphs)
    _, explore = make_policies(
        *(learner.actor, config.env, config.safety, config.agent, seeds, device), **config.computing
    )
    noises = noises_of(explore)
    collection = make_collection(config, seeds, learners, explore, noises, device, print)
    multi_step = MultiStep(config.agent.n_steps, config.agent.gamma, n_blocks=n_seeds)
    replay = Replay(config.buffer.capacity, seeds, device)
    counter = BatchCounter(config.env, n_seeds, **graphs)
    recorders = [TrainingRecorder(config.env, worlds, device) for _ in seeds]
    folder = Path(tempfile.gettempdir())  # of violation.json; a violation ends the program
    seconds = Seconds("collect")
    seconds.watch("policy", explore)
    seconds.watch("filter", explore[-1])

    def count(batch: TensorDictBase) -> None:
        seconds.spent("collect")
        for recorder, counted in zip(recorders, counter(batch), strict=True):
            if recorder.update(counted):
                check_violations(counted.batch, world=config.env, safety=config.safety, folder=folder)
                check_batch(counted.batch, recorder.frames)

    def keep(batch: TensorDictBase) -> None:
        replay.store(multi_step(to_transitions(batch, config.train.violation_penalty)))

    def samples() -> Iterator[TensorDictBase]:
        return minibatches(replay, config.train.n_updates, config.batch_size, learner.loss.reads)

    per_batch = n_seeds * config.collector.frames_per_batch
    batches = collection.batches(10**6 * per_batch, resumed=False)
    for _ in range(config.agent.n_steps):  # the buffers are not empty when the updates begin
        keep(next(batches))

    contestant = Contestant(
        batches, per_batch, config.train.n_updates, keep, samples, update, count=count, device=device.type
    )
    return contestant, seconds


# ---- tables ---------------------------------------------------------------------------------------------------------
def composed(*overrides: str) -> Config:
    """The configuration of train.py with these overrides."""
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return to_config(compose("config", overrides=list(overrides)))


def medians(rounds: Sequence[dict[str, float]]) -> dict[str, float]:
    """Median of each part."""
    return {part: statistics.median(own[part] for own in rounds) for part in rounds[0]}


def comparison(options, overrides: Sequence[str]) -> list[list]:
    """First table."""
    sizes = (f"collector.num_envs={options.worlds}", f"collector.total_frames={4000 * options.worlds}")
    certified, unfiltered = composed(*sizes, *overrides), composed(*sizes, *overrides, "safety=none")
    steps = options.steps
    contestants = {  # with the batches of a round
        SCRIPT: (baseline(certified, steps), 1),
        STEPWISE: (baseline(certified, 1), steps),
        UNFILTERED: (ours(unfiltered)[0], steps),
        CERTIFIED: (ours(certified)[0], steps),
    }
    if options.seeds > 1:
        contestants[SEEDS.replace(str(MANY), str(options.seeds))] = (
            ours(certified, options.seeds)[0],
            max(1, steps // 5),
        )
    rounds = {name: [] for name in contestants}
    for k in range(options.repeats + 1):
        for name, (contestant, batches) in contestants.items():
            spent = contestant.run(batches)
            if k:  # the first is the warm-up
                rounds[name].append(spent | {"all": sum(spent.values())})
    times = {name: medians(own) for name, own in rounds.items()}
    best = {part: min(times[name][part] for name in (SCRIPT, STEPWISE)) for part in ("collect", "all")}
    rows = []
    for name, spent in times.items():
        contestant, _ = contestants[name]
        per_update = 1e3 * contestant.frames / contestant.updates if contestant.updates else float("nan")
        rows.append(
            [
                *(
                    options.worlds,
                    certified.env.n_agents,
                    name,
                    1 / spent["collect"],
                    best["collect"] / spent["collect"],
                ),
                *(
                    1e6 * spent["count"],
                    1e6 * spent["store"],
                    spent["sample"] * per_update,
                    spent["update"] * per_update,
                ),
                *(1 / spent["all"], best["all"] / spent["all"]),
            ]
        )
    return rows


def iteration(name: str, options, overrides: Sequence[str]) -> list:
    """A row of the second table."""
    config = composed(*overrides)
    contestant, seconds = ours(config)
    contestant.run(max(2, options.steps // 10))
    rounds = []
    for _ in range(options.repeats):
        seconds.inside = dict.fromkeys(seconds.inside, 0.0)
        spent, frames = contestant.run(options.steps), options.steps * contestant.frames
        chosen, policy = (seconds.inside[part] / frames for part in ("filter", "policy"))
        parts = {"filter": chosen, "inference": policy - chosen, "env": spent.pop("collect") - policy} | spent
        rounds.append(parts)
    times = medians(rounds)
    total = sum(times.values())
    cells = [f"{1e3 * contestant.frames * own:.2f} ({100 * own / total:.0f} %)" for own in times.values()]
    return [config.collector.num_envs, config.env.n_agents, name, 1e3 * contestant.frames * total, *cells, 1 / total]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=250, help="per learner, default 250")
    parser.add_argument("--steps", type=int, default=100, help="vector steps of a round, default 100")
    parser.add_argument("--repeats", type=int, default=5, help="rounds after the warm-up, default 5")
    parser.add_argument("--seeds", type=int, default=MANY, help=f"of the last row, default {MANY}; 1 leaves it out")
    parser.add_argument("--tables", default="training,parts", help="which of the two, default training,parts")
    options, overrides = parser.parse_known_args(arguments)
    use_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    print(f"{harness.machine(pick_device(composed(*overrides).device).type)}\n")
    header = (
        *(
            "worlds",
            "N",
            "training",
            "collected frames/s",
            "/ TorchRL",
            "count us",
            "store us",
            "sample ms",
            "update ms",
        ),
        *("frames/s end to end", "/ TorchRL"),
    )
    note = "Ratios of frames/s to the faster of TorchRL's two rows. Counting, storing: per frame; sampling, update: per update."
    if "training" not in options.tables:
        pass
    elif harness.optional("vmas") is not None:
        harness.table("Training", header, comparison(options, overrides), note)
    else:
        print(harness.missing("vmas"))
    if "parts" in options.tables:
        header = (
            "worlds",
            "N",
            "run",
            "ms",
            "filter",
            "inference",
            "env, collector",
            "count",
            "store",
            "sample",
            "update",
        )
        runs = {"default": overrides, "experiment=paper": ("experiment=paper", *overrides)}
        rows = (iteration(name, options, own) for name, own in runs.items())
        note = "ms (share) of an iteration: one vector step with its updates."
        harness.table("One iteration of train.py", (*header, "frames/s"), rows, note)


if __name__ == "__main__":
    main()
