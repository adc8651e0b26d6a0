"""Where a run came from: configuration, package versions, commit, device."""

import functools
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from omegaconf import DictConfig

from conf.naming import config_hash

PACKAGES = ("torch", "torchrl", "tensordict", "qpth", "numpy", "hydra-core", "omegaconf")


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide a run's result."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "unknown"
    return versions


@functools.cache  # a program that runs several jobs keeps the code it started with
def git_hash() -> str:
    """Commit of the source tree, with ``-dirty`` if it has changes; ``unknown`` outside a repository."""
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return run.stdout.strip()


def run_origin(cfg: DictConfig, device: torch.device) -> dict:
    """What summary.json and the checkpoints say of where a run came from."""
    return {
        "config_hash": config_hash(cfg),
        "git_hash": git_hash(),
        "versions": package_versions(),
        "seed": cfg.seed,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "threads": torch.get_num_threads(),
    }
