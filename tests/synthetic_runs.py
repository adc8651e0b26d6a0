"""Folders of runs with known numbers, as train.py and evaluate.py write them, for the tests of report.py."""

import csv
import json
import time

from omegaconf import OmegaConf
from torch.utils.tensorboard import SummaryWriter

from conf.naming import config_hash

KINDS = ("depleted", "stranded", "overcharged", "collision")
FILTER = {"intervention_rate": 0.5, "fallback_rate": 0.03, "homing_rate": 0.01, "infeasible": 2, "outside": 1}
METRICS = {"episode_reward": -20.0, "charges_per_robot": 1.5, "robot_steps": 60}


def write_run(
    sweep,
    seed,
    cost,
    *overrides,
    world="default",
    method=None,
    controller=None,
    experiment="default",
    name=None,
    **changes,
):
    """A run's folder with known numbers; ``cost=None`` leaves it unfinished."""
    overrides = [f"seed={seed}", *overrides]
    folder = sweep / (name or f"{world}_{method or controller or '_'.join(overrides[1:])}_{seed}")
    (folder / ".hydra").mkdir(parents=True)
    choices = {"env": world, "safety": "certified"} | ({"method": method} if method else {})
    config = {"seed": seed, "env": {"n_agents": 3, "horizon": 20, "on_violation": "terminate"} | changes.get("env", {})}
    if controller:
        config |= {"run": None, "controller": controller, "steps": changes.get("steps", 20), "restart": False}
    else:
        config |= {"collector": {"total_frames": 100}, "eval": {"steps": changes.get("steps", 0)}}
        choices["experiment"] = experiment
    config["chosen"] = changes.get(
        "chosen", [world, method, experiment, *overrides[1:]]
    )  # in place of what it would compose
    OmegaConf.save(config, folder / ".hydra" / "config.yaml")
    hydra = {"hydra": {"runtime": {"choices": choices}, "overrides": {"task": overrides}}}
    OmegaConf.save(hydra, folder / ".hydra" / "hydra.yaml")
    if cost is None:
        return folder
    git_hash = changes.get("git_hash", "abc")
    violations = changes.get("violations", {})
    test = METRICS | {"coverage_cost": cost, "violations": dict.fromkeys(KINDS, 0) | violations}
    if controller:
        origin = {"git_hash": git_hash, "wall_time_s": 1.0, "steps": 20, "policy": controller, "env": config["env"]}
        (folder / "eval.json").write_text(json.dumps(test | {"filter": FILTER, "task": {"waypoints": 7}} | origin))
        return folder
    content = {
        "config_hash": changes.get("config_hash", config_hash(OmegaConf.create(config))),
        "git_hash": git_hash,
        "seed": seed,
        "eval": test,
    }
    content |= {"frames": changes.get("frames", 100), "episodes": 5, "wall_time_s": 9.0, "frames_per_second": 11.0}
    content |= {"train": {"violations": dict.fromkeys(KINDS, seed)}, "filter": FILTER}
    content |= {"n_seeds": changes["n_seeds"]} if "n_seeds" in changes else {}
    (folder / "summary.json").write_text(json.dumps(content))
    if changes.get("events", True):
        writer, start = SummaryWriter(str(folder)), time.time()
        for k in range(4):
            point = {"global_step": 32 * k, "walltime": start + 10 * k}
            writer.add_scalar("eval/coverage_cost", cost + 3 - k, **point)
            for tag, value in FILTER.items():
                writer.add_scalar(f"filter/{tag}", value + 0.01 * seed, **point)
        writer.close()
    return folder


def read(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
