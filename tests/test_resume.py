"""A run that is killed, stopped or starved of disk goes on to the bits of a run that was not."""

import json
import random
import shutil
import signal
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

import train
from agents.checkpoint import CheckpointError, checkpoints, load_checkpoint, save_checkpoint
from agents.replay import Replay
from agents.replay_files import ReplayFiles
from agents.training_state import check_origin
from tests import killing
from tests.killing import RUN, differences, result, run, run_killed_after

pytestmark = pytest.mark.xdist_group("resume")  # its fixtures are made once, not by every worker


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder of a run that nothing happens to; to be read, not used."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert run(folder) == 0, said(folder)
    return folder


@pytest.fixture(scope="module")
def whole(finished):
    """Result of a run that nothing happens to."""
    found = result(finished)
    assert {"eval/coverage_cost", "train/energy", "world/animation"} <= set(found["curves"])
    return found


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """Folder of a run that was killed after its fifth checkpoint (480 frames); to be copied, not used."""
    folder = tmp_path_factory.mktemp("killed") / "run"
    assert run(folder, stage="after checkpoint", count=5) == -signal.SIGKILL, said(folder)
    assert [path.name for path in checkpoints(folder / "checkpoints")][-1] == "frames_000000000480.pt"
    return folder


def said(folder: Path) -> str:
    """What the runs in a folder printed, in one line."""
    return " ".join(Path(f"{folder}.log").read_text().split())


def copy(folder: Path, target: Path) -> Path:
    shutil.copytree(folder, target)
    return target


@pytest.mark.parametrize(
    ("stage", "count"),
    [
        *(("before", 9), ("half written", 9), ("before rename", 9), ("after rename", 1), ("after rows", 4)),
        *(("after checkpoint", 10), ("in event file", 20), ("in clearing", 1), ("in summary", 1)),
    ],
)
def test_killed_inside_a_write(tmp_path, whole, stage, count):
    folder = tmp_path / "run"
    assert run(folder, stage=stage, count=count) == -signal.SIGKILL, said(folder)
    assert not (folder / "summary.json").exists()
    assert run(folder) == 0, said(folder)
    assert not differences(whole, result(folder))


def test_killed_at_random_instants(tmp_path, whole):
    folder, draw = tmp_path / "run", random.Random(0)
    for _ in range(4):
        run_killed_after(folder, draw.uniform(0.1, 2.0))
    run_killed_after(folder, 0.5)
    assert run(folder) == 0, said(folder)
    assert not differences(whole, result(folder))


def test_killed_while_an_earlier_run_is_moved_aside(tmp_path, whole):
    folder = tmp_path / "run"
    assert run(folder, stage="before rename", count=1) == -signal.SIGKILL
    assert run(folder, stage="in set-aside") == -signal.SIGKILL
    assert run(folder) == 0, said(folder)
    assert not differences(whole, result(folder))


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_writes_a_checkpoint_and_ends_the_run(tmp_path, whole, signum):
    folder, arguments = tmp_path / "run", (*RUN, "checkpoint.interval_frames=0")
    assert run(folder, arguments, stage="in training", count=9, by=signum) == 128 + signum
    assert not (folder / "summary.json").exists()
    frames = load_checkpoint(checkpoints(folder / "checkpoints")[-1])["frames"]
    assert frames == 9 * 32
    assert f"stopped by {signal.Signals(signum).name} at {frames} frames" in said(folder)
    assert "Traceback" not in said(folder)
    assert run(folder, arguments) == 0
    assert not differences(whole["curves"], result(folder)["curves"])


def test_a_full_disk_keeps_the_last_good_checkpoint(tmp_path, whole, killed):
    folder = copy(killed, tmp_path / "run")
    before = {path: path.read_bytes() for path in (folder / "checkpoints").rglob("*_*.pt")}
    assert run(folder, limit=200_000) == 1
    assert "frames_000000000576.pt cannot be written" in said(folder)
    assert "Earlier ones are kept. Free space" in said(folder)
    assert "Traceback" not in said(folder)
    assert all(path.read_bytes() == content for path, content in before.items())
    assert not list(folder.rglob("*.tmp"))
    assert run(folder) == 0, said(folder)
    assert not differences(whole, result(folder))


