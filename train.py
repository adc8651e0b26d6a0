"""Train MADDPG behind the safety filter: build, collect, update, evaluate, log, checkpoint.

``python train.py --help`` explains the command line; README.md the run folder and the TensorBoard tags.
"""

import functools
import json
import logging
import sys
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from agents.board import Board
from agents.checkpoint import world_sizes
from agents.divergence import check_batch, check_finite, check_weights
from agents.evaluation import evaluate_policy, evaluation_scalars, rollout_steps
from agents.incident import check_violations
from agents.interruption import StopSignals
from agents.maddpg import make_loss, make_optimizers, update_step
from agents.networks import make_actor, make_critic, make_policies
from agents.pipeline import MultiStep, collect, make_buffer, pick_device, to_transitions, use_threads
from agents.recorder import Every, Seconds, TrainingRecorder
from agents.training_state import TrainingState
from conf.callbacks import one_clear_error
from conf.command_line import clear_errors
from conf.naming import hashed_config
from conf.run_folder import announce_certificate, finished_run, objective, write_json
from conf.schema import Config, register, to_config
from conf.versions import run_origin
from envs import SurveillanceEnv, keys
from envs.rendering import save_training_curve

register()
logging.getLogger("torchrl").setLevel(logging.WARNING)


@clear_errors(Config)
@hydra.main(version_base="1.3", config_path="conf", config_name="config")
@one_clear_error
def main(cfg: DictConfig) -> float | None:
    """One run: its folder is Hydra's run folder. Returns the coverage cost, for tuning."""
    config: Config = to_config(cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    if message := finished_run(folder, config.resume):  # a job of a multirun; single runs end before they get here
        tqdm.write(message)
        return objective(folder)

    # ---- build: every random stream has its own seed; the global one draws the initial weights only
    seconds = Seconds("build", "collect", "update", "evaluate", "checkpoint")
    device = pick_device(config.device)
    use_threads(config.threads, deterministic=config.deterministic)
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
    recorder = TrainingRecorder(config.env, config.collector.num_envs, device)
    clocks = {
        "log": Every(max(1, config.collector.total_frames // config.log.points)),
        "evaluate": Every(config.eval.interval_frames),
        "save_frames": Every(config.checkpoint.interval_frames),
        "save_episodes": Every(config.checkpoint.interval_episodes),
    }
    seconds.watch("policy", explore_policy)
    seconds.watch("filter", explore_policy[2])
    parts = {"actor": actor, "loss": loss_module, "optimizers": optimizers, "env": env, "noise": explore_policy[1]}
    parts |= {"multi_step": multi_step, "recorder": recorder, "clocks": clocks, "seconds": seconds}
    origin, keep, with_buffer = run_origin(cfg, device), config.checkpoint.keep, config.checkpoint.buffer
    made_for = {"config": hashed_config(cfg), "world": world_sizes(env)}
    state = TrainingState(folder, parts, buffer, origin | made_for, keep=keep, with_buffer=with_buffer)
    adversary = config.adversary_reward()
    check = functools.partial(check_violations, world=config.env, safety=config.safety, folder=folder)

    def evaluate() -> None:
        eval_env.set_seed(eval_seed)  # the same start states every time
        steps = config.eval.steps or rollout_steps(config.env.horizon)
        metrics, statistics, trajectory = evaluate_policy(eval_env, policy, steps, record=board.records, check=check)
        board.scalars(evaluation_scalars(metrics), recorder.frames)
        board.world(trajectory, recorder.frames)
        if recorder.evaluated(metrics | {"filter": statistics}):
            state.save_best()

    # ---- resume: a run that was killed goes on where its newest checkpoint left it
    kept_rows = state.resume(config.resume, tqdm.write)
    resumed_at = recorder.frames
    learn_from = config.train.warmup_frames + (0 if kept_rows else resumed_at)
    settings = hashed_config(cfg) | {"seed": config.seed}
    board = Board(folder, resumed_at, settings, figures=config.log.figures, gif=config.log.gif)
    announce_certificate(folder, config.env)
    seconds.spent("build")
    if not resumed_at:
        evaluate()  # the untrained policy
    seconds.spent("evaluate")

    # ---- train: noise, then filter, then execution (explore_policy); the buffer holds executed and nominal actions
    losses: dict[str, torch.Tensor] = {}
    total = config.collector.total_frames
    interval = 1.0 if sys.stderr.isatty() else 30.0  # a line now and then in a log file
    bar = tqdm(total=total, initial=resumed_at, unit="frame", unit_scale=True, mininterval=interval)
    with StopSignals() as stop:
        per_batch = config.collector.frames_per_batch
        for batch in collect(env, explore_policy, per_batch, total - resumed_at, resumed=resumed_at > 0):
            recorder.update(batch)
            check(batch)
            check_batch(batch, recorder.frames)
            transitions = to_transitions(batch, config.train.violation_penalty, adversary)
            if len(steps := multi_step(transitions)):
                buffer.extend(steps)
            seconds.spent("collect")
            if recorder.frames >= learn_from and len(buffer):
                for _ in range(config.train.n_updates):
                    losses = update_step(buffer.sample(), loss_module, optimizers, target_updater, config.agent)
            seconds.spent("update")
            if clocks["log"](recorder.frames):
                scalars = recorder.scalars() | {"train/noise": explore_policy[1].sigma}
                scalars["train/reward"] = float(transitions["next"][keys.REWARD].mean())  # the objective's
                numbers = {name: float(value) for name, value in losses.items()}
                check_finite(numbers, recorder.frames)
                scalars |= {f"loss/{name}": value for name, value in numbers.items()}
                board.scalars(scalars | seconds.scalars(recorder.frames), recorder.frames)
                if config.log.histograms:
                    board.histogram("train/energy", batch["next"][keys.ENERGY], recorder.frames)
                bar.set_postfix_str(recorder.progress(scalars), refresh=False)
            bar.update(batch.numel())
            ends = recorder.frames == total
            if clocks["evaluate"](recorder.frames) | ends:
                evaluate()
            seconds.spent("evaluate")
            save = clocks["save_frames"](recorder.frames) | clocks["save_episodes"](recorder.episodes.episodes)
            if save or ends or stop.received:
                check_weights(loss_module, recorder.frames)
                board.flush()  # what it has logged is on disk before the checkpoint that says so
                state.save(ended=ends)
            seconds.spent("checkpoint")
            stop.check(f"at {recorder.frames} frames, checkpoint written in {folder}")
    bar.close()

    # ---- conclude
    curves = {name: np.array(values) for name, values in recorder.episodes.finished.items()}
    save_training_curve(curves, folder / "figures" / "training.png")
    wall_time = seconds.total()
    speed = {"wall_time_s": wall_time, "frames_per_second": recorder.frames / wall_time, "time": seconds.totals}
    kept = {"checkpoint": {"buffer": with_buffer}}
    metrics = {"eval": recorder.evaluation}
    state.finish()
    write_json(folder / "summary.json", origin | recorder.summary() | speed | kept | metrics)
    board.close()
    tqdm.write(f"{folder}/summary.json\n{json.dumps(recorder.evaluation, indent=2)}")
    return objective(folder)


if __name__ == "__main__":
    main()
