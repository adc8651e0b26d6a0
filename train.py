"""Train MADDPG behind the safety filter: build, collect, update, evaluate, log, checkpoint.

``python train.py --help`` explains the command line; README.md the run folder and the TensorBoard tags.
"""

import json
import logging
import time
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from agents.checkpoint import save_checkpoint
from agents.evaluation import evaluate_policy
from agents.maddpg import make_loss, make_optimizers, update_step
from agents.networks import make_actor, make_critic, make_policies
from agents.pipeline import make_buffer, make_collector, pick_device, to_transitions
from agents.recorder import TrainingRecorder
from conf.callbacks import one_clear_error
from conf.schema import Config, config_hash, register, rollout_steps, to_config, world_sizes, write_json
from conf.versions import git_hash, package_versions
from envs import SurveillanceEnv
from envs.rendering import save_training_curve

register()
logging.getLogger("torchrl").setLevel(logging.WARNING)


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
@one_clear_error
def main(cfg: DictConfig) -> None:
    """One run: its folder is Hydra's run folder."""
    config: Config = to_config(cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    if config.resume == "auto" and (folder / "summary.json").is_file():
        tqdm.write(f"{folder} holds a finished run (summary.json): nothing to do. resume=never trains it anew.")
        return
    start, device = time.perf_counter(), pick_device(config.device)
    torch.manual_seed(config.seed)  # network weights; every other random stream has a generator of its own
    seeds = np.random.SeedSequence(config.seed).generate_state(4).tolist()

    env = SurveillanceEnv(config.env, config.collector.num_envs, device, seed=seeds[0])
    eval_env = SurveillanceEnv(config.env, config.eval.num_envs, device)
    actor = make_actor(env.n_observation, config.env, config.agent).to(device)
    critic = make_critic(env.n_observation, config.env, config.agent).to(device)
    policy, explore_policy = make_policies(actor, config.env, config.safety, config.agent, seeds[1], device)
    loss_module, target_updater = make_loss(actor, critic, config.agent, config.safety, config.env)
    optimizers = make_optimizers(loss_module, config.agent)
    per_update = config.env.n_agents if config.agent.minibatch == "per_agent" else 1
    buffer = make_buffer(config.buffer.capacity, config.buffer.batch_size * per_update, device, seeds[2])
    collector = make_collector(env, explore_policy, config.collector.frames_per_batch, config.collector.total_frames)
    recorder = TrainingRecorder(config.env, config.collector.num_envs, device)
    writer = SummaryWriter(str(folder))
    bar = tqdm(total=config.collector.total_frames, unit="frame", unit_scale=True, mininterval=1.0)

    def evaluate() -> tuple[dict, dict]:
        eval_env.set_seed(seeds[3])  # the same start states every time
        steps = config.eval.steps or rollout_steps(config.env.horizon)
        metrics, statistics, _ = evaluate_policy(eval_env, policy, steps)
        return metrics, statistics

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
        for old in (
            sorted((folder / "checkpoints").glob("*.pt"))[: -config.checkpoint.keep or None]
            if config.checkpoint.keep
            else []
        ):
            old.unlink()

    def log(scalars: dict[str, float]) -> None:
        for tag, value in scalars.items():
            writer.add_scalar(tag, value, recorder.frames)

    log_interval = max(1, config.collector.total_frames // 200)
    next_log, next_eval, next_checkpoint = (
        log_interval,
        config.eval.interval_frames,
        config.checkpoint.interval_episodes,
    )
    seconds = {"collect": 0.0, "update": 0.0, "eval": 0.0}
    metrics = None
    mark = time.perf_counter()
    for batch in collector:
        recorder.update(batch)
        buffer.extend(to_transitions(batch, config.train.violation_penalty))
        seconds["collect"] += time.perf_counter() - mark
        mark = time.perf_counter()
        if recorder.frames >= config.train.warmup_frames:
            for _ in range(config.train.n_updates):
                metrics = update_step(buffer.sample(), loss_module, optimizers, target_updater, config.agent)
        seconds["update"] += time.perf_counter() - mark
        mark = time.perf_counter()
        if recorder.frames >= next_log:
            next_log += log_interval
            scalars = recorder.scalars()
            log(
                scalars
                | ({f"loss/{name}": float(value) for name, value in metrics.items()} if metrics is not None else {})
            )
            log({f"time/{name}_s": value for name, value in seconds.items()} | {"train/noise": explore_policy[1].sigma})
            log({"time/frames_per_second": recorder.frames / (time.perf_counter() - start)})
            shown = f"return {scalars.get('train/return', float('nan')):.1f} J {scalars['train/coverage_cost']:.3f}"
            bar.set_postfix_str(f"{shown} violations {sum(recorder.violations.values())}")
        bar.update(batch.numel())
        if config.eval.interval_frames and recorder.frames >= next_eval:
            next_eval += config.eval.interval_frames
            result, _ = evaluate()
            flat = {name: value for name, value in result.items() if isinstance(value, int | float)}
            flat |= {f"violations_{kind}": count for kind, count in result["violations"].items()}
            log({f"eval/{name}": value for name, value in flat.items()})
        if config.checkpoint.interval_episodes and recorder.episodes.episodes >= next_checkpoint:
            next_checkpoint = recorder.episodes.episodes + config.checkpoint.interval_episodes
            checkpoint()
        seconds["eval"] += time.perf_counter() - mark
        mark = time.perf_counter()
    collector.shutdown()
    bar.close()

    checkpoint()
    result, _ = evaluate()
    save_training_curve(
        {name: np.array(rows) for name, rows in recorder.episodes.finished.items()}, folder / "figures/training.png"
    )
    wall = time.perf_counter() - start
    summary = {
        "config_hash": config_hash(cfg),
        "git_hash": git_hash(),
        "versions": package_versions(),
        "seed": config.seed,
        "frames": recorder.frames,
        "episodes": recorder.episodes.episodes,
        "wall_time_s": wall,
        "frames_per_second": recorder.frames / wall,
        "time": seconds,
        "train": {"violations": recorder.violations},
        "filter": recorder.filter.summary(),
        "eval": result,
    }
    write_json(folder / "summary.json", summary)
    writer.close()
    tqdm.write(f"{folder}/summary.json\n{json.dumps(summary['eval'], indent=2)}")


if __name__ == "__main__":
    main()
