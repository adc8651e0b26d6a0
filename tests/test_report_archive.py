"""Archives of a sweep's results: the report on what was unpacked has the bytes of the one on the originals."""

import io
import os
import shutil
import tarfile
import time
from pathlib import Path

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

import report
from agents.report_runs import read_events
from agents.report_statistics import LOGGED
from tests.synthetic_runs import write_run

REPORTS = ("report.md", "table.csv", "runs.csv", "curves.csv")


def log(folder, seed, points, first=0.0, name="events.out.tfevents.1"):
    """Logs what a training logs, and more, with uneven times."""
    writer, generator = SummaryWriter(str(folder)), np.random.default_rng(seed)
    moment = time.time() + first
    for k in range(points):
        for tag in (*LOGGED.values(), "train/return", "loss/value"):
            moment += 0.5 * generator.random()
            if tag != "eval/coverage_cost" or k % 20 == 0:
                writer.add_scalar(tag, generator.random(), global_step=5000 * k + 100 * (first > 0), walltime=moment)
    writer.add_histogram("train/energy", generator.random(50), global_step=0)
    writer.close()
    (events,) = set(folder.glob("events*")) - set(folder.glob("events.out.tfevents.?"))
    events.rename(folder / name)  # files are read in the order of their names


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch):
    """The report's texts and tables are compared; drawing takes longer than all the rest."""
    monkeypatch.setattr(report, "save_figures", lambda *_: [])


@pytest.fixture
def sweep(tmp_path):
    """Two trained runs with long curves, one of them resumed, one without events, three controllers, and what is not kept."""
    sweep = tmp_path / "here" / "sweep"
    for seed in range(3):
        folder = write_run(sweep / "deep", seed, 1.0 + seed, "agent=ddpg", events=False)
        if seed < 2:
            log(folder, seed, 200)
        if seed == 1:
            log(folder, 7, 30, first=500.0, name="events.out.tfevents.2")  # again, and at other frames
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "best.pt").write_bytes(b"x" * 1000)
        (folder / ".hydra" / "overrides.yaml").write_text("- agent=ddpg\n")
        write_run(sweep, seed, 2.0, controller="coverage_cbf")
    write_run(folder, 0, 9.0, controller="lloyd", name="eval/default_20_0")
    write_run(sweep, 3, None, "agent=ddpg", name="killed")
    return sweep


