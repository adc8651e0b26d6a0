"""Checkpoints: written atomically, read with ``weights_only``, refused with a reason when they do not fit."""

import os
from pathlib import Path

import torch

from envs import SurveillanceEnv

FORMAT = 1
WORLD_REMEDY = "Use the world that the run was trained in (leave env out), or train in this one."


class CheckpointError(ValueError):
    """A checkpoint that is missing, unreadable or of another world; the message says which and what to do."""


def save_checkpoint(path: Path, content: dict) -> Path:
    """Write ``content`` (tensors, numbers, strings, lists, dicts) so that ``path`` is complete or absent.

    Args:
        path: file to write.
        content: what to keep; ``format`` is added.

    Returns:
        The path.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    try:
        with temporary.open("wb") as file:
            torch.save({"format": FORMAT, **content}, file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)  # left over only if writing failed
    return path


def set_aside(folder: Path) -> Path | None:
    """Move what an earlier run wrote into ``folder`` to ``replaced_<k>`` inside it, so that nothing is mixed or lost.

    Returns:
        The folder moved to; None if there was nothing.
    """
    patterns = (
        "checkpoints",
        "figures",
        "eval",
        "summary.json",
        "certificate.json",
        "violation.json",
        "events.out.tfevents.*",
    )
    found = [path for pattern in patterns for path in folder.glob(pattern)]
    if not found:
        return None
    target = folder / f"replaced_{1 + len(list(folder.glob('replaced_*')))}"
    target.mkdir()
    for path in found:
        path.rename(target / path.name)
    return target


def keep_newest(folder: Path, keep: int) -> None:
    """Delete all but the ``keep`` newest checkpoints of ``folder``; 0 keeps all."""
    if keep:
        for old in sorted(folder.glob("*.pt"))[:-keep]:
            old.unlink()


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict:
    """Read a checkpoint.

    Raises:
        CheckpointError: if the file is missing, truncated, foreign or of another format.
    """
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist: give the folder of a run that has written one.")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged files
        raise CheckpointError(
            f"checkpoint {path} cannot be read ({type(error).__name__}): it is damaged or not a checkpoint of this project. "
            "Use another file of its folder."
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else None
        raise CheckpointError(f"checkpoint {path} has format {found}, this version reads format {FORMAT}: train again.")
    return content


def latest_checkpoint(run: Path) -> Path:
    """Newest checkpoint of a run folder.

    Raises:
        CheckpointError: if there is none.
    """
    found = sorted((run / "checkpoints").glob("*.pt"))  # named by frames, zero-padded
    if not found:
        raise CheckpointError(
            f"run={run} has no checkpoint in {run / 'checkpoints'}: give the folder of a run that wrote one."
        )
    return found[-1]


def find_checkpoint(run: Path, name: str | None) -> Path:
    """The named checkpoint of a run folder, or its newest (existence of a named one is left to :func:`load_checkpoint`)."""
    return latest_checkpoint(run) if name is None else run / "checkpoints" / name


def world_sizes(env: SurveillanceEnv) -> dict[str, int]:
    """The sizes that networks are made for."""
    return {"n_agents": env.config.n_agents, "dimension": env.config.dimension, "n_observation": env.n_observation}


def check_world(path: Path, found: dict, needed: dict, remedy: str = WORLD_REMEDY) -> None:
    """Compare the sizes that a checkpoint's networks were made for with the world they are to be used in.

    Args:
        path: for the message.
        found: sizes stored in the checkpoint.
        needed: sizes of the present world.
        remedy: what the message advises.

    Raises:
        CheckpointError: naming each size that differs.
    """
    different = [
        f"{name} is {found.get(name)} there, {value} here" for name, value in needed.items() if found.get(name) != value
    ]
    if different:
        raise CheckpointError(f"checkpoint {path} is of another world: {'; '.join(different)}. {remedy}")
