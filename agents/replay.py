"""Uniform replay of several learners in one set of tensors: stored and drawn for all at once, by random streams of their own."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor


class Replay:
    """The ring buffers of one or several learners, all of the same capacity. Each draws as TorchRL's would by itself.

    TorchRL's buffers store and draw by TensorDict and one by one, which takes several times as long.

    Args:
        capacity: transitions that each keeps, the newest.
        seeds: of each learner's sampling.
        device: where the transitions live, and the random generators.
    """

    def __init__(self, capacity: int, seeds: Sequence[int], device: torch.device) -> None:
        self.capacity, self.device = capacity, device
        self.tensors: dict[tuple[str, ...], Tensor] = {}
        """By key, ``(learners, capacity, ...)``; made when the first transitions come."""
        self._kinds: dict[tuple[str, ...], tuple] = {}
        """Shape and type of a transition's entry."""
        self.parts = [ReplayOfLearner(self, k, seed) for k, seed in enumerate(seeds)]

    def store(self, rows: TensorDictBase) -> None:
        """Keep transitions ``(learners * M,)``, each learner's after the other's, in place of the oldest.

        Raises:
            ValueError: if they do not have the entries of the first ones.
        """
        count = len(rows) // len(self.parts)
        if not count:
            return
        new = {key: value.unflatten(0, (len(self.parts), count)) for key, value in flat(rows).items()}
        blocks = [(part.block, part.written) for part in self.parts]
        if len({part.written for part in self.parts}) == 1:  # not where one has gone on with an empty buffer
            blocks = [(slice(None), self.parts[0].written)]
        for block, written in blocks:
            self._write(block, written, {key: value[block] for key, value in new.items()})
        for part in self.parts:
            part.written += count

    def draw(self, count: int, reads: Sequence[NestedKey]) -> TensorDictBase:
        """The entries ``reads`` of ``count`` transitions of each learner, every one of them as likely each time.

        Returns:
            ``(count,)`` of the only learner, ``(learners, count)`` of several.
        """
        index = torch.cat([part.draw(count) for part in self.parts])
        shape = [len(self.parts), count] if len(self.parts) > 1 else [count]
        found = {}
        for key in reads:
            rows = self.tensors[(key,) if isinstance(key, str) else key].flatten(0, 1).index_select(0, index)
            found[key] = rows.unflatten(0, shape)
        return TensorDict(found, shape, self.device)

    def _write(self, block: slice, written: int, new: dict[tuple[str, ...], Tensor]) -> None:
        """Write rows ``(learners, M, ...)`` of a block that has had ``written`` before."""
        kinds = {key: (value.shape[2:], value.dtype) for key, value in new.items()}
        if not self.tensors:
            self._kinds = kinds
            for key, (shape, dtype) in kinds.items():
                self.tensors[key] = torch.empty(len(self.parts), self.capacity, *shape, dtype=dtype, device=self.device)
        if kinds != self._kinds:
            differing = sorted({key for key, _ in kinds.items() ^ self._kinds.items()})
            raise ValueError(
                "the replay buffer's transitions always have the same entries of the same shapes and types; these differ: "
                f"{', '.join('.'.join(key) for key in differing)}."
            )
        count = next(iter(new.values())).shape[1]
        first = max(0, count - self.capacity)
        while first < count:  # up to the ring's end, then from its beginning
            place = (written + first) % self.capacity
            some = min(count - first, self.capacity - place)
            targets = [tensor[block, place : place + some] for tensor in self.tensors.values()]
            torch._foreach_copy_(targets, [new[key][:, first : first + some] for key in self.tensors])
            first += some


class ReplayOfLearner:
    """A learner's part: the place and random stream of its own, for checkpoints.

    Args:
        replay: what it is part of.
        k: which part.
        seed: of its sampling.
    """

    def __init__(self, replay: Replay, k: int, seed: int) -> None:
        self.replay, self.k, self.block = replay, k, slice(k, k + 1)
        self.written = 0
        """Transitions stored so far, those included that have been overwritten."""
        self.generator = torch.Generator(device=replay.device).manual_seed(seed)  # draws rows where they lie

    def __len__(self) -> int:
        """Transitions that it holds."""
        return min(self.written, self.replay.capacity)

    def draw(self, count: int) -> Tensor:
        """Places of ``count`` transitions among all learners', ``(count,)``."""
        index = torch.randint(0, len(self), (count,), generator=self.generator, device=self.replay.device)
        return index + self.k * self.replay.capacity if self.k else index

    def rows(self, first: int, end: int) -> TensorDict:
        """The transitions ``first`` to ``end``, counted from the first ever stored, ``(end - first,)``."""
        index = torch.arange(first, end, device=self.replay.device) % self.replay.capacity
        found = {key: tensor[self.k].index_select(0, index) for key, tensor in self.replay.tensors.items()}
        return TensorDict(found, [end - first])

    def restore(self, rows: TensorDictBase | None, written: int) -> None:
        """Hold the transitions up to the ``written``-th ever stored, ``rows`` ``(M,)``, M at most the capacity."""
        if rows is not None:
            new = {key: value.to(self.replay.device).unsqueeze(0) for key, value in flat(rows).items()}
            self.replay._write(self.block, written - len(rows), new)
        self.written = written


def flat(rows: TensorDictBase) -> dict[tuple[str, ...], Tensor]:
    """The tensors of a tensordict by tuple of names."""
    items = rows.items(include_nested=True, leaves_only=True)
    return {(name,) if isinstance(name, str) else name: value for name, value in items}