def tree(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def make_report(program, sweep, *arguments):
    code, output = program(report.main, f"sweep={sweep}", "incomplete=true", "resamples=100", *arguments)
    assert code == 0, output
    return output


def test_the_report_on_what_was_unpacked_has_the_same_bytes(program, sweep, tmp_path):
    archive = tmp_path / "kept" / "runs.tar.xz"
    output = make_report(program, sweep, f"pack={archive}")
    assert "kept/runs.tar.xz: 6 runs," in output
    assert archive.stat().st_size < 2 * 15_000  # two runs have curves
    with tarfile.open(archive) as tar:
        names = [member.name for member in tar]
        assert {(member.mtime, member.uid, member.gid, member.uname, member.mode) for member in tar} == {
            (0, 0, 0, "", 0o644)
        }
    run = "deep/default_agent=ddpg_1"
    assert sorted(Path(name).relative_to(run).name for name in names if name.startswith(run)) == [
        "config.yaml",
        "events.out.tfevents." + str(int(read_events(sweep / run, LOGGED.values()).start)) + ".packed",
        "hydra.yaml",
        "overrides.yaml",
        "summary.json",
    ]
    assert not any("killed" in name or "checkpoints" in name for name in names)
    assert "deep/default_agent=ddpg_2/eval/default_20_0/eval.json" in names

    shutil.rmtree(sweep / "killed")  # an unfinished run is told, and not kept
    make_report(program, sweep)
    other, plain = tmp_path / "there" / "sweep", tmp_path / "tar" / "sweep"
    code, output = program(report.main, f"sweep={other}", f"unpack={archive}")
    assert code == 0, output
    assert "6 runs of" in output
    with tarfile.open(archive) as tar:
        tar.extractall(plain, filter="data")
    assert tree(plain) == tree(other)
    make_report(program, other)
    for name in REPORTS:
        assert (other / "report" / name).read_bytes() == (sweep / "report" / name).read_bytes()
    assert "no TensorBoard events in 1 runs" in (other / "report/report.md").read_text()
    assert len((other / "report/curves.csv").read_text().splitlines()) > 60
    logged = read_events(other / run, ["train/return", *LOGGED.values()])
    assert set(logged.points) == set(LOGGED.values())
    assert len(logged.points["eval/coverage_cost"]) == 10 + 2


def test_the_same_runs_give_the_same_bytes(program, sweep, tmp_path):
    make_report(program, sweep, f"pack={tmp_path}/a.tar.xz")
    for path in sweep.rglob("*"):
        os.utime(path, (1e9, 1e9))
        path.chmod(0o700)
    moved = tmp_path / "moved" / "sweep"
    shutil.copytree(sweep, moved)
    make_report(program, moved, f"pack={tmp_path}/b.tar.xz")
    assert (tmp_path / "a.tar.xz").read_bytes() == (tmp_path / "b.tar.xz").read_bytes()
    other = tmp_path / "unpacked" / "sweep"
    program(report.main, f"sweep={other}", f"unpack={tmp_path}/a.tar.xz")
    make_report(program, other, f"pack={tmp_path}/c.tar.xz")
    assert (tmp_path / "a.tar.xz").read_bytes() == (tmp_path / "c.tar.xz").read_bytes()


def test_what_is_there_wins(program, sweep, tmp_path):
    make_report(program, sweep, f"pack={tmp_path}/runs.tar.xz")
    mine = sweep / "deep" / "default_agent=ddpg_0"
    shutil.rmtree(sweep / "deep" / "default_agent=ddpg_1")
    (mine / "summary.json").unlink()  # trains at this moment
    before = tree(sweep)
    code, output = program(report.main, f"sweep={sweep}", f"unpack={tmp_path}/runs.tar.xz")
    assert code == 0, output
    assert "1 runs of" in output
    assert "5 were there already" in output
    after = tree(sweep)
    assert {path: after[path] for path in before} == before
    assert {path.parts[:2] for path in set(after) - set(before)} == {("deep", "default_agent=ddpg_1")}
    assert not list(sweep.glob(".unpack_*"))


def member(name, content=b"{}", **fields):
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    for key, value in fields.items():
        setattr(entry, key, value)
    return entry, content


RUN = member("run/.hydra/config.yaml")
LINK = {"type": tarfile.SYMTYPE, "linkname": "config.yaml", "size": 0}
BAD = {
    "leaves the folder": ([RUN, member("../outside/.hydra/config.yaml")], "OutsideDestinationError"),
    "link": ([RUN, member("run/.hydra/hydra.yaml", b"", **LINK)], "SpecialFileError"),
    "link to outside": ([RUN, member("run/a", b"", **LINK | {"linkname": "/etc/passwd"})], "AbsoluteLinkError"),
    "device": ([RUN, member("run/null", b"", type=tarfile.CHRTYPE)], "SpecialFileError"),
    "no runs": ([member("notes.txt")], "holds no runs"),
    "truncated": (lambda content: content[: len(content) // 2], "damaged"),
    "one bit": (lambda content: content[:-40] + bytes([content[-40] ^ 4]) + content[-39:], "damaged"),
    "no archive": (lambda content: b"world,method\n", "damaged"),
    "nothing": (lambda content: b"", "damaged"),
}


@pytest.mark.parametrize(("made", "expected"), BAD.values(), ids=BAD.keys())
def test_a_bad_archive_unpacks_nothing(program, tmp_path, made, expected):
    path = tmp_path / "bad.tar.xz"
    with tarfile.open(path, "w:xz") as tar:
        for entry, content in made if isinstance(made, list) else [RUN]:
            tar.addfile(entry, io.BytesIO(content))
    if callable(made):
        path.write_bytes(made(path.read_bytes()))
    before = set(tmp_path.rglob("*"))
    code, output = program(report.main, "sweep=new/sweep", "unpack=bad.tar.xz")
    assert code == 1
    assert "unpack=bad.tar.xz" in output
    assert expected in " ".join(output.split())
    assert "Traceback" not in output
    assert len(output.splitlines()) <= 8
    assert set(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["unpack=nowhere.tar.xz"], "unpack=nowhere.tar.xz: no such file"),
        (["pack=runs.zip"], "pack=runs.zip: the archive's name must end with .tar.xz"),
        (["pack=a.tar.xz", "unpack=b.tar.xz"], "unpack makes no report; give one of the two"),
        (["sweep=deep/run", "pack=a.tar.xz"], "is one run, not a folder of runs"),
    ],
)
def test_bad_options(program, tmp_path, arguments, expected):
    write_run(tmp_path / "deep", 0, 1.0, "agent=ddpg", name="run", events=False)
    code, output = program(report.main, "sweep=deep", "resamples=100", *arguments)
    assert code == 1
    assert expected in " ".join(output.split())
    assert "Traceback" not in output
    assert not list(tmp_path.rglob("*.xz"))
