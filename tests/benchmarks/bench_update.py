"""python tests/benchmarks/bench_update.py [--batches 256,1024] [--robots 3] [--envs 128]

Learning. First table: one MADDPG update of all robots with minibatches of B transitions, without and with the filter in the
loss (``safety.in_loss``), against TorchRL's own pieces with the same networks: ``DDPGLoss`` as it is, Adam, ``SoftUpdate``.
Second table: collection of one batch from ``--envs`` worlds, and collection, replay and one update, in frames (world-steps)
per second, by filter; the vanilla row collects unfiltered and updates with TorchRL's pieces.
"""

from collections.abc import Callable, Iterator, Sequence

import harness
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from agents import AgentConfig
from agents.maddpg import make_loss, make_optimizers, update_step
from agents.networks import STATE_ACTION_VALUE, make_actor, make_critic, make_policies
from agents.pipeline import collect, to_transitions
from agents.replay import Replay
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig

VANILLA = "TorchRL DDPGLoss"
UPDATES = {
    "MADDPG": SafetyConfig(),
    "MADDPG, certified in loss": SafetyConfig(in_loss=True),
    "MADDPG, stacked in loss": SafetyConfig(mode="paper", in_loss=True),
}
COLLECTED = ("none", "stacked", "certified")
Update = Callable[[TensorDictBase], object]


def vanilla_update(actor: TensorDictModule, critic: TensorDictSequential, agent: AgentConfig) -> Update:
    """An update by TorchRL's loss: the gradient of all critics reaches all actors."""
    executed = TensorDictModule(nn.Identity(), in_keys=[keys.NOMINAL_ACTION], out_keys=[keys.ACTION])
    loss = DDPGLoss(TensorDictSequential(actor, executed), critic, delay_actor=True, delay_value=True)
    loss.set_keys(state_action_value=STATE_ACTION_VALUE, reward=keys.REWARD, done=keys.DONE, terminated=keys.TERMINATED)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=agent.gamma)
    updater, optimizers = SoftUpdate(loss, tau=agent.tau), make_optimizers(loss, agent)

    def update(batch: TensorDictBase) -> None:
        losses = loss(batch)
        for name, optimizer in optimizers.items():
            optimizer.zero_grad()
            losses[name].backward()
            optimizer.step()
        updater.step()

    return update


def make_update(name: str, env: SurveillanceEnv, agent: AgentConfig) -> tuple[TensorDictModule, Update]:
    """Fresh networks and their update."""
    torch.manual_seed(0)
    actor, critic = (make(env.n_observation, env.config, agent).to(env.device) for make in (make_actor, make_critic))
    if name == VANILLA:
        return actor, vanilla_update(actor, critic, agent)
    loss, updater = make_loss(actor, critic, agent, UPDATES[name], env.config)
    optimizers = make_optimizers(loss, agent)
    return actor, lambda batch: update_step(batch, loss, optimizers, updater, agent)


def update_rows(world: SurveillanceConfig, options, budget: harness.Budget) -> Iterator[list]:
    """First table, on transitions of the noisy initial policy behind the certified filter."""
    agent = AgentConfig()
    env = SurveillanceEnv(world, 256, options.device)
    updates = {name: make_update(name, env, agent) for name in (VANILLA, *UPDATES)}
    _, explore = make_policies(updates["MADDPG"][0], world, SafetyConfig(), agent, 0, env.device)
    with torch.no_grad():
        steps = -(-options.batches[-1] // 256)
        transitions = to_transitions(env.rollout(steps, explore, break_when_any_done=False)).reshape(-1)
    for size in options.batches:
        batch = transitions[:size]
        chains = {name: (lambda u=update, b=batch: u(b),) for name, (_, update) in updates.items()}
        times = {name: t and t[0] for name, t in budget.medians(chains, size, world.n_agents).items()}
        for name, spent in times.items():
            yield [size, world.n_agents, name, spent, spent and 1e3 / spent, harness.ratio(spent, times[VANILLA])]


def training_rows(world: SurveillanceConfig, options, budget: harness.Budget) -> list[list]:
    """Second table: the loop of train.py without its logging."""
    agent, frames = AgentConfig(), options.envs
    collectors, chains = [], {}
    for name in (VANILLA, *COLLECTED):
        env = SurveillanceEnv(world, options.envs, options.device)
        actor, update = make_update(VANILLA if name == VANILLA else "MADDPG", env, agent)
        safety = harness.FILTERS["none" if name == VANILLA else name]
        _, explore = make_policies(actor, world, safety, agent, 0, env.device)
        collector = collect(env, explore, frames, -1)
        collectors.append(collector)
        replay, batches = Replay(100_000, [0], torch.device(options.device)), iter(collector)

        def learn(batch: TensorDictBase, replay=replay, update=update) -> None:
            rows = to_transitions(batch).reshape(-1)
            replay.store(rows)
            update(replay.draw(options.batches[0], list(rows.keys(True, True))))

        chains[name] = (lambda batches=batches: next(batches), learn)
    times = budget.medians(chains, frames, ("training", world.n_agents))
    for collector in collectors:
        collector.close()
    base = times[VANILLA] and sum(times[VANILLA])
    return [
        [
            *(frames, world.n_agents, name, spent and spent[0], spent and spent[1]),
            *(spent and 1e3 * frames / spent[0], spent and 1e3 * frames / sum(spent)),
            harness.ratio(spent and sum(spent), base),
        ]
        for name, spent in times.items()
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = harness.make_parser(__doc__, batches="256,1024", robots="3", repeats=15)
    parser.add_argument("--envs", type=int, default=128, help="worlds of the collector, default 128")
    options = harness.parse(parser, arguments)
    budget, worlds = harness.Budget(options), [harness.make_world(n, options.dimension) for n in options.robots]
    rows = (row for world in worlds for row in update_rows(world, options, budget))
    header = ("minibatch", "N", "update", "ms", "updates/s", f"/ {VANILLA}")
    harness.table("One update of all robots", header, rows, budget.footnote)
    budget = harness.Budget(options)
    rows = (row for world in worlds for row in training_rows(world, options, budget))
    header = (
        *("worlds", "N", "filter", "collect ms", f"store + update ms (minibatch {options.batches[0]})"),
        *("collected frames/s", "frames/s with updates", f"/ {VANILLA}"),
    )
    note = "Unfiltered worlds end at their violations: their collection contains more resets."
    harness.table("Collection and updates", header, rows, note, budget.footnote)


if __name__ == "__main__":
    main()
