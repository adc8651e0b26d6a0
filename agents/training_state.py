"""Everything that a run needs to go on to the same bits: saved at intervals, restored by ``resume``.

A checkpoint holds the state of every part (networks, targets, optimisers, worlds, noise, counters, clocks), all random
streams, the configuration and, through :mod:`agents.replay_files`, the replay buffer.
"""

import functools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from agents.checkpoint import (
    FORMAT,
    CheckpointError,
    checkpoints,
    frames_of,
    is_sound,
    keep_newest,
    load_checkpoint,
    save_checkpoint,
    set_aside,
)
from agents.learners import steps_taken
from agents.replay import ReplayOfLearner
from agents.replay_files import ReplayFiles, check_rows

MAY_DIFFER = ("collector.total_frames", "train", "eval", "compile", "fixed_sizes", "cuda_graphs")
"""Settings that a run may change when it goes on from another run's checkpoint."""


class TrainingState:
    """The parts of a run, and their checkpoints in ``<folder>/checkpoints``.

    Args:
        folder: the run's folder.
        parts: by name, objects with ``state_dict`` and ``load_state_dict`` (``continue_from`` where there is one), or
            dictionaries of such objects. "recorder" has ``frames``.
        buffer: the replay buffer, empty.
        origin: where the run comes from: "config" (hashed settings, nested), "config_hash", "seed", "git_hash", "versions",
            "world" (sizes of the networks), "device" and "threads".
        keep: newest checkpoints kept, 0 = all.
        with_buffer: save the replay buffer, and restore it.
    """

    def __init__(
        self,
        folder: Path,
        parts: Mapping[str, Any],
        buffer: ReplayOfLearner,
        origin: dict,
        *,
        keep: int,
        with_buffer: bool,
    ) -> None:
        self.folder = folder / "checkpoints"
        self.parts, self.origin, self.keep = parts, origin, keep
        self.replay = ReplayFiles(self.folder / "replay", buffer) if with_buffer else None

    def save(self, *, ended: bool = False) -> Path:
        """Write a checkpoint; the previous ones stay until :meth:`tidy`.

        Args:
            ended: the run collects no more; going on from here needs no replay rows.

        Raises:
            CheckpointError: if it cannot be written.
        """
        frames = self.parts["recorder"].frames
        content = {
            **self.origin,
            "frames": frames,
            "ended": ended,
            "parts": _states(self.parts),
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
            "replay": None if self.replay is None else self.replay.save(),
        }
        content["actor"] = content["parts"]["actor"]  # the policy, where every reader finds it
        return save_checkpoint(self.folder / f"frames_{frames:012d}.pt", content)

    def tidy(self) -> None:
        """Delete the checkpoints and replay rows that are no longer kept."""
        keep_newest(self.folder, self.keep)
        if self.replay is not None:
            self.replay.prune()

    def save_best(self) -> None:
        """Write the policy alone to ``best.pt``: the one with the least coverage cost in an evaluation so far."""
        content = {**self.origin, "frames": self.parts["recorder"].frames, "actor": self.parts["actor"].state_dict()}
        save_checkpoint(self.folder / "best.pt", content)

    def finish(self) -> None:
        """Delete the replay files of a finished run: only a run that goes on needs them."""
        if self.replay is not None:
            self.replay.clear()

    def resume(self, resume: str, tell: Callable[[str], None], latest: int | None = None) -> bool:
        """Restore what ``resume`` names.

        Args:
            resume: ``auto``: the newest valid checkpoint of this run's folder, if there is one; ``never``: none; a
                checkpoint or a run's folder: that one, unless it is of another folder and this run has its own.
            tell: shows a line to the user.
            latest: ``auto``: pass over checkpoints of more frames than this.

        Returns:
            Whether the replay buffer is the one of the checkpoint; True where nothing was restored.

        Raises:
            CheckpointError: if the checkpoint cannot be used; nothing has been restored then.
        """
        rows = self.replay is not None
        found = None if resume == "never" else newest_valid(self.folder, tell, latest, rows=rows)
        if resume not in ("auto", "never"):
            path = Path(resume)
            elsewhere = (path if path.is_dir() else path.parent.parent).resolve() != self.folder.parent.resolve()
            if found is not None and elsewhere:
                tell(f"{self.folder.parent} has checkpoints of its own: going on from them, not from {resume}.")
            else:
                found = named_checkpoint(path, tell, rows=rows)
        if found is None:
            if target := set_aside(self.folder.parent):
                reason = "resume=never" if resume == "never" else "no checkpoint"
                tell(f"starting anew ({reason}): what was there is in {target}.")
            return True
        path, content = found
        own = path.parent.resolve() == self.folder.resolve()
        check_origin(path, content, self.origin, may_differ=() if own else MAY_DIFFER)
        without_rows = ""
        if content["ended"] and not own:  # a longer run goes on collecting
            content["ended"], without_rows = False, "a finished run's rows are deleted"
        if self.replay is None or content["replay"] is None:
            without_rows = "checkpoint.buffer=false"
        elif not without_rows and not content["ended"]:
            self.replay.load(content["replay"], path.parent / "replay")
        _load_states(self.parts, content["parts"])
        torch.set_rng_state(content["torch"].cpu())
        if content["cuda"] and torch.cuda.is_available():
            torch.cuda.set_rng_state_all([state.cpu() for state in content["cuda"]][: torch.cuda.device_count()])
        if own:
            later = [other for other in checkpoints(self.folder) if other.name > path.name]
            set_aside(self.folder.parent, later + list(self.folder.parent.glob("summary.json")))
        else:
            set_aside(self.folder.parent)
        for leftover in self.folder.glob("**/*.tmp"):  # of a write that was killed
            leftover.unlink()
        tell(f"going on from {path} at {content['frames']} frames.{_changes(content, self.origin)}")
        if without_rows:
            tell(f"the replay buffer starts empty ({without_rows}): not the bits of an uninterrupted run.")
        return not without_rows


