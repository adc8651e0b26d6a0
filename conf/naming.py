"""Names of run folders: a digest of what decides a run's result, and where evaluations go."""

import hashlib
import json
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from agents.evaluation import rollout_steps
from agents.training_config import NOT_HASHED, seeds_of

COMPUTED = ("fixed_sizes", "cuda_graphs")
"""How a run computes, where not as by default."""
GROUPS = ("method", "env", "safety", "agent", "train", "experiment")


def config_hash(cfg: DictConfig) -> str:
    """First 8 hex digits of a digest of the resolved configuration without :data:`agents.training_config.NOT_HASHED`."""
    return hashlib.sha256(json.dumps(hashed_config(cfg), sort_keys=True).encode()).hexdigest()[:8]


def hashed_config(cfg: DictConfig) -> dict:
    """The resolved configuration without ``NOT_HASHED``, nested; workers, fixed sizes and graphs only where there are some."""
    found = {name: _plain(cfg, name) for name in sorted(str(name) for name in cfg) if name not in NOT_HASHED}
    workers = found.pop("workers", {"count": 0})  # where and on what they run changes nothing
    kept = {"workers": {name: workers[name] for name in ("count", "overlap")}} if workers["count"] else {}
    graphs = bool(found.get("cuda_graphs"))  # which come with fixed sizes
    fixed = {name: True for name in COMPUTED if found.pop(name, False) or graphs}
    return found | kept | fixed


def run_name(cfg: DictConfig, seed: int) -> str:
    """Name of the folder of a seed's run."""
    return f"{config_hash(cfg)}_seed{seed}"


def program_name(cfg: DictConfig) -> str:
    """Name of Hydra's folder: the run's, or where several seeds are trained at once one of their own beside the runs'."""
    seeds = seeds_of(cfg)
    if len(seeds) == 1:
        return run_name(cfg, seeds[0])
    if seeds == list(range(seeds[0], seeds[0] + len(seeds))):
        label = f"{seeds[0]}-{seeds[-1]}"
    else:
        label = "_".join(map(str, seeds))
        label = label if len(label) < 40 else f"{len(seeds)}_{hashlib.sha256(label.encode()).hexdigest()[:8]}"
    return f"{config_hash(cfg)}_seeds{label}"


def _plain(cfg: DictConfig, name: str) -> Any:
    value = cfg[name]
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def evaluation_folder(cfg: DictConfig) -> str:
    """Where evaluate.py writes: ``<run>/eval/<world>_<steps>_<seed>``, or a folder under runs/ for controllers.

    Overrides of the run's own world, filter or checkpoint add a hash, so that nothing is overwritten, and a filter that is
    chosen its name. Folders from before it did are gone on with.
    """
    choices, overrides = cfg.hydra.runtime.choices, [str(entry) for entry in cfg.hydra.overrides.task]
    world, horizon = choices.env, cfg.env.horizon
    if cfg.run is not None and not any(entry.startswith("env=") for entry in overrides):
        hydra_folder = Path(cfg.run) / ".hydra"
        world = OmegaConf.load(hydra_folder / "hydra.yaml").hydra.runtime.choices.env
        if not any(entry.startswith("env.horizon=") for entry in overrides):
            horizon = OmegaConf.load(hydra_folder / "config.yaml").env.horizon
    size = f"{cfg.steps or rollout_steps(horizon)}_{cfg.seed}"
    name = f"{world}_{size}"
    names = ("env", "safety", "checkpoint", *(name for name in COMPUTED if cfg[name]))
    changes = [entry for entry in overrides if entry.split(".")[0].split("=")[0] in names]
    if cfg.run is not None:
        suffix = "_" + hashlib.sha256("\n".join(sorted(changes)).encode()).hexdigest()[:8] if changes else ""
        folder = Path(cfg.run).absolute() / "eval"
        chosen = any(entry.startswith("safety=") for entry in changes) and not (folder / f"{name}{suffix}").is_dir()
        return str(folder / (f"{world}_{choices.safety}_{size}{suffix}" if chosen else f"{name}{suffix}"))
    folder = f"{cfg.controller}_{choices.safety}_{name}_{config_hash(cfg)}"
    return str(Path(cfg.folder).absolute() / folder)
