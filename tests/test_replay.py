"""Replay of one or several learners against TorchRL's buffers, one for each."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from agents.replay import Replay

CPU = torch.device("cpu")
READS = ["a", ("next", "b")]


def rows(count, generator):
    return TensorDict(
        {"a": torch.randn(count, 2, generator=generator), "next": {"b": torch.randn(count, generator=generator) > 0}},
        [count],
    )


def torchrl(capacity, seed):
    generator = torch.Generator().manual_seed(seed)
    return TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), generator=generator)


@pytest.mark.parametrize("capacity", [7, 10, 64])
@pytest.mark.parametrize("seeds", [[3], [3, 5, 9]], ids=str)
def test_stores_and_draws_what_torchrl_does(capacity, seeds):
    generator = torch.Generator().manual_seed(0)
    replay, theirs = Replay(capacity, seeds, CPU), [torchrl(capacity, seed) for seed in seeds]
    for _ in range(30):
        count = int(torch.randint(1, 8, (), generator=generator))
        new = [rows(count, generator) for _ in seeds]
        replay.store(torch.cat(new))
        for buffer, own in zip(theirs, new, strict=True):
            buffer.extend(own.clone())
        expected = torch.stack([buffer.sample(5).select(*READS) for buffer in theirs])
        found = replay.draw(5, READS)
        assert found.shape == ((len(seeds), 5) if len(seeds) > 1 else (5,))
        assert (found == expected.view(found.shape)).all()
        for part, buffer in zip(replay.parts, theirs, strict=True):
            assert len(part) == len(buffer)
            assert part.written == buffer.write_count
            whole = TensorDict({key: value[part.k, : len(part)] for key, value in replay.tensors.items()}, [len(part)])
            assert (whole == buffer.storage.get(slice(0, len(part))).select(*READS)).all()


def test_only_what_is_asked_for_is_drawn():
    replay = Replay(10, [0, 1], CPU)
    replay.store(rows(4, None))
    assert set(replay.draw(3, [("next", "b")]).keys(True, True)) == {("next", "b")}


def test_more_than_there_is_room_for_leaves_the_newest():
    replay, new = Replay(5, [0, 1], CPU), rows(26, None)
    replay.store(new[:6])
    replay.store(new)
    for part, own in zip(replay.parts, new.chunk(2), strict=True):
        assert part.written == 16
        assert (part.rows(11, 16) == own[8:]).all()
        assert len(part) == 5


def test_learners_that_hold_different_numbers_of_transitions():
    """As after a resume in which one of them has found no rows."""
    replay, new = Replay(7, [0, 1], CPU), [rows(5, None), rows(12, None)]
    alone = [Replay(7, [seed], CPU) for seed in (0, 1)]
    for own in (replay.parts[1], alone[1].parts[0]):
        own.restore(new[0], 23)
    for k in range(2):
        replay.store(torch.cat([own[3 * k : 3 * k + 3] for own in new[1].chunk(2)]))
        for other, own in zip(alone, new[1].chunk(2), strict=True):
            other.store(own[3 * k : 3 * k + 3])
    found = replay.draw(50, READS)
    for k, other in enumerate(alone):
        assert replay.parts[k].written == [6, 29][k]
        assert (found[k] == other.draw(50, READS)).all()


def test_nothing_is_no_transition():
    replay = Replay(5, [0], CPU)
    replay.store(rows(0, None))
    assert not replay.tensors
    assert len(replay.parts[0]) == 0


def test_transitions_with_other_entries_are_refused():
    replay = Replay(5, [0], CPU)
    replay.store(rows(2, None))
    for others, differing in (
        (rows(2, None).exclude(("next", "b")).set("c", torch.zeros(2)), "c, next.b"),
        (rows(2, None).set("a", torch.zeros(2, 1)), "a"),
        (rows(2, None).set("a", torch.zeros(2, 2, dtype=torch.float64)), "a"),
    ):
        with pytest.raises(ValueError, match=f"the same entries .*; these differ: {differing}"):
            replay.store(others)
    assert replay.parts[0].written == 2


def test_each_learner_draws_by_a_stream_of_its_own():
    data, samples = TensorDict({"x": torch.arange(50.0)}, [50]), []
    for seed in (3, 3, 4):
        torch.manual_seed(seed + len(samples))
        replay = Replay(100, [seed], CPU)
        replay.store(data)
        samples.append(replay.draw(16, ["x"])["x"])
    assert torch.equal(samples[0], samples[1])
    assert not torch.equal(samples[0], samples[2])