def newest_valid(
    folder: Path, tell: Callable[[str], None], latest: int | None = None, *, rows: bool
) -> tuple[Path, dict] | None:
    """The newest checkpoint of a ``checkpoints`` folder that a run can go on from, with its content; None if there is none.

    Args:
        folder: where to look.
        tell: shows a line for each one that is damaged.
        latest: of at most this many frames.
        rows: its replay rows are needed too.

    Raises:
        CheckpointError: if only replay rows are missing, of all that there are.
    """
    without_rows: CheckpointError | None = None
    for path, content, error in _readable(folder, tell, latest, rows=rows):
        if error is None:
            return path, content
        without_rows = without_rows or error
    if without_rows is not None:
        raise without_rows
    return None


def _readable(
    folder: Path, tell: Callable[[str], None], latest: int | None = None, *, rows: bool
) -> Iterator[tuple[Path, dict, CheckpointError | None]]:
    """Checkpoints that can be read, newest first, each with its content and with what is wrong with its replay rows.

    Arguments as :func:`newest_valid`.
    """
    sound = functools.cache(is_sound)
    for path in reversed(checkpoints(folder)):
        if latest is not None and frames_of(path) > latest:
            continue
        try:
            content = load_resumable(path)
        except CheckpointError as error:
            tell(f"passed over: {error}")
            continue
        missing = None
        try:
            if rows:
                check_rows_of(path, content, sound)
        except CheckpointError as error:
            tell(f"passed over {path.name}: {error}")
            missing = error
        yield path, content, missing


def check_rows_of(path: Path, content: dict, sound: Callable[[Path], bool] = is_sound) -> None:
    """Refuse a checkpoint that lacks its replay rows; one of a run that collects no more needs none.

    Raises:
        CheckpointError: naming the rows.
    """
    if content["replay"] is not None and not content["ended"]:
        check_rows(content["replay"], path.parent / "replay", sound)


