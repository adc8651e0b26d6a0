"""What stands in the folder of a run or of an evaluation: whether it is finished, the certificate's quantities, JSON files."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from conf.naming import config_hash
from envs import SurveillanceConfig
from envs.inequalities import derived_quantities

try:
    import fcntl
except ImportError:  # not POSIX: no locks
    fcntl = None


class BusyFolderError(ValueError):
    """A run's folder that another process is writing."""


def announce_certificate(folder: Path, world: SurveillanceConfig) -> None:
    """Show the quantities that the certificate of ``world`` derives, once, and keep them in ``certificate.json``."""
    certificate = derived_quantities(world)
    write_json(folder / "certificate.json", certificate)
    tqdm.write("certificate: " + ", ".join(f"{name} {value:.4g}" for name, value in certificate.items()))


def finished_evaluation(path: Path, asked: dict) -> bool:
    """Whether ``path`` is the complete ``eval.json`` of an evaluation of the same length, worlds, seed and policy."""
    if not path.is_file():
        return False
    content = json.loads(path.read_text())
    return all(content.get(name) == value for name, value in asked.items())


def finished_run(folder: Path, resume: str | None) -> str | None:
    """What to tell the user if ``folder`` holds a finished run that is to be left alone; None otherwise."""
    if resume in (None, "never") or not (folder / "summary.json").is_file():
        return None
    if folder.resolve() in (Path(resume).resolve(), *Path(resume).resolve().parents):  # one of its own checkpoints
        return None
    return f"{folder} holds a finished run: nothing to do. resume=never trains it anew."


def foreign_run(folder: Path, config: DictConfig) -> str | None:
    """What is wrong with ``folder`` if it holds a training run of another configuration or seed than ``config``."""
    path = folder / ".hydra" / "config.yaml"
    digest = config_hash(config) if "collector" in config else ""
    if not digest or folder.name == f"{digest}_seed{config.seed}" or not path.is_file():
        return None
    there = OmegaConf.load(path)
    if not isinstance(there, DictConfig) or (there.get("seed"), config_hash(there)) == (config.seed, digest):
        return None
    return (
        f"{folder} holds a run of another configuration (hash {config_hash(there)}, seed {there.get('seed')}; this one: "
        f"{digest}, seed {config.seed}): give this run another folder (hydra.run.dir, hydra.sweep.dir, hydra.sweep.subdir), "
        "or move that one away."
    )


def objective(folder: Path) -> float | None:
    """The coverage cost that a finished run was evaluated with, m²: what a sweep for tuning makes small. None without one."""
    try:
        return float(json.loads((folder / "summary.json").read_text(encoding="utf-8"))["eval"]["coverage_cost"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Context in which no other process runs in ``folder``.

    Raises:
        BusyFolderError: one does already.
    """
    if fcntl is None or not (folder / ".hydra").is_dir():  # report.py has no folder of its own
        yield
        return
    with (folder / ".hydra" / "lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyFolderError(f"{folder} is being written by another process: wait for it, or stop it.") from error
        except OSError:  # a file system without locks
            pass
        yield


def write_json(path: Path, content: dict) -> None:
    """Write ``content`` indented, complete or not at all; a NaN or infinity raises ``ValueError``."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    temporary.replace(path)
