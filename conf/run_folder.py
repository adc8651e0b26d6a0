"""What stands in the folder of a run or of an evaluation: whether it is finished, the certificate's quantities, JSON files."""

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict
from tqdm import tqdm

from agents.training_config import seeds_of
from conf.naming import config_hash, program_name, run_name
from conf.versions import git_hash
from envs import SurveillanceConfig
from envs.inequalities import derived_quantities

try:
    import fcntl
except ImportError:  # not POSIX: no locks
    fcntl = None


class BusyFolderError(ValueError):
    """A run's folder that another process is writing."""


def announce_certificate(folder: Path, world: SurveillanceConfig, *, show: bool = True) -> None:
    """Show the quantities that the certificate of ``world`` derives, once, and keep them in ``certificate.json``."""
    certificate = derived_quantities(world)
    write_json(folder / "certificate.json", certificate)
    if show:
        tqdm.write("certificate: " + ", ".join(f"{name} {value:.4g}" for name, value in certificate.items()))


def run_folders(cfg: DictConfig, seeds: list[int], output: Path) -> dict[int, Path]:
    """The folder of each seed's run: Hydra's run folder, or where there are several those beside it (inside a folder that the
    user named).
    """
    if len(seeds) == 1:
        return {seeds[0]: output}
    if output.name == program_name(cfg):
        return {seed: output.parent / run_name(cfg, seed) for seed in seeds}
    return {seed: output / f"seed{seed}" for seed in seeds}


def unfinished_seeds(cfg: DictConfig, seeds: list[int], output: Path, tell: Callable[[str], None]) -> dict[int, Path]:
    """Make the folders of the runs that are still to be trained, each with a ``.hydra`` as of a run of its own.

    Args:
        cfg: the composed configuration.
        seeds: all seeds.
        output: Hydra's run folder.
        tell: shows a line for each finished run.

    Returns:
        Folders by seed, without those of finished runs.
    """
    folders = {}
    for seed, folder in run_folders(cfg, seeds, output).items():
        message = finished_run(folder, cfg.resume)
        if folder == output or not message:  # Hydra has rewritten its own
            _write_hydra_files(cfg, seed, folder, output)
        if message:
            tell(message)
        else:
            folders[seed] = folder
    return folders


def _write_hydra_files(cfg: DictConfig, seed: int, folder: Path, output: Path) -> None:
    if cfg.seeds is None and cfg.n_seeds == 1:
        return
    own, source, target = cfg.copy(), output / ".hydra", folder / ".hydra"
    with open_dict(own):
        own.pop("hydra", None)
    own.seed, own.seeds, own.n_seeds = seed, None, 1
    hydra = OmegaConf.load(source / "hydra.yaml")
    task = [entry for entry in hydra.hydra.overrides.task if entry.split("=")[0] not in ("seed", "seeds", "n_seeds")]
    hydra.hydra.overrides.task = [*task, f"seed={seed}"]
    target.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(own, target / "config.yaml")
    OmegaConf.save(hydra, target / "hydra.yaml")
    OmegaConf.save(hydra.hydra.overrides.task, target / "overrides.yaml")


def finished_evaluation(path: Path, asked: dict) -> str | None:
    """What to tell the user if ``path`` is the complete ``eval.json`` of an evaluation of the same length, worlds, seed and
    policy; None otherwise.
    """
    if not path.is_file():
        return None
    content = json.loads(path.read_text())
    if any(content.get(name) != value for name, value in asked.items()):
        return None
    return f"{path} exists: nothing to do. {_other_code(content, 'was made')}resume=never evaluates anew."


def finished_program(cfg: DictConfig) -> str | None:
    """What to tell the user if all runs of a program of train.py are finished and to be left alone; None otherwise."""
    folders = run_folders(cfg, seeds_of(cfg), Path(str(cfg.hydra.run.dir)))
    messages = [finished_run(folder, cfg.resume) for folder in folders.values()]
    foreign = [
        foreign_run(folder, cfg, seed)
        for (seed, folder), message in zip(folders.items(), messages, strict=True)
        if message
    ]
    if any(foreign):
        raise ValueError(next(filter(None, foreign)))
    return "\n".join(filter(None, messages)) if all(messages) else None


def finished_run(folder: Path, resume: str | None) -> str | None:
    """What to tell the user if ``folder`` holds a finished run that is to be left alone; None otherwise."""
    if resume in (None, "never") or not (folder / "summary.json").is_file():
        return None
    if folder.resolve() in (Path(resume).resolve(), *Path(resume).resolve().parents):  # one of its own checkpoints
        return None
    code = _other_code(json.loads((folder / "summary.json").read_text()), "was trained")
    return f"{folder} holds a finished run: nothing to do. {code}resume=never trains it anew."


def _other_code(content: dict, what: str) -> str:
    """A sentence if results are of another commit than this one's; an empty string otherwise."""
    there, here = content.get("git_hash"), git_hash()
    return f"It {what} by the code of {there}, this is {here}. " if there not in (None, here) else ""


def foreign_run(folder: Path, cfg: DictConfig, seed: int) -> str | None:
    """What is wrong with ``folder`` if it holds a training run of another configuration than ``cfg``, or of another seed."""
    path = folder / ".hydra" / "config.yaml"
    if folder.name == run_name(cfg, seed) or not path.is_file():
        return None
    there, digest = OmegaConf.load(path), config_hash(cfg)
    if not isinstance(there, DictConfig) or (there.get("seed"), config_hash(there)) == (seed, digest):
        return None
    return (
        f"{folder} holds a run of another configuration (hash {config_hash(there)}, seed {there.get('seed')}; this one: "
        f"{digest}, seed {seed}): give this run another folder (hydra.run.dir, hydra.sweep.dir, hydra.sweep.subdir), "
        "or move that one away."
    )


def objective(folders: Iterable[Path]) -> float | None:
    """The coverage cost that finished runs were evaluated with, their mean, m²: what a sweep for tuning makes small.

    None where one of them has none.
    """
    try:
        summaries = [json.loads((folder / "summary.json").read_text(encoding="utf-8")) for folder in folders]
        return sum(float(summary["eval"]["coverage_cost"]) for summary in summaries) / len(summaries)
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError):
        return None


@contextlib.contextmanager
def only_writers(folders: Iterable[Path]) -> Iterator[None]:
    """:func:`only_writer` of several folders."""
    with contextlib.ExitStack() as stack:
        for folder in folders:
            stack.enter_context(only_writer(folder))
        yield


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
