"""Train MADDPG behind the safety filter: build, collect, update, evaluate, log, checkpoint.

``python train.py --help`` explains the command line; README.md the run folder and the TensorBoard tags.
"""

import json
import logging
import sys
from contextlib import closing
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from agents.checkpoint import world_sizes
from agents.collection import make_collection, seeds_of_streams
from agents.evaluation import Evaluator
from agents.interruption import StopSignals
from agents.learners import make_learners, make_update
from agents.networks import actor_of_blocks, make_policies
from agents.noise import noises_of
from agents.pipeline import MultiStep, pick_device, to_transitions, use_threads
from agents.recorder import BatchCounter, Seconds
from agents.replay import Replay
from agents.run import FAILURES, TrainingRun
from agents.seeds import (
    SeedsFailedError,
    check_seeds,
    equally_far,
    errors_by_seed,
    evaluate,
    for_each,
    log,
    minibatches,
    stopped_at,
)
from conf.callbacks import one_clear_error
from conf.command_line import clear_errors
from conf.naming import hashed_config
from conf.run_folder import announce_certificate, objective, only_writers, run_folders, unfinished_seeds, write_json
from conf.schema import Config, register, to_config
from conf.versions import run_origin
from envs import SurveillanceEnv

register()
logging.getLogger("torchrl").setLevel(logging.WARNING)


@clear_errors(Config)
@hydra.main(version_base="1.3", config_path="conf", config_name="config")
@one_clear_error
def main(cfg: DictConfig) -> float | None:
    """One run in Hydra's run folder, or one run per seed as a batch, each in a folder of its own. Returns the coverage cost."""
    config: Config = to_config(cfg)
    output = Path(HydraConfig.get().runtime.output_dir)
    all_folders = run_folders(cfg, config.all_seeds, output).values()
    folders = unfinished_seeds(cfg, config.all_seeds, output, tqdm.write)
    failed: dict[int, str] = {}
    with only_writers(folder for folder in folders.values() if folder != output):
        kept = config.checkpoint.buffer
        for start, group in equally_far(folders, config.resume, tqdm.write, rows=kept) if folders else ():
            try:
                train(cfg, config, group, start)
            except (SeedsFailedError, *FAILURES) as error:
                if len(folders) == 1:
                    raise
                failed |= errors_by_seed(error, group)
    if failed:
        raise SeedsFailedError(failed, len(all_folders) - len(failed))
    return objective(all_folders)


def train(cfg: DictConfig, config: Config, folders: dict[int, Path], start: int) -> None:
    """Train the seeds of ``folders`` as one batch, from a checkpoint of ``start`` frames where there are several."""
    # ---- build: every random stream of a seed has a seed of its own; the global one draws the initial weights only
    seconds = Seconds("build", "collect", "update", "evaluate", "checkpoint")
    device = pick_device(config.device)
    use_threads(config.threads, deterministic=config.deterministic)
    world, agent, safety, seeds = config.env, config.agent, config.safety, list(folders)
    _, noise_seeds, replay_seeds, _ = map(list, zip(*map(seeds_of_streams, seeds), strict=True))
    graphs = {"cuda_graphs": config.cuda_graphs}
    eval_env = SurveillanceEnv(world, len(seeds) * config.eval.num_envs, device, seeds, **config.computing)
    evaluator = Evaluator(eval_env, **graphs)
    learners, learner = make_learners(eval_env.n_observation, world, agent, safety, device, seeds=seeds, **graphs)
    update = make_update(learner, agent, safety, **graphs)
    modules = (learner.actor, world, safety, agent)
    deployed = actor_of_blocks([own.actor for own in learners])
    policy, explore_policy = make_policies(*modules, noise_seeds, device, deployed=deployed, **config.computing)
    noises = noises_of(explore_policy)
    collection = make_collection(config, seeds, learners, explore_policy, noises, device, tqdm.write)
    multi_step = MultiStep(agent.n_steps, agent.gamma, n_blocks=len(folders))
    replay = Replay(config.buffer.capacity, replay_seeds, device)
    counter, adversary = BatchCounter(world, len(folders), **graphs), config.adversary_reward()
    seconds.watch("policy", explore_policy)
    seconds.watch("filter", explore_policy[-1])
    origin, settings = run_origin(cfg, device), hashed_config(cfg)
    runs = [
        TrainingRun(
            *(folder, config, seed, origin | {"seed": seed}, settings),
            learner=learners[k],
            worlds=collection.blocks[k],
            waiting=multi_step.blocks[k],
            noise=noises[k],
            buffer=replay.parts[k],
            sizes=world_sizes(eval_env),
            device=device,
            seconds=seconds,
        )
        for k, (seed, folder) in enumerate(folders.items())
    ]

    # ---- resume: runs that were killed go on where their newest common checkpoint left them
    for run in runs:
        run.begin(tqdm.write, start or -1 if len(runs) > 1 else None)
    start = runs[0].recorder.frames
    learner.gather_moments()
    for run in runs:
        announce_certificate(run.folder, world, show=run is runs[0])
    seconds.spent("build")
    if not start:
        evaluate(runs, evaluator, policy)  # untrained
    seconds.spent("evaluate")

    # ---- train: noise, then filter, then execution (explore_policy); the buffers hold executed and nominal actions
    losses: dict[str, torch.Tensor] = {}
    n_runs, frames = len(runs), config.collector.total_frames - start
    interval = 1.0 if sys.stderr.isatty() else 30.0  # a line now and then in a log file
    total = config.collector.total_frames * n_runs
    bar = tqdm(total=total, initial=start * n_runs, unit="frame", unit_scale=True, mininterval=interval)
    with StopSignals() as stop, closing(collection.batches(frames * n_runs, resumed=start > 0)) as batches:
        for batch in batches:
            transitions = to_transitions(batch, config.train.violation_penalty, adversary)
            counted = counter(batch)
            replay.store(multi_step(transitions))
            seconds.spent("collect")
            if any(run.learns for run in runs):
                losses = update(minibatches(replay, config.train.n_updates, config.batch_size, learner.loss.reads))
            seconds.spent("update")
            for_each(runs, TrainingRun.take, counted)  # checks the batch: a GPU meanwhile goes on with the updates
            seconds.spent("collect")
            log(runs, transitions["next"], losses, seconds)
            bar.set_postfix_str(runs[0].progress, refresh=False)
            bar.update(batch.numel())
            due = [run.evaluates for run in runs]
            if any(due):
                evaluate(runs, evaluator, policy)
            seconds.spent("evaluate")
            due = [run.saves for run in runs]
            if any(due) or stop.received:
                learner.share_moments()
                for_each(runs, TrainingRun.save)
                for_each(runs, TrainingRun.tidy)  # when all have theirs
            seconds.spent("checkpoint")
            stop.check(stopped_at(runs))
    bar.close()

    # ---- conclude
    for_each(runs, TrainingRun.conclude)
    for_each(runs, lambda run: write_json(run.folder / "summary.json", run.summary(seconds, n_runs)))
    for_each(
        runs, lambda run: tqdm.write(f"{run.folder}/summary.json\n{json.dumps(run.recorder.evaluation, indent=2)}")
    )
    check_seeds(runs)


if __name__ == "__main__":
    main()
