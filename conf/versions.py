"""Where a run came from: package versions and the commit."""

import functools
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

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
