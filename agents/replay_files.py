"""The replay buffer on disk: each checkpoint adds one file with the rows written since the last one.

Row k is the k-th transition ever stored. A checkpoint at W rows needs the rows from ``max(0, W - capacity)`` to W, so the
cost of saving grows with what is new, not with the capacity.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDict

from agents.checkpoint import CheckpointError, is_sound, load_checkpoint, save_checkpoint
from agents.replay import ReplayOfLearner
from envs.randomness import restore_generator


class ReplayFiles:
    """Saves and restores the rows of a ring buffer.

    Args:
        folder: where ``rows_<first>_<end>.pt`` go.
        buffer: the buffer; nothing is deleted from it, its oldest rows are overwritten.
    """

    def __init__(self, folder: Path, buffer: ReplayOfLearner) -> None:
        self.folder, self.buffer = folder, buffer
        self.capacity = buffer.replay.capacity
        self.saved = 0
        """Rows that the last checkpoint knows of."""
        self.saved_before = 0
        """The same of the checkpoint before that, which must stay usable."""

    def save(self) -> dict:
        """Write the new rows; returns what :meth:`load` needs."""
        written = self.buffer.written
        start = max(self.saved, written - self.capacity)
        if written > start:
            rows = self.buffer.rows(start, written).to_dict()
            save_checkpoint(self.folder / f"rows_{start:015d}_{written:015d}.pt", {"rows": rows})
        self.saved_before, self.saved = self.saved, written
        return {
            "written": written,
            "written_before": self.saved_before,
            "first": max(0, written - self.capacity),
            "rng": (self.buffer.generator.get_state(), str(self.buffer.replay.device)),
        }

    def prune(self) -> None:
        """Delete the files that neither of the last two checkpoints needs."""
        for path, (_, end) in row_files(self.folder).items():
            if end <= self.saved_before - self.capacity:
                path.unlink()

    def clear(self) -> None:
        """Delete all files: a finished run needs none."""
        for path in row_files(self.folder):
            path.unlink()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def load(self, state: dict, source: Path) -> None:
        """Fill the empty buffer with the rows it held when :meth:`save` returned ``state``.

        Args:
            state: what :meth:`save` returned.
            source: folder that the files are in.

        Raises:
            CheckpointError: if rows are missing or damaged.
        """
        written, parts = state["written"], []
        for path, rows, start in _chain(source, row_files(source), max(0, written - self.capacity), written):
            whole = TensorDict(load_checkpoint(path, self.buffer.replay.device)["rows"], [rows])
            parts.append(whole[start:].exclude("index"))  # which earlier versions saved, too
        self.buffer.restore(torch.cat(parts) if parts else None, written)
        restore_generator(self.buffer.generator, state["rng"][0])
        if source != self.folder:  # of another run: the next checkpoint writes all rows into this one's folder
            return
        self.saved, self.saved_before = written, state["written_before"]
        for path, (_, end) in row_files(self.folder).items():
            if end > written:  # of a checkpoint that was not completed
                path.unlink()


def row_files(folder: Path) -> dict[Path, tuple[int, int]]:
    """The files of a folder, with their first row and one past their last row."""
    found = {path: path.stem.split("_") for path in folder.glob("rows_*_*.pt")}
    return {path: (int(first), int(end)) for path, (_, first, end) in found.items()}


def check_rows(state: dict, source: Path, sound: Callable[[Path], bool] = is_sound) -> None:
    """Refuse a checkpoint whose rows are not all there, without reading them.

    Args:
        state: what :meth:`ReplayFiles.save` returned.
        source: folder that the files are in.
        sound: whether a file is as it was written.

    Raises:
        CheckpointError: if rows are missing or damaged.
    """
    files = {path: rows for path, rows in row_files(source).items() if sound(path)}
    held = min((first for first, _ in files.values()), default=0)
    _chain(source, files, state.get("first", held), state["written"])  # earlier versions did not save the first


def _chain(source: Path, files: dict[Path, tuple[int, int]], at: int, end: int) -> list[tuple[Path, int, int]]:
    """Files that hold the rows from ``at`` to ``end``, in order: each with its number of rows and the first that is needed."""
    found = []
    for path, (first, last) in sorted(files.items(), key=lambda item: item[1]):
        if first <= at < last <= end:
            found.append((path, last - first, at - first))
            at = last
    if at < end:
        raise CheckpointError(
            f"{source} lacks the replay rows {at} to {end} of this checkpoint, or their file is damaged. Use another checkpoint of "
            "an unfinished run, or checkpoint.buffer=false: it goes on with an empty replay buffer, so not to the same bits."
        )
    return found
