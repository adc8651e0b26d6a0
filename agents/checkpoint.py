"""Checkpoints: written atomically, read with ``weights_only``, refused with a reason when they do not fit."""

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import torch

from envs import SurveillanceEnv
from envs.observation import observation_fields

FORMAT = 2
READABLE = (1, 2)  # format 1 holds the networks, but not all that a run needs to go on
WORLD_REMEDY = (
    "A policy fits worlds with the same observation: use the world that the run was trained in (leave env out), or train in "
    "this one."
)


class CheckpointError(ValueError):
    """A checkpoint that is missing, unreadable, unwritable or of another world; the message says which and what to do."""


def save_checkpoint(path: Path, content: dict) -> Path:
    """Write ``content`` (tensors, numbers, strings, lists, dicts) so that ``path`` is complete or absent, whatever happens.

    Args:
        path: file to write.
        content: what to keep; ``format`` is added.

    Returns:
        The path.

    Raises:
        CheckpointError: if it cannot be written (full disk, read-only folder); what ``path`` held before is still there.
    """
    temporary = path.with_suffix(".tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            torch.save({"format": FORMAT, **content}, file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except (OSError, RuntimeError) as error:  # torch turns some write errors into RuntimeErrors
        reason = str(error).splitlines()[0]
        raise CheckpointError(
            f"checkpoint {path} cannot be written ({reason}). Earlier ones are kept. Free space or make the folder writable, "
            "then the same command goes on from the newest."
        ) from error
    finally:
        _remove(temporary)  # left over only if writing failed
    return path


def _sync_folder(folder: Path) -> None:
    """Make a rename in ``folder`` survive a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # a read-only folder: the error that is on its way says so
        return


def set_aside(folder: Path, found: list[Path] | None = None) -> Path | None:
    """Move what an earlier run wrote into ``folder`` to ``replaced_<k>`` inside it, so that nothing is mixed or lost.

    Event files lose the word that TensorBoard knows them by: replaced runs would stand among the others.

    Args:
        folder: the run's folder.
        found: what to move; everything that a run writes if not given.

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
    if found is None:
        found = [path for pattern in patterns for path in folder.glob(pattern)]
    if not found:
        return None
    target = folder / f"replaced_{1 + len(list(folder.glob('replaced_*')))}"
    for path in found:
        place = target / path.relative_to(folder)
        place.parent.mkdir(parents=True, exist_ok=True)
        path.rename(place.with_name(place.name.replace("tfevents", "replaced")))
    return target


def keep_newest(folder: Path, keep: int) -> None:
    """Delete all but the ``keep`` newest checkpoints of ``folder``; 0 keeps all."""
    if keep:
        for old in checkpoints(folder)[:-keep]:
            old.unlink()


def is_sound(path: Path) -> bool:
    """Whether a file is as it was written, by the checksums of its zip archive; ``torch.load`` does not look at them."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except Exception:  # damaged archives raise many kinds
        return False


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict:
    """Read a checkpoint, every byte of it checked against the checksums that its zip archive holds.

    Raises:
        CheckpointError: if the file is missing, truncated, damaged, foreign or of another format.
    """
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist: give the folder of a run that has written one.")
    try:
        if not is_sound(path):
            raise zipfile.BadZipFile
        content = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged files
        raise CheckpointError(
            f"checkpoint {path} cannot be read ({type(error).__name__}): it is damaged or not a checkpoint of this project. "
            f"{_other_of(path)}"
        ) from error
    found = content.get("format") if isinstance(content, dict) else None
    if found not in READABLE:
        raise CheckpointError(
            f"checkpoint {path} has format {found}, this version reads formats {READABLE[0]} to {READABLE[-1]}: train again, "
            "or use the version of this project that wrote it."
        )
    return content


def _other_of(path: Path) -> str:
    others = [other for other in checkpoints(path.parent) if other.name < path.name]
    return f"The one before it is {others[-1]}." if others else "Use another file of its folder."


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a ``checkpoints`` folder, oldest first (they are named by frames, zero-padded)."""
    return sorted(folder.glob("frames_*.pt"))


def frames_of(path: Path) -> int:
    """World-steps that the run had collected, by a checkpoint's name."""
    return int(path.stem.removeprefix("frames_"))


def latest_checkpoint(run: Path) -> Path:
    """Newest checkpoint of a run folder.

    Raises:
        CheckpointError: if there is none.
    """
    found = checkpoints(run / "checkpoints")
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


def observed_difference(there: SurveillanceEnv, here: SurveillanceEnv) -> str:
    """Which fields of the observation have other sizes in another world, with the sizes; empty if none."""
    sizes = [
        {name: part.stop - part.start for name, part in observation_fields(env.config, env.density).items()}
        for env in (there, here)
    ]
    return "; ".join(
        f"{name} {size} there, {sizes[1][name]} here" for name, size in sizes[0].items() if size != sizes[1][name]
    )


def check_world(
    path: Path, found: dict, needed: dict, remedy: str = WORLD_REMEDY, observed: Callable[[], str] = str
) -> None:
    """Compare the sizes that a checkpoint's networks were made for with the world they are to be used in.

    Args:
        path: for the message.
        found: sizes stored in the checkpoint.
        needed: sizes of the present world.
        remedy: what the message advises.
        observed: asked only if they differ: in which fields of the observation, where that is known.

    Raises:
        CheckpointError: naming each size that differs.
    """
    different = [
        f"{name} is {found.get(name)} there, {value} here" for name, value in needed.items() if found.get(name) != value
    ]
    if different:
        fields = f" ({text})" if (text := observed()) else ""
        raise CheckpointError(f"checkpoint {path} is of another world: {'; '.join(different)}{fields}. {remedy}")
