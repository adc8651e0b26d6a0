"""Roll a trained policy or a controller out behind a filter, measure it and draw it.

``python evaluate.py run=<folder>`` writes ``<folder>/eval/<world>_<steps>_<seed>/``, with a hash of overrides in the name where
there are some; ``python evaluate.py controller=<name> env=… safety=…`` writes a folder under ``runs/controllers/``. Both hold
eval.json, the pictures of the paper's Figs 5-7, the paths, the battery plot and a video (GIF, MP4) of the first world.
"""

import functools
import json
import logging
import time
from dataclasses import asdict
from pathlib import Path

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential
from tqdm import tqdm

from agents import make_controller
from agents.checkpoint import find_checkpoint, load_checkpoint
from agents.evaluation import evaluate_policy, rollout_steps
from agents.incident import check_violations
from agents.networks import make_actor
from agents.pipeline import pick_device, use_threads
from conf.callbacks import one_clear_error
from conf.command_line import clear_errors
from conf.evaluate_schema import EvaluateConfig
from conf.naming import COMPUTED
from conf.run_folder import announce_certificate, finished_evaluation, write_json
from conf.schema import Config, register, run_config, to_config
from conf.versions import git_hash
from envs import SurveillanceConfig, SurveillanceEnv
from envs.path_plot import save_path_plot
from envs.rendering import Trajectory, save_battery_plot, save_snapshots
from envs.video import save_gif, save_mp4
from safety import SafetyConfig, SafetyFilter

register()
for library in ("torchrl", "fontTools"):  # the latter tells of every glyph table that format=pdf leaves out
    logging.getLogger(library).setLevel(logging.WARNING)


@clear_errors(EvaluateConfig)
@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
@one_clear_error
def main(cfg: DictConfig) -> None:
    """One evaluation."""
    config: EvaluateConfig = to_config(cfg)
    device = pick_device(config.device)
    use_threads(config.threads)
    folder = Path(HydraConfig.get().runtime.output_dir)
    env_seed, controller_seed = np.random.SeedSequence(config.seed).generate_state(2).tolist()
    source = config if config.run is None else run_config(cfg, list(HydraConfig.get().overrides.task))
    world: SurveillanceConfig = source.env
    safety: SafetyConfig = source.safety
    sizes = {name: config.computing[name] for name in COMPUTED}
    env = SurveillanceEnv(world, config.num_envs, device, env_seed, **config.computing)
    if isinstance(source, Config):
        checkpoint = find_checkpoint(Path(config.run or ""), config.checkpoint)
        nominal = make_actor(env.n_observation, world, source.agent).to(device)
        trained = load_checkpoint(checkpoint, device)
        nominal.load_state_dict(trained["actor"])
        name, frames = str(checkpoint), trained.get("frames")
    else:
        name, frames = config.controller or "", None
        nominal = make_controller(name, world, seed=controller_seed, adversary=config.adversary)
    safety_filter = SafetyFilter(safety, world, compile=config.compile, **sizes)
    policy = TensorDictSequential(nominal, safety_filter)
    steps = config.steps or rollout_steps(world.horizon)
    asked = {
        "steps": steps,
        "num_envs": config.num_envs,
        "restart": config.restart,
        "seed": config.seed,
        "policy": name,
        "policy_frames": frames,
    }
    if config.resume == "auto" and (message := finished_evaluation(folder / "eval.json", asked)):
        tqdm.write(message)
        return
    for old in ("eval.json", "violation.json"):
        (folder / old).unlink(missing_ok=True)
    announce_certificate(folder, world)
    check = functools.partial(check_violations, world=world, safety=safety, folder=folder)
    start = time.perf_counter()
    options = {"record": config.pictures, "samples": config.samples, "restart": config.restart, "check": check}
    metrics, statistics, trajectory = evaluate_policy(env, policy, steps, cuda_graphs=config.cuda_graphs, **options)
    content = {
        **metrics,
        "filter": statistics,
        "task": {} if isinstance(source, Config) else nominal.metrics(),
        "wall_time_s": time.perf_counter() - start,
        **asked,
        "adversary": config.adversary,
        **sizes,
        "git_hash": git_hash(),
        "env": asdict(world),
        "safety": asdict(safety),
    }
    write_json(folder / "eval.json", content)
    if trajectory is not None:
        save_pictures(trajectory, folder, config)
    tqdm.write(f"{folder}/eval.json\n{json.dumps(metrics | {'filter': statistics}, indent=2)}")


def save_pictures(trajectory: Trajectory, folder: Path, config: EvaluateConfig) -> None:
    """Figures and videos of one world."""
    suffix = config.format
    save_snapshots(trajectory, folder, suffix=suffix)
    save_battery_plot(trajectory, folder / f"battery.{suffix}")
    save_path_plot(trajectory, folder / f"paths.{suffix}")
    if config.video in ("gif", "both"):
        save_gif(trajectory, folder / "world.gif", max_frames=60)
    if config.video in ("mp4", "both"):
        save_mp4(trajectory, folder / "world.mp4")


if __name__ == "__main__":
    main()