def valid_ages(folder: Path, tell: Callable[[str], None], *, rows: bool) -> set[tuple[int, int]]:
    """Frames and updates of the checkpoints of a ``checkpoints`` folder that a run can go on from.

    Those whose replay ``rows`` are not there are left out, if they are needed and others have theirs.
    """
    found = [
        ((content["frames"], steps_taken(content["parts"]["optimizers"]["loss_value"]["state"])), error)
        for _, content, error in _readable(folder, tell, rows=rows)
    ]
    return {age for age, error in found if error is None} or {age for age, _ in found}


def named_checkpoint(path: Path, tell: Callable[[str], None], *, rows: bool) -> tuple[Path, dict]:
    """The checkpoint that ``resume=<path>`` names: a file, or the newest valid one of a run's folder.

    Args:
        path: file or folder.
        tell: shows a line for each one that is damaged.
        rows: its replay rows are needed too.

    Raises:
        CheckpointError: if there is none, or it lacks its rows.
    """
    if not path.is_dir():
        content = load_resumable(path)
        if rows:
            check_rows_of(path, content)
        return path, content
    found = newest_valid(path / "checkpoints", tell, rows=rows)
    if found is None:
        raise CheckpointError(
            f"resume={path}: {path / 'checkpoints'} holds no checkpoint that a run can go on from. Give a checkpoint file or "
            "the folder of a run, or resume=auto."
        )
    return found


def load_resumable(path: Path) -> dict:
    """Read a checkpoint that a run can go on from.

    Raises:
        CheckpointError: as :func:`load_checkpoint`, or if it holds a policy only or is of an older format.
    """
    content = load_checkpoint(path)
    if content["format"] != FORMAT or "parts" not in content:
        kind = f"format {content['format']}" if content["format"] != FORMAT else "a policy only"
        raise CheckpointError(
            f"checkpoint {path} ({kind}) does not hold what a run needs to go on: evaluate.py can use it, resume cannot. "
            "Use a frames_*.pt of this version, or resume=never."
        )
    return content


def check_origin(path: Path, content: dict, origin: dict, may_differ: tuple[str, ...]) -> None:
    """Refuse a checkpoint of another configuration or seed.

    Raises:
        CheckpointError: naming the first settings that differ.
    """
    there, here = _flat(content["config"]), _flat(origin["config"])
    there["seed"], here["seed"] = content["seed"], origin["seed"]
    different = [
        f"{name} is {there.get(name)} there, {here.get(name)} here"
        for name in sorted(there | here)
        if there.get(name) != here.get(name) and not name.startswith(may_differ)
    ]
    if different:
        allowed = f"({', '.join(may_differ)} may differ) " if may_differ else ""
        more = f" and {len(different) - 3} more" if len(different) > 3 else ""
        raise CheckpointError(
            f"checkpoint {path} is of another run: {'; '.join(different[:3])}{more}. Use the settings it was trained with "
            f"{allowed}or resume=never."
        )


def check_frames(resume: str, frames: int, total: int) -> None:
    """Refuse a checkpoint of more ``frames`` than a run is asked for.

    Raises:
        CheckpointError: naming both.
    """
    if frames > total:
        raise CheckpointError(
            f"resume={resume}: its checkpoint is at {frames} frames, beyond collector.total_frames={total}: ask for more, or "
            "take an older one."
        )


def _changes(content: dict, origin: dict) -> str:
    names = [name for name in ("git_hash", "versions", "device", "threads") if content[name] != origin[name]]
    if not names:
        return ""
    code = ""
    if "git_hash" in names:
        code = f" (the code: until here it was {content['git_hash']}, from here it is {origin['git_hash']})"
    return f" Changed since: {', '.join(names)}{code}; the bits may differ from an uninterrupted run's."


def _flat(config: dict, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in config.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _states(parts: Mapping[str, Any]) -> dict:
    return {name: _states(part) if isinstance(part, Mapping) else part.state_dict() for name, part in parts.items()}


def _load_states(parts: Mapping[str, Any], states: dict) -> None:
    for name, part in parts.items():
        if isinstance(part, Mapping):
            _load_states(part, states[name])
        else:
            getattr(part, "continue_from", part.load_state_dict)(states[name])
