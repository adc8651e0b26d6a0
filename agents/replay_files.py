"""The replay buffer on disk: each checkpoint adds one file with the rows written since the last one.

Row k is the k-th transition ever stored. A checkpoint at W rows needs the rows from ``max(0, W - capacity)`` to W, so the
cost of saving grows with what is new, not with the capacity.
"""

from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

from agents.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from envs.randomness import restore_generator


class ReplayFiles:
    """Saves and restores the rows of a ring buffer.

    Args:
        folder: where ``rows_<first>_<end>.pt`` go.
        buffer: the buffer; nothing is deleted from it, its oldest rows are overwritten.
    """

    def __init__(self, folder: Path, buffer: TensorDictReplayBuffer) -> None:
        self.folder, self.buffer = folder, buffer
        self.capacity: int = buffer.storage.max_size
        self.saved = 0
        """Rows that the last checkpoint knows of."""
        self.saved_before = 0
        """The same of the checkpoint before that, which must stay usable."""

    def save(self) -> dict:
        """Write the new rows; returns what :meth:`load` needs."""
        state = self.buffer.state_dict()
        written: int = self.buffer.write_count
        start = max(self.saved, written - self.capacity)
        if written > start:
            index = torch.arange(start, written) % self.capacity
            rows = self.buffer.storage.get(index).to_dict()
            save_checkpoint(self.folder / f"rows_{start:015d}_{written:015d}.pt", {"rows": rows})
        self.saved_before, self.saved = self.saved, written
        return {"written": written, "written_before": self.saved_before, "rng": state["_rng"]}

    def prune(self) -> None:
        """Delete the files that neither of the last two checkpoints needs."""
        for path, (_, end) in self._files().items():
            if end <= self.saved_before - self.capacity:
                path.unlink()

    def clear(self) -> None:
        """Delete all files: a finished run needs none."""
        for path in self._files():
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
        written, capacity = state["written"], self.capacity
        first = max(0, written - capacity)
        at, parts = first, []
        files = ReplayFiles(source, self.buffer)._files()
        for path, (start, end) in sorted(files.items(), key=lambda item: item[1]):
            if start <= at < end <= written:
                device = getattr(self.buffer.storage, "device", "cpu")
                rows = TensorDict(load_checkpoint(path, device)["rows"], [end - start])
                parts.append(rows[at - start :])
                at = end
        if at < written:
            raise CheckpointError(
                f"{source} lacks the replay rows {at} to {written} of this checkpoint. Use a newer checkpoint of an unfinished "
                "run, or checkpoint.buffer=false: it goes on with an empty replay buffer, so not to the same bits."
            )
        if parts:
            rows = torch.cat(parts)  # row k belongs at index k modulo capacity
            shift = written % capacity if written > capacity else 0
            self.buffer.extend(torch.cat([rows[len(rows) - shift :], rows[: len(rows) - shift]]) if shift else rows)
        content = self.buffer.state_dict()
        writer = {"_cursor": written % capacity, "_write_count": written}
        self.buffer.load_state_dict(content | {"_writer": content["_writer"] | writer, "_rng": None})
        generator = torch.Generator(device=content["_rng"][1])
        restore_generator(generator, state["rng"][0])
        self.buffer.set_rng(generator)
        if source != self.folder:  # of another run: the next checkpoint writes all rows into this one's folder
            return
        self.saved, self.saved_before = written, state["written_before"]
        for path, (_, end) in self._files().items():
            if end > written:  # of a checkpoint that was not completed
                path.unlink()

    def _files(self) -> dict[Path, tuple[int, int]]:
        """Files with their first row and one past their last row."""
        found = {path: path.stem.split("_") for path in self.folder.glob("rows_*_*.pt")}
        return {path: (int(first), int(end)) for path, (_, first, end) in found.items()}
