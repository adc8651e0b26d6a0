"""Roll a trained policy or a controller out behind a filter, measure it and draw it.

``python evaluate.py run=<folder>`` writes ``<folder>/eval/<world>_<steps>_<seed>/``; ``python evaluate.py
controller=<name> env=… safety=…`` writes a folder under ``runs/controllers/``. Both hold eval.json, the pictures of the
paper's Figs 5-7, a GIF and the battery plot of the first world.
"""

import json
import logging
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tqdm import tqdm

from agents import make_controller
from agents.checkpoint import check_world, latest_checkpoint, load_checkpoint
from agents.evaluation import evaluate_policy
from agents.networks import make_actor
from agents.pipeline import pick_device
from conf.callbacks import one_clear_error
from conf.schema import Config, EvaluateConfig, register, to_config, write_json
from envs import SurveillanceConfig, SurveillanceEnv
from envs.rendering import save_battery_plot, save_gif, save_snapshots
from safety import SafetyConfig, SafetyFilter

register()
logging.getLogger("torchrl").setLevel(logging.WARNING)


def run_config(cfg: DictConfig, overrides: list[str]) -> Config:
    """Configuration of the run ``cfg.run`` with the command line's env and safety overrides applied to it."""
    given = OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.load(Path(cfg.run) / ".hydra" / "config.yaml"))
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if key.split(".")[0] in ("env", "safety"):
            OmegaConf.update(given, key, OmegaConf.select(cfg, key), merge=False)
    return to_config(given)


def load_actor(
    run: Path, config: Config, world: SurveillanceConfig, n_observation: int, device: torch.device
) -> TensorDictModuleBase:
    """Trained actor of a run's newest checkpoint, if it was made for this world."""
    path = latest_checkpoint(run)
    content = load_checkpoint(path, device)
    sizes = {"n_agents": world.n_agents, "dimension": world.dimension, "n_observation": n_observation}
    check_world(path, content["world"], sizes)
    actor = make_actor(n_observation, world, config.agent).to(device)
    actor.load_state_dict(content["actor"])
    return actor


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
@one_clear_error
def main(cfg: DictConfig) -> None:
    """One evaluation."""
    config: EvaluateConfig = to_config(cfg)
    device = pick_device(config.device)
    world: SurveillanceConfig = config.env
    safety: SafetyConfig = config.safety
    folder = Path(HydraConfig.get().runtime.output_dir)
    if config.run is not None:
        trained = run_config(cfg, list(HydraConfig.get().overrides.task))
        world, safety = trained.env, trained.safety
        env = SurveillanceEnv(world, config.num_envs, device, seed=config.seed)
        nominal = load_actor(Path(config.run), trained, world, env.n_observation, device)
    else:
        env = SurveillanceEnv(world, config.num_envs, device, seed=config.seed)
        nominal = make_controller(config.controller or "", world, seed=config.seed)
    policy = TensorDictSequential(nominal, SafetyFilter(safety, world))
    steps = config.steps or world.horizon or 1000
    metrics, statistics, trajectory = evaluate_policy(env, policy, steps, record=config.pictures)
    content = {**metrics, "filter": statistics, "steps": steps, "num_envs": config.num_envs, "seed": config.seed}
    write_json(folder / "eval.json", content)
    if trajectory is not None:
        save_snapshots(trajectory, folder)
        save_battery_plot(trajectory, folder / "battery.png")
        save_gif(trajectory, folder / "world.gif", max_frames=60)
    tqdm.write(f"{folder}/eval.json\n{json.dumps(content, indent=2)}")


if __name__ == "__main__":
    main()
