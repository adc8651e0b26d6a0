"""Checkpoints: atomic, read without code execution, refused with a reason."""

import os

import pytest
import torch

from agents.checkpoint import (
    CheckpointError,
    check_world,
    latest_checkpoint,
    load_checkpoint,
    observed_difference,
    save_checkpoint,
    set_aside,
)
from envs import SurveillanceConfig, SurveillanceEnv

torch.set_num_threads(1)


def content(seed=0):
    return {
        "actor": {"weight": torch.randn(3, 4, generator=torch.Generator().manual_seed(seed))},
        "frames": 17,
        "names": ["a", "b"],
        "rate": 0.5,
    }


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_is_saved_comes_back(tmp_path):
    path = tmp_path / "run" / "checkpoints" / "frames_000017.pt"
    assert save_checkpoint(path, content()) == path
    assert names(path.parent) == ["frames_000017.pt"]  # no temporary file left
    loaded = load_checkpoint(path)
    assert torch.equal(loaded["actor"]["weight"], content()["actor"]["weight"])
    assert (loaded["frames"], loaded["names"], loaded["rate"]) == (17, ["a", "b"], 0.5)


def test_saving_replaces_the_file_as_a_whole(tmp_path):
    path = save_checkpoint(tmp_path / "a.pt", content(0))
    save_checkpoint(path, content(1))
    assert torch.equal(load_checkpoint(path)["actor"]["weight"], content(1)["actor"]["weight"])
    assert names(tmp_path) == ["a.pt"]


def test_failure_while_saving_leaves_the_old_file_alone(tmp_path):
    path = save_checkpoint(tmp_path / "a.pt", content(0))
    before = path.read_bytes()
    with pytest.raises((AttributeError, TypeError, RuntimeError), match=r"pickle|local"):
        save_checkpoint(path, {**content(1), "function": lambda: None})
    assert path.read_bytes() == before
    with pytest.raises((AttributeError, TypeError, RuntimeError), match=r"pickle|local"):
        save_checkpoint(tmp_path / "b.pt", {"function": lambda: None})
    assert not (tmp_path / "b.pt").exists()


def test_missing_file(tmp_path):
    path = tmp_path / "none.pt"
    with pytest.raises(CheckpointError, match=rf"{path} does not exist: give the folder of a run"):
        load_checkpoint(path)


class Foreign:
    """Pickled by reference: weights_only must not run it."""


def truncate(path):
    save_checkpoint(path, content())
    path.write_bytes(path.read_bytes()[:-200])


def damage(path):
    save_checkpoint(path, content())
    path.write_bytes(b"\0" * path.stat().st_size)


@pytest.mark.parametrize(
    "make",
    [
        truncate,
        damage,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_text("no checkpoint at all"),
        lambda path: torch.save({"format": 1, "thing": Foreign()}, path),
    ],
    ids=["truncated", "zeros", "empty", "text", "foreign object"],
)
def test_unreadable_file(tmp_path, make):
    path = tmp_path / "bad.pt"
    make(path)
    with pytest.raises(
        CheckpointError, match=rf"{path} cannot be read .*damaged or not a checkpoint.*Use another file"
    ):
        load_checkpoint(path)


@pytest.mark.parametrize("foreign", [{"format": 3}, {"weights": 1}, [1, 2], torch.zeros(3)], ids=str)
def test_other_format(tmp_path, foreign):
    path = tmp_path / "other.pt"
    torch.save(foreign, path)
    found = foreign.get("format") if isinstance(foreign, dict) else None
    with pytest.raises(
        CheckpointError, match=rf"{path} has format {found}, this version reads formats 1 to 2: train again"
    ):
        load_checkpoint(path)


def test_error_is_a_value_error():
    assert issubclass(CheckpointError, ValueError)  # so that the command line shows it as one clear message


def test_latest_is_the_one_with_most_frames_whatever_the_files_times(tmp_path):
    folder = tmp_path / "checkpoints"
    for k, name in enumerate(("frames_2.pt", "frames_3.pt", "frames_1.pt")):
        os.utime(save_checkpoint(folder / name, content()), (1000 + k, 1000 + k))
    (folder / "frames_9.tmp").write_bytes(b"")
    assert latest_checkpoint(tmp_path) == folder / "frames_3.pt"


def test_run_without_checkpoint(tmp_path):
    with pytest.raises(CheckpointError, match=rf"run={tmp_path} has no checkpoint"):
        latest_checkpoint(tmp_path)


def test_world_of_another_size(tmp_path):
    path, world = tmp_path / "a.pt", {"n_agents": 3, "dimension": 2, "n_observation": 18}
    check_world(path, dict(world), world)
    with pytest.raises(CheckpointError) as caught:
        check_world(path, world | {"n_agents": 5, "n_observation": 28}, world)
    message = str(caught.value)
    assert str(path) in message
    assert "n_agents is 5 there, 3 here" in message
    assert "n_observation is 28 there, 18 here" in message
    assert "dimension" not in message
    assert "leave env out" in message
    moving = SurveillanceConfig(horizon=0, density="moving")
    there, here = SurveillanceEnv(SurveillanceConfig()), SurveillanceEnv(moving)
    fields = observed_difference(there, here)
    assert fields == f"density 0 there, {here.density.n_observed} here; time 1 there, 0 here"
    assert observed_difference(here, here) == ""
    with pytest.raises(CheckpointError, match=r"n_observation is 28 there, 18 here \(density 0 there, "):
        check_world(path, world | {"n_observation": 28}, world, observed=lambda: fields)
    with pytest.raises(CheckpointError, match="n_agents is None there, 3 here"):
        check_world(path, {"dimension": 2, "n_observation": 18}, world)


def test_set_aside_keeps_an_earlier_run_whole(tmp_path):
    assert set_aside(tmp_path) is None
    for k in (1, 2):
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / f"frames_{k}.pt").write_bytes(b"x")
        (tmp_path / "summary.json").write_text(str(k))
        (tmp_path / "events.out.tfevents.1.a").write_text(str(k))
        (tmp_path / ".hydra").mkdir(exist_ok=True)
        assert set_aside(tmp_path) == tmp_path / f"replaced_{k}"
        assert (tmp_path / f"replaced_{k}" / "summary.json").read_text() == str(k)
        assert (tmp_path / f"replaced_{k}" / "events.out.replaced.1.a").read_text() == str(k)  # no run in TensorBoard
        assert (tmp_path / f"replaced_{k}" / "checkpoints" / f"frames_{k}.pt").exists()
        assert {path.name for path in tmp_path.iterdir() if not path.name.startswith("replaced")} == {".hydra"}