def test_a_folder_that_cannot_be_written(program, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoints").write_text("a file where the folder should be")
    code, output = program(train.main, *RUN, "hydra.run.dir=run", "resume=auto")
    assert code == 0, output  # moved aside
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    with pytest.raises(CheckpointError, match=r"cannot be written .*make the folder writable"):
        save_checkpoint(tmp_path / "run" / "summary.json" / "a.pt", {})


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 16
    path.write_bytes(content)


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def age(path):
    torch.save(torch.load(path, weights_only=True) | {"format": 1}, path)


@pytest.mark.parametrize("damage", [flip, cut, age])
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_used(tmp_path, whole, killed, damage):
    folder = copy(killed, tmp_path / "run")
    damage(folder / "checkpoints" / "frames_000000000480.pt")
    assert run(folder) == 0, said(folder)
    assert "passed over: checkpoint" in said(folder)
    assert "going on from" in said(folder)
    assert "frames_000000000384.pt at 384 frames" in said(folder)
    assert not differences(whole, result(folder))


def test_a_damaged_checkpoint_that_is_asked_for_is_refused(program, tmp_path, killed):
    folder = copy(killed, tmp_path / "run")
    asked = folder / "checkpoints" / "frames_000000000480.pt"
    before = set(tmp_path.rglob("*"))
    flip(asked)
    code, output = program(train.main, *RUN, f"resume={asked}", f"hydra.run.dir={tmp_path}/other")
    assert code == 1
    assert "cannot be read" in " ".join(output.split())
    assert "frames_000000000384.pt" in " ".join(output.split())
    assert "Traceback" not in output
    assert set(tmp_path.rglob("*")) == before
    flip(asked)
    code, output = program(train.main, *RUN, f"resume={asked.parent}/best.pt", f"hydra.run.dir={tmp_path}/other")
    assert code == 1
    assert "a policy only" in " ".join(output.split())


@pytest.mark.parametrize("damage", [flip, cut, Path.unlink])
def test_a_checkpoint_without_its_rows_is_passed_over(tmp_path, whole, killed, damage):
    folder = copy(killed, tmp_path / "run")
    damage(sorted((folder / "checkpoints" / "replay").iterdir())[-1])
    assert run(folder) == 0, said(folder)
    assert "passed over frames_000000000480.pt" in said(folder)
    assert "frames_000000000384.pt at 384 frames" in said(folder)
    assert not differences(whole, result(folder))


@pytest.mark.parametrize("damage", [flip, cut, Path.unlink])
def test_rows_that_all_checkpoints_need_are_asked_for(program, tmp_path, killed, damage):
    folder = copy(killed, tmp_path / "run")
    damage(sorted((folder / "checkpoints" / "replay").iterdir())[0])
    for arguments in ((f"hydra.run.dir={folder}",), (f"resume={folder}", "hydra.run.dir=other")):
        code, output = program(train.main, *RUN, *arguments)
        assert code == 1
        assert "lacks the replay rows 0 to" in " ".join(output.split())
        assert "checkpoint.buffer=false" in " ".join(output.split())
    assert not (tmp_path / "other").exists()
    code, output = program(train.main, *RUN, f"hydra.run.dir={folder}", "checkpoint.buffer=false")
    assert code == 0, output
    assert "the replay buffer starts empty (checkpoint.buffer=false)" in " ".join(output.split())
    assert json.loads((folder / "summary.json").read_text())["checkpoint"] == {"buffer": False}


def test_a_checkpoint_of_another_configuration_or_seed_is_refused(program, tmp_path, killed):
    folder = copy(killed, tmp_path / "run")
    for override, named in (
        ("agent.actor_lr=0.01", "agent.actor_lr is 0.001 there, 0.01 here"),
        ("seed=1", "seed is 0 there, 1 here"),
        ("collector.total_frames=2048", "collector.total_frames is 1024 there, 2048 here"),
    ):
        code, output = program(train.main, *RUN, f"hydra.run.dir={folder}", override)
        assert code == 1
        assert named in " ".join(output.split())
    here = {"config": dict.fromkeys("abcde", 1), "seed": 0}
    with pytest.raises(CheckpointError, match=r"a is 0 there, 1 here; b is 0 there, 1 here; .* and 2 more"):
        check_origin(folder, {"config": dict.fromkeys("abcde", 0), "seed": 0}, here, ())


def test_a_run_is_made_longer_from_another_runs_checkpoint(program, tmp_path, killed):
    longer = ("collector.total_frames=1536", "eval.interval_frames=0", "hydra.run.dir=longer", f"resume={killed}")
    code, output = program(train.main, *RUN, *longer)
    assert code == 0, output
    assert "going on from" in output
    assert json.loads((tmp_path / "longer" / "summary.json").read_text())["frames"] == 1536
    assert "nothing to do" in program(train.main, *RUN, *longer)[1]
    whole = (*RUN, *longer[:2], "hydra.run.dir=whole")
    assert program(train.main, *whole)[0] == 0
    networks = [
        load_checkpoint(checkpoints(tmp_path / name / "checkpoints")[-1])["parts"]["loss"]
        for name in ("longer", "whole")
    ]
    assert not differences(*networks)


def test_a_finished_run_is_made_longer_with_an_empty_buffer(program, tmp_path, finished):
    arguments = (*RUN, "collector.total_frames=1536", "hydra.run.dir=longer", f"resume={finished}")
    code, output = program(train.main, *arguments)
    assert code == 0, output
    assert "the replay buffer starts empty (a finished run's rows are deleted)" in " ".join(output.split())
    assert json.loads((tmp_path / "longer" / "summary.json").read_text())["frames"] == 1536
    code, output = program(train.main, *RUN, "collector.total_frames=512", "hydra.run.dir=shorter", arguments[-1])
    assert code == 1
    assert "its checkpoint is at 1024 frames, beyond collector.total_frames=512" in " ".join(output.split())
    assert not (tmp_path / "shorter").exists()


def test_a_run_that_starts_anew_says_where_the_attempt_before_it_is(program, tmp_path):
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    short = (*RUN, "collector.total_frames=128", "train.warmup_frames=64", "hydra.run.dir=run")
    code, output = program(train.main, *short)
    assert code == 0, output
    assert "starting anew (no checkpoint): what was there is in" in " ".join(output.split())
    assert "run/replaced_1." in "".join(output.split())
    code, output = program(train.main, *short, "resume=never")
    assert "starting anew (resume=never)" in " ".join(output.split())
    assert "run/replaced_2." in "".join(output.split())


def test_rewinding_keeps_what_came_later(program, tmp_path, killed):
    folder = copy(killed, tmp_path / "run")
    older = folder / "checkpoints" / "frames_000000000384.pt"
    code, output = program(train.main, *RUN, f"resume={older}", f"hydra.run.dir={folder}")
    assert code == 0, output
    assert (folder / "replaced_1" / "checkpoints" / "frames_000000000480.pt").exists()


def test_resume_never_starts_anew(program, tmp_path, killed):
    folder = copy(killed, tmp_path / "run")
    code, output = program(train.main, *RUN, "resume=never", f"hydra.run.dir={folder}")
    assert code == 0, output
    assert "going on" not in output
    assert (folder / "replaced_1" / "checkpoints" / "frames_000000000480.pt").exists()


@pytest.mark.parametrize("resume", ["nowhere", "maybe.pt"])
def test_resume_from_nowhere(program, tmp_path, resume):
    code, output = program(train.main, *RUN, f"resume={resume}")
    assert code == 1
    assert f"resume={resume} is neither auto nor never" in output
    assert not list(tmp_path.iterdir())


def test_rows_of_a_ring_buffer_come_back(tmp_path):
    """Whatever is written between the checkpoints: rows, place and samples are those of the buffer that went on."""
    draw, cpu = random.Random(1), torch.device("cpu")
    for capacity in (1, 7, 40):
        folder = tmp_path / str(capacity)
        replay = Replay(capacity, [0], cpu)
        files, written, states = ReplayFiles(folder, replay.parts[0]), 0, []
        for _ in range(25):
            for _ in range(draw.randrange(3)):
                count = draw.randint(1, min(6, capacity))
                rows = {"a": torch.arange(written, written + count), ("next", "b"): torch.rand(count, 2)}
                replay.store(TensorDict(rows, [count]))
                replay.draw(3, ["a"])
                written += count
            states.append(files.save())
            files.prune()
            for path in folder.glob("rows_*"):  # as earlier versions wrote them
                content = load_checkpoint(path)
                content["rows"]["index"] = torch.zeros(len(content["rows"]["a"]))
                save_checkpoint(path, {"rows": content["rows"]})
            for state in states[-2:]:
                other = Replay(capacity, [5], cpu)
                source = shutil.copytree(folder, tmp_path / "copy") if folder.exists() else folder
                ReplayFiles(folder, other.parts[0]).load(state, source)
                shutil.rmtree(tmp_path / "copy", ignore_errors=True)
                assert len(other.parts[0]) == min(capacity, state["written"])
                assert other.parts[0].written == state["written"]
            if written:
                first = max(0, written - capacity)
                assert other.parts[0].rows(first, written)["a"].tolist() == list(range(first, written))
                reads = ["a", ("next", "b")]
                assert (other.draw(20, reads) == replay.draw(20, reads)).all()
                other.store(TensorDict({"a": torch.tensor([-1]), ("next", "b"): torch.zeros(1, 2)}, [1]))
                assert int(other.tensors["a",][0, written % capacity]) == -1
        held = sum(len(load_checkpoint(path)["rows"]["a"]) for path in folder.iterdir())
        assert held <= written
        files.clear()
        assert not folder.exists()


def test_every_stage_is_tried():
    tried = {mark.args[1][k][0] for mark in test_killed_inside_a_write.pytestmark for k in range(len(mark.args[1]))}
    assert tried | {"in set-aside"} == set(killing.STAGES)
