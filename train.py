"""Train MADDPG behind the safety filter: build, collect, update, evaluate, log, checkpoint.

``python train.py --help`` explains the command line; README.md the run folder and the TensorBoard tags.
"""

import functools
import json
import logging
import sys
import time
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from agents.checkpoint import keep_newest, save_checkpoint, set_aside, world_sizes
from agents.evaluation import evaluate_policy, evaluation_scalars, rollout_steps
from agents.incident import check_violations
from agents.maddpg import check_finite, make_loss, make_optimizers, update_step
from agents.networks import make_actor, make_critic, make_policies
from agents.pipeline import MultiStep, make_buffer, make_collector, pick_device, to_transitions, use_threads
from agents.recorder import Every, TrainingRecorder
from conf.callbacks import one_clear_error
from conf.run_folder import announce_certificate, finished_run, write_json
from conf.schema import Config, config_hash, register, to_config
from conf.versions import git_hash, package_versions
from envs import SurveillanceEnv, keys
from envs.rendering import save_training_curve

register()
logging.getLogger("torchrl").setLevel(logging.WARNING)


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
@one_clear_error
def main(cfg: DictConfig) -> None:
    """One run: its folder is Hydra's run folder."""
    config: Config = to_config(cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    if message := finished_run(folder, config.resume):  # a job of a multirun; single runs end before they get here
        tqdm.write(message)
        return
    set_aside(folder)
    origin = {
        "config_hash": config_hash(cfg),
        "git_hash": git_hash(),
        "versions": package_versions(),
        "seed": config.seed,
    }

    # ---- build: every random stream has its own seed; the global one draws the initial weights only
    start, device = time.perf_counter(), pick_device(config.device)
    use_threads(config.threads)
    env_seed, noise_seed, buffer_seed, eval_seed = np.random.SeedSequence(config.seed).generate_state(4).tolist()
    torch.manual_seed(config.seed)
    env = SurveillanceEnv(config.env, config.collector.num_envs, device, seed=env_seed, compile=config.compile)
    eval_env = SurveillanceEnv(config.env, config.eval.num_envs, device, compile=config.compile)
    actor = make_actor(env.n_observation, config.env, config.agent).to(device)
    critic = make_critic(env.n_observation, config.env, config.agent).to(device)
    policies = make_policies(actor, config.env, config.safety, config.agent, noise_seed, device, compile=config.compile)
    policy, explore_policy = policies
    loss_module, target_updater = make_loss(actor, critic, config.agent, config.safety, config.env)
    optimizers = make_optimizers(loss_module, config.agent)
    minibatches = config.env.n_agents if config.agent.minibatch == "per_agent" else 1
    buffer = make_buffer(config.buffer.capacity, config.buffer.batch_size * minibatches, device, buffer_seed)
    multi_step = MultiStep(config.agent.n_steps, config.agent.gamma)
    collector = make_collector(env, explore_policy, config.collector.frames_per_batch, config.collector.total_frames)
    recorder = TrainingRecorder(config.env, config.collector.num_envs, device)
    writer = SummaryWriter(str(folder))
    adversary = config.adversary_reward()
    check = functools.partial(check_violations, world=config.env, safety=config.safety, folder=folder)
    announce_certificate(folder, config.env)

    def log(scalars: dict[str, float]) -> None:
        for tag, value in scalars.items():
            writer.add_scalar(tag, value, recorder.frames)

    def evaluate() -> dict:
        eval_env.set_seed(eval_seed)  # the same start states every time
        steps = config.eval.steps or rollout_steps(config.env.horizon)
        metrics, statistics, _ = evaluate_policy(eval_env, policy, steps, check=check)
        log(evaluation_scalars(metrics))
        return metrics | {"filter": statistics}

    def checkpoint() -> None:
        content = {
            "world": world_sizes(env),
            "seed": config.seed,
            "actor": actor.state_dict(),
            "loss": loss_module.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
            "env": env.state_dict(),
            "noise": explore_policy[1].get_extra_state(),
            "recorder": recorder.state_dict(),
        }
        save_checkpoint(folder / "checkpoints" / f"frames_{recorder.frames:012d}.pt", content)
        keep_newest(folder / "checkpoints", config.checkpoint.keep)

    # ---- train: noise, then filter, then execution (explore_policy); the buffer holds executed and nominal actions
    log_due = Every(max(1, config.collector.total_frames // 200))
    eval_due, save_due = Every(config.eval.interval_frames), Every(config.checkpoint.interval_frames)
    episodes_due = Every(config.checkpoint.interval_episodes)
    seconds = {"collect": 0.0, "update": 0.0, "evaluate": 0.0}
    losses: dict[str, torch.Tensor] = {}
    evaluate()  # the untrained policy
    interval = 1.0 if sys.stderr.isatty() else 30.0  # a line now and then in a log file
    bar = tqdm(total=config.collector.total_frames, unit="frame", unit_scale=True, mininterval=interval)
    mark = time.perf_counter()
    for batch in collector:
        recorder.update(batch)
        check(batch)
        transitions = to_transitions(batch, config.train.violation_penalty, adversary)
        if len(steps := multi_step(transitions)):
            buffer.extend(steps)
        collected = time.perf_counter()
        if recorder.frames >= config.train.warmup_frames and len(buffer):
            for _ in range(config.train.n_updates):
                losses = update_step(buffer.sample(), loss_module, optimizers, target_updater, config.agent)
        updated = time.perf_counter()
        if log_due(recorder.frames):
            scalars = recorder.scalars() | {"train/noise": explore_policy[1].sigma}
            scalars["train/reward"] = float(transitions["next"][keys.REWARD].mean())  # the objective's
            numbers = {name: float(value) for name, value in losses.items()}
            check_finite(numbers, recorder.frames)
            log(scalars | {f"loss/{name}": value for name, value in numbers.items()})
            log({f"time/{name}_s": value for name, value in seconds.items()})
            log({"time/frames_per_second": recorder.frames / (updated - start)})
            bar.set_postfix_str(recorder.progress(scalars), refresh=False)
        bar.update(batch.numel())
        if eval_due(recorder.frames) and recorder.frames < config.collector.total_frames:  # the last one follows below
            evaluate()
        if save_due(recorder.frames) | episodes_due(recorder.episodes.episodes):
            checkpoint()
        seconds["collect"] += collected - mark
        seconds["update"] += updated - collected
        mark = time.perf_counter()
        seconds["evaluate"] += mark - updated
    collector.shutdown()
    bar.close()

    # ---- conclude
    checkpoint()
    metrics = evaluate()
    curves = {name: np.array(values) for name, values in recorder.episodes.finished.items()}
    save_training_curve(curves, folder / "figures" / "training.png")
    wall_time = time.perf_counter() - start
    speed = {"wall_time_s": wall_time, "frames_per_second": recorder.frames / wall_time, "time": seconds}
    write_json(folder / "summary.json", origin | recorder.summary() | speed | {"eval": metrics})
    writer.close()
    tqdm.write(f"{folder}/summary.json\n{json.dumps(metrics, indent=2)}")


if __name__ == "__main__":
    main()
