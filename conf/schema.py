"""Registration of the typed configurations with Hydra, and the checks that need what Hydra composed."""

import re
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from agents import make_controller
from agents.checkpoint import check_world, find_checkpoint, load_checkpoint, observed_difference, world_sizes
from agents.ray_cluster import reach_ray
from agents.training_config import Config, WorkersConfig
from agents.training_state import MAY_DIFFER, check_frames, check_origin, named_checkpoint
from conf.evaluate_schema import EvaluateConfig
from conf.launching import register_resolvers
from conf.manual import check_names, groups, manual
from conf.naming import GROUPS, config_hash, evaluation_folder, hashed_config, program_name
from conf.report_schema import ReportConfig
from envs import SurveillanceConfig, SurveillanceEnv
from safety import SafetyConfig


def register() -> None:
    """Tell Hydra the schemas and the resolvers that name the run folders."""
    store = ConfigStore.instance()
    store.store(name="train_schema", node=Config)
    store.store(name="evaluate_schema", node=EvaluateConfig)
    store.store(name="report_schema", node=ReportConfig)
    OmegaConf.register_new_resolver("config_hash", lambda *, _root_: config_hash(_root_), replace=True)
    register_resolvers()
    OmegaConf.register_new_resolver("program_name", lambda *, _root_: program_name(_root_), replace=True)
    schemas = {"train": Config, "evaluate": EvaluateConfig, "report": ReportConfig}
    OmegaConf.register_new_resolver("manual", lambda program: manual(schemas[program]), replace=True)
    OmegaConf.register_new_resolver("groups", lambda *names: groups(*names), replace=True)
    OmegaConf.register_new_resolver("evaluation_folder", lambda *, _root_: evaluation_folder(_root_), replace=True)


def to_config(cfg: DictConfig) -> Any:
    """The validated dataclass of a composed configuration.

    Raises:
        ValueError: naming the value, what is allowed and the remedy.
    """
    _check_groups(cfg)
    own = cfg.copy()
    with open_dict(own):
        own.pop("hydra", None)
    check_names(own)
    if "run" in own and own.run is not None:  # world and filter are the run's: run_config applies the overrides to them
        own.env, own.safety = OmegaConf.structured(SurveillanceConfig), OmegaConf.structured(SafetyConfig)
    return OmegaConf.to_object(own)


def _check_groups(cfg: DictConfig) -> None:
    """Refuse a deleted group (~agent): without its file every option of it would silently be the schema's default."""
    hydra = cfg.get("hydra") or (HydraConfig.get() if HydraConfig.initialized() else None)
    for override in hydra.overrides.task if hydra is not None else ():
        group = re.split("[=@]", str(override))[0]
        if group.startswith("~") and group[1:] in GROUPS:
            raise ValueError(f"{override}: groups cannot be deleted; choose a file of it with {group[1:]}=<name>.")


def run_config(cfg: DictConfig, overrides: list[str]) -> Config:
    """Configuration of the run ``cfg.run`` with the command line's env and safety overrides applied to it."""
    given = OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.load(Path(cfg.run) / ".hydra" / "config.yaml"))
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if key.split(".")[0] in ("env", "safety"):
            OmegaConf.update(given, key, OmegaConf.select(cfg, key), merge=False)
    given.device = cfg.device  # the run may have been trained elsewhere
    given.fixed_sizes = given.cuda_graphs = False  # evaluations have their own
    given.workers = OmegaConf.structured(WorkersConfig)
    return to_config(given)


def check_training(cfg: DictConfig) -> None:
    """Raise what is wrong with a training run before anything is written: values, and the checkpoint that resume names."""
    config: Config = to_config(cfg)
    if config.workers.count and config.workers.ray_address is not None:
        reach_ray(config.workers.ray_address, "workers.ray_address")
    if config.resume not in ("auto", "never"):
        path, content = named_checkpoint(Path(config.resume), lambda line: None, rows=config.checkpoint.buffer)
        own = path.parent.parent.resolve() == Path(str(cfg.hydra.run.dir)).resolve()
        here = {"config": hashed_config(cfg), "seed": config.seed}
        check_origin(path, content, here, may_differ=() if own else MAY_DIFFER)
        check_frames(config.resume, content["frames"], config.collector.total_frames)


def check_evaluation(cfg: DictConfig) -> None:
    """Raise what is wrong with an evaluation before anything is written: values, run folder, checkpoint, its world."""
    config = to_config(cfg)
    source = config if config.run is None else run_config(cfg, list(cfg.hydra.overrides.task))
    source.safety.check_sizes(fixed_sizes=config.computing["fixed_sizes"])
    if config.adversary is not None:
        trained = OmegaConf.load(Path(config.adversary) / ".hydra" / "config.yaml")
        objective = OmegaConf.select(trained, "train.objective")
        if objective != "adversary":
            raise ValueError(
                f"adversary={config.adversary} is a run with train.objective={objective or 'coverage'}, not an adversary's: "
                "evaluate it with run=<folder>, or train one with python train.py experiment=adversary."
            )
    if config.controller == "learned":
        make_controller("learned", config.env, adversary=config.adversary)  # its checkpoint and the world's sizes
    if config.run is not None:
        path = find_checkpoint(Path(config.run), config.checkpoint)
        here = SurveillanceEnv(source.env)

        def observed() -> str:
            return observed_difference(SurveillanceEnv(run_config(cfg, []).env), here)

        check_world(path, load_checkpoint(path)["world"], world_sizes(here), observed=observed)
