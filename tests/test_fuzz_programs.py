"""Random overrides of evaluate.py and report.py: valid, or refused with one clear message and nothing on disk.

``FUZZ_CASES=1000 pytest tests/test_fuzz_programs.py`` tries more (the study in docs/results.md).
"""

import os
import random
import sys

import pytest

import evaluate
import report
import train
from agents.controllers import CONTROLLERS
from conf.evaluate_schema import EvaluateConfig
from conf.manual import defaults
from conf.report_schema import ReportConfig
from tests.synthetic_runs import write_run
from tests.test_fuzz import ACCEPTED, STRANGE, check_refusal, one

COUNT = int(os.environ.get("FUZZ_CASES", "20"))
TRAINING = ("experiment=smoke", "collector.total_frames=64", "eval.interval_frames=0", "log.figures=false")


@pytest.fixture
def run(program):
    """Folder of a training run."""
    code, output = program(train.main, *TRAINING, "log.gif=false", "eval.steps=2", "hydra.run.dir=trained")
    assert code == 0, output
    return "trained"


def evaluations(draw):
    """What to evaluate, and up to three random overrides."""
    names = [name for name in defaults(EvaluateConfig) if name != "debug"]
    what = draw.choice(
        (
            "run=trained",
            "run=trained",
            f"controller={draw.choice([*CONTROLLERS])}",
            "controller=lloyd",
            f"run={draw.choice(STRANGE)}",
            f"controller={draw.choice(STRANGE)}",
        )
    )
    more = [one(draw, names, EvaluateConfig, ("env", "safety")) for _ in range(draw.choice((0, 1, 1, 2, 3)))]
    return [what, *more]


def reports(draw):
    """A sweep's folder, and up to three random overrides."""
    names = [name for name in defaults(ReportConfig) if name not in ("debug", "sweep")]
    what = draw.choice(("sweep=sweep",) * 5 + (f"sweep={draw.choice(STRANGE)}",))
    return [what, *(one(draw, names, ReportConfig, ()) for _ in range(draw.choice((1, 1, 2, 3))))]


def test_random_evaluations(program, run, tmp_path, monkeypatch, record_property):
    def stop(*_):
        sys.exit(ACCEPTED)

    monkeypatch.setattr(evaluate, "pick_device", stop)  # the first thing after validation
    draw, accepted, before = random.Random(0), 0, set(tmp_path.rglob("*"))
    for _ in range(COUNT):
        overrides = evaluations(draw)
        code, output = program(evaluate.main, *overrides)
        told = f"{overrides}\n{output}"
        assert "Traceback" not in output, told
        if code == ACCEPTED:
            accepted += 1
            before = set(tmp_path.rglob("*"))
        else:
            check_refusal(code, output, told)
            assert set(tmp_path.rglob("*")) == before, told
    record_property("accepted", accepted)
    assert 0 < accepted < COUNT


def test_random_reports(program, tmp_path, monkeypatch, record_property):
    def stop(*_):
        sys.exit(ACCEPTED)

    for seed in (0, 1):
        write_run(tmp_path / "sweep", seed, 0.2, method="certified")
        write_run(tmp_path / "sweep", seed, 0.3, controller="lloyd")
    monkeypatch.setattr(report, "compute_rows", stop)  # runs and methods are found and checked
    draw, accepted, before = random.Random(0), 0, set(tmp_path.rglob("*"))
    for _ in range(COUNT):
        overrides = reports(draw)
        code, output = program(report.main, *overrides)
        told = f"{overrides}\n{output}"
        assert "Traceback" not in output, told
        if code == ACCEPTED:
            accepted += 1
        else:
            check_refusal(code, output, told)
        assert set(tmp_path.rglob("*")) == before, told
    record_property("accepted", accepted)
    assert 0 < accepted < COUNT


def test_accepted_evaluations_run(program, run, tmp_path):
    """The first steps of a sample of those that validation lets pass."""
    small = ("num_envs=1", "steps=2", "pictures=false", "device=cpu", "compile=false", "resume=never", "threads=1")
    fixed, draw, ran, tried = {entry.split("=")[0] for entry in small}, random.Random(0), 0, 0
    while ran < max(3, COUNT // 25):
        tried += 1
        overrides = evaluations(draw)
        if any(entry.split("=")[0].lstrip("+~") in fixed | {"video"} for entry in overrides):
            continue
        code, output = program(evaluate.main, *overrides, *small)
        assert "Traceback" not in output, (overrides, output)
        assert code == 0 or output.startswith("error: "), (overrides, output)
        ran += code == 0
    assert tried < 20 * ran
