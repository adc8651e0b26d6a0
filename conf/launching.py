"""What the launchers of a sweep need to know of the machine, and their failures in one line.

``hydra/launcher=local`` (joblib), ``slurm`` (submitit) and ``ray_local`` (Ray) are Hydra's plugins with the settings of
conf/hydra/launcher; conf/sweep.py starts them.
"""

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from agents.ray_cluster import reach_ray

PLUGINS = {
    "hydra/launcher/joblib": ("hydra-joblib-launcher", "pip install -c constraints.txt hydra-joblib-launcher"),
    "hydra/launcher/submitit_slurm": ("hydra-submitit-launcher", "pip install -c constraints.txt -e '.[slurm]'"),
    "hydra/launcher/submitit_local": ("hydra-submitit-launcher", "pip install -c constraints.txt -e '.[slurm]'"),
    "hydra/launcher/ray": ("hydra-ray-launcher", "pip install -c constraints-extras.txt -e '.[ray]'"),
    "hydra/sweeper/optuna": ("hydra-optuna-sweeper", "pip install -c constraints-extras.txt -e '.[optuna]'"),
}
"""Options that come with a package: its name, and how to install it."""
OURS = {"joblib": "local", "submitit_slurm": "slurm", "ray": "ray_local"}


class SweepError(HydraException):
    """A sweep that cannot be started; the message says why and what to do."""


def beside_others(config: DictConfig) -> bool:
    """Whether a job is one of a sweep whose launcher runs jobs in other processes.

    By the launcher's name: Hydra loads its plugins' modules anew, and with them their classes.
    """
    basic = str(config.hydra.launcher._target_).endswith(".BasicLauncher")
    return config.hydra.mode == RunMode.MULTIRUN and not basic


def cores() -> int:
    """CPU cores that this process may use: affinity and the container's quota count."""
    try:
        import joblib

        return joblib.cpu_count()
    except ImportError:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cores_of_run(threads: int, workers: int = 0) -> int:
    """CPU cores that a run with so many threads (0: all cores) and workers uses."""
    return (int(threads) or cores()) * (1 + int(workers))


def register_resolvers() -> None:
    """``${cores_of_run:<threads>,<workers>}``, and ``${runs_at_once:<threads>,<workers>}`` of them on this machine.

    ``${cores_of_cluster:<address>}``: cores of a Ray cluster that is started here; null for one that runs already.
    """
    OmegaConf.register_new_resolver("cores_of_run", cores_of_run, replace=True)
    OmegaConf.register_new_resolver(
        "runs_at_once", lambda threads, workers=0: max(1, cores() // cores_of_run(threads, workers)), replace=True
    )
    OmegaConf.register_new_resolver(
        "cores_of_cluster", lambda address: cores() if address in (None, "local") else None, replace=True
    )


def missing_plugin(option: str) -> str | None:
    """What to install, if ``option`` (such as ``hydra/launcher/joblib``) comes with a package."""
    if option not in PLUGINS:
        return None
    package, command = PLUGINS[option]
    group, _, name = option.rpartition("/")
    return f"{group}={OURS.get(name, name)} needs the package {package}, which is not installed: {command}"


def check_launcher(name: str, launcher: DictConfig) -> None:
    """Refuse a launcher that cannot work here.

    Args:
        name: the option of hydra/launcher that was chosen, for the message.
        launcher: its settings.

    Raises:
        SweepError: no Slurm on this machine, or a Ray cluster that does not answer.
    """
    target = str(launcher._target_)
    if target.endswith("SlurmLauncher"):
        lacking = [program for program in ("sbatch", "srun") if shutil.which(program) is None]
        if lacking:
            raise SweepError(
                f"hydra/launcher={name}: no {' and no '.join(lacking)} on this machine, which is no login node of a Slurm "
                "cluster. Start the sweep on one, or take hydra/launcher=local. Nothing was started."
            )
    if target.endswith("RayLauncher"):
        try:
            reach_ray(str(OmegaConf.select(launcher, "ray.init.address") or "local"), "hydra.launcher.ray.init.address")
        except ConnectionError as error:
            raise SweepError(f"hydra/launcher={name}: {error}") from error


@contextlib.contextmanager
def patient(launcher: Any) -> Iterator[None]:
    """Context in which a run whose process dies becomes a failed run.

    submitit and Ray raise the error of the first such run, though the others are still at work. (joblib loses its
    other processes too: :func:`is_broken_pool`.)
    """
    target = type(launcher).__module__
    if "submitit" in target:
        from submitit.core.core import Job
        from submitit.core.utils import FailedJobError, UncompletedJobError

        errors, holder, name = (FailedJobError, UncompletedJobError), Job, "results"
        results = Job.results

        def wait_for_job(job: Any) -> Any:
            return _or_failed(lambda: results(job), errors, wrap=lambda failed: [failed])

        wait = wait_for_job
    elif "ray_launcher" in target:
        import ray  # pyright: ignore[reportMissingImports]
        from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

        holder, name = ray, "get"
        get = ray.get

        def wait_for_task(reference: Any, **options: Any) -> Any:
            return _or_failed(lambda: get(reference, **options), (RayError,), wrap=lambda failed: failed)

        wait = wait_for_task
    else:
        yield
        return
    with replaced(holder, name, wait):
        yield


@contextlib.contextmanager
def replaced(holder: Any, name: str, value: Any) -> Iterator[None]:
    """Context in which an attribute of a library has another value."""
    before = getattr(holder, name)
    setattr(holder, name, value)
    try:
        yield
    finally:
        setattr(holder, name, before)


def _or_failed(result: Callable[[], Any], errors: tuple, wrap: Callable[[JobReturn], Any]) -> Any:
    try:
        return result()
    except errors as error:
        return wrap(JobReturn(status=JobStatus.FAILED, _return_value=error))


def is_broken_pool(error: BaseException) -> bool:
    """Whether joblib gave up because one of its processes died."""
    return any(base.__name__ == "BrokenProcessPool" for base in type(error).__mro__)
