"""Workers: what they collect, and that neither a dead worker nor a dead learner changes it."""

import dataclasses
import importlib.util
import json
import multiprocessing
import os
import signal

import pytest
import torch

import evaluate
import train
from agents import collection
from agents.collection import worker_task
from agents.networks import make_actor
from agents.training_config import Config
from agents.worker_pools import ProcessPool, WorkerLostError
from agents.workers import dumps, loads, weights_of
from envs import SurveillanceEnv
from tests.killing import RUN, differences, result, run

pytestmark = pytest.mark.xdist_group("workers")  # its fixtures are made once, not by every worker

SHORT = (*RUN, "log.gif=false", "collector.total_frames=512", "log.points=50")
TWO = (*SHORT, "workers.count=2")


def said(folder):
    return " ".join((folder.parent / f"{folder.name}.log").read_text().split())


def workers_lost(folder):
    return json.loads((folder / "summary.json").read_text())["workers_lost"]


def compared(folder):
    """What two runs must share that got the same transitions in other ways."""
    content = result(folder)
    for part in (content["summary"], content["checkpoint"], content["best"]):
        for name in ("config", "config_hash", "n_seeds"):
            part.pop(name, None)
    content["checkpoint"].pop("torch")  # the global stream, which nothing draws from after the start
    return content


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Result of a run with two workers that nothing happens to."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert run(folder, TWO) == 0, said(folder)
    assert workers_lost(folder) == 0
    return compared(folder)


def test_one_worker_collects_what_a_run_without_workers_does(tmp_path):
    for name, own in (("none", ()), ("one", ("workers.count=1", "workers.overlap=false"))):
        assert run(tmp_path / name, (*SHORT, *own)) == 0, said(tmp_path / name)
    none, one = compared(tmp_path / "none"), compared(tmp_path / "one")
    for content in (none, one):  # kept in another form
        for name in ("env", "noise"):
            content["checkpoint"]["parts"].pop(name)
    assert none["summary"]["frames"] == 512
    assert not differences(none, one)


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGSEGV])
def test_a_worker_that_dies_loses_nothing(tmp_path, whole, by):
    folder = tmp_path / "run"
    assert run(folder, TWO, stage="in a worker", count=7, by=by) == 0, said(folder)
    assert "was lost (its process died): started anew, it collects its last batch again." in said(folder)
    assert workers_lost(folder) == 1
    assert not differences(whole, compared(folder))


@pytest.mark.parametrize(
    ("stage", "count", "by"), [("in training", 5, 9), ("after checkpoint", 3, 9), ("in training", 6, 15)]
)
def test_a_learner_that_dies_goes_on_with_the_batch_that_was_on_its_way(tmp_path, whole, stage, count, by):
    folder = tmp_path / "run"
    assert run(folder, TWO, stage=stage, count=count, by=by) == (128 + by if by == 15 else -by), said(folder)
    assert run(folder, TWO) == 0, said(folder)
    assert "going on from" in said(folder)
    assert not differences(whole, compared(folder))


def test_each_seed_of_a_program_with_workers_is_the_run_that_it_would_be_alone(tmp_path, whole):
    assert run(tmp_path / "program", (*TWO, "n_seeds=2")) == 0, said(tmp_path / "program")
    assert not differences(whole, compared(tmp_path / "program" / "seed0"))


def test_a_run_of_a_cluster_is_evaluated_without_one(program, tmp_path, monkeypatch):
    assert program(train.main, "experiment=smoke", "log.gif=false", "hydra.run.dir=run")[0] == 0
    config = tmp_path / "run" / ".hydra" / "config.yaml"
    config.write_text(config.read_text().replace("backend: processes", "backend: ray").replace("count: 0", "count: 3"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    code, output = program(evaluate.main, "run=run", "steps=3", "num_envs=2", "pictures=false")
    assert code == 0, output


def test_a_worker_heeds_no_signal_of_the_group_and_tells_its_own_errors():
    config = Config()
    config.collector.num_envs = config.workers.count = 1
    good = worker_task(config, [0], 0, torch.device("cpu"))
    actor = make_actor(SurveillanceEnv(config.env).n_observation, config.env, config.agent)
    weights = dumps([weights_of(actor)])
    pool = ProcessPool([good, dataclasses.replace(good, device="nowhere")])
    try:
        for k in range(2):
            pool.start(k, None)
            pool.request(k, weights)
        (_, batch), _ = loads(pool.answer(0))
        assert batch["agents", "action"].shape == (1, 1, 3, 2)
        for child in multiprocessing.active_children():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2):
                os.kill(child.pid, number)
        pool.request(0, weights)
        assert pool.answer(0)
        with pytest.raises(RuntimeError, match="nowhere"):
            pool.answer(1)
    finally:
        pool.close()


class FailingPool:
    """Workers that die whatever one asks of them."""

    def start(self, k, states): ...

    def request(self, k, weights): ...

    def answer(self, k):
        raise WorkerLostError("no power")

    def close(self): ...


def test_a_worker_that_always_dies_ends_the_run(program, monkeypatch):
    monkeypatch.setattr(collection, "ProcessPool", lambda tasks: FailingPool())
    code, output = program(train.main, *TWO)
    assert code == 1
    assert output.count("was lost (no power)") == collection.MOST_LOSSES
    assert "error: worker 0 died 3 times at the same batch. Out of memory? Take fewer workers.count" in output
    assert "Traceback" not in output


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("workers.count=3",), "collector.num_envs=8 is not a multiple of workers.count=3"),
        (("workers.count=-1",), "workers.count=-1 is out of range"),
        (("workers.backend=mpi",), "workers.backend='mpi'"),
        (("workers.gpus=1",), "workers.gpus=1 is for workers.backend=ray"),
        (("workers.ray_address=auto",), "workers.ray_address=auto is for workers.backend=ray"),
    ],
)
def test_settings_that_make_no_sense(program, tmp_path, overrides, message):
    code, output = program(train.main, *SHORT, *overrides)
    assert code == 1
    assert message in " ".join(output.split())
    assert not list(tmp_path.iterdir())


def test_a_ray_cluster_that_cannot_be_used(program, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    code, output = program(train.main, *TWO, "workers.backend=ray")
    assert code == 1
    assert "workers.backend=ray needs the package ray, which is not installed: pip install" in " ".join(output.split())
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    for address, message in (
        ("cluster", "workers.ray_address=cluster is no address of a Ray cluster: auto or <host>:<port>"),
        ("127.0.0.1:1", "the Ray cluster at 127.0.0.1:1 does not answer"),
    ):
        code, output = program(train.main, *TWO, "workers.backend=ray", f"workers.ray_address={address}")
        assert code == 1
        assert message in " ".join(output.split())
    assert not list(tmp_path.iterdir())


def test_workers_of_a_ray_cluster(tmp_path, whole):
    pytest.importorskip("ray", reason="needs the extra ray")
    folder, arguments = tmp_path / "run", (*TWO, "workers.backend=ray")
    assert run(folder, arguments, stage="in training", count=5) == -signal.SIGKILL, said(folder)
    assert run(folder, arguments, stage="in training", count=4, by=signal.SIGTERM) == 143, said(folder)
    assert "stopped by SIGTERM" in said(folder)
    assert run(folder, arguments, stage="in a Ray worker", count=3) == 0, said(folder)
    assert "started anew, it collects its last batch again." in said(folder)
    assert workers_lost(folder) == 1
    assert not differences(whole, compared(folder))
