"""Sweeps on every launcher: what is refused before they start, what they leave alone, what they say of runs that fail."""

import contextlib
import json
import os
import pickle
import signal
import socket
import sys
import threading
import time
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

import evaluate
import report
import train
from agents import ray_cluster
from agents.interruption import STOP_FILE, InterruptedRunError, StopSignals
from conf import launching
from conf.job_log import FailedRunError
from conf.run_folder import BusyFolderError, only_writer
from conf.schema import register
from tests import fake_slurm

ROOT = Path(__file__).resolve().parents[1]
TINY = (
    "experiment=smoke",
    "collector.total_frames=256",
    "eval.interval_frames=0",
    "eval.steps=5",
    "log.gif=false",
    "log.figures=false",
)


def launcher_settings(option, *overrides):
    register()
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("config", overrides=[f"hydra/launcher={option}", *overrides], return_hydra_config=True)
    OmegaConf.resolve(cfg.hydra.launcher)
    return cfg.hydra.launcher


def prepare(folder):
    """A finished run, and one that cannot write its files, among four."""
    (folder / "0.9").mkdir(parents=True)
    (folder / "0.9" / "summary.json").write_text('{"eval": {"coverage_cost": 0.5}}')
    (folder / "0.7" / "certificate.tmp").mkdir(parents=True)  # where the run wants to write a file
    return (*TINY, "hydra.sweep.dir=sweep", "hydra.sweep.subdir='${agent.gamma}'", "agent.gamma=0.7,0.8,0.9,0.6")


def check_sweep(folder, code, output):
    """What every launcher makes of :func:`prepare`."""
    assert code == 1
    assert "0.9 holds a finished run: nothing to do" in output
    assert [path.name for path in (folder / "0.9").iterdir()] == ["summary.json"]
    for name in ("0.8", "0.6"):
        summary = json.loads((folder / name / "summary.json").read_text())
        assert (summary["frames"], summary["threads"]) == (256, 1)
        assert "frame/s" in (folder / name / "run.log").read_text()
    assert "error: 1 of the sweep's runs failed" in output
    line = next(line for line in output.splitlines() if "agent.gamma=0.7:" in line)
    assert "Is a directory" in line
    assert str(folder / "0.7" / "run.log") in line
    assert "Traceback" in (folder / "0.7" / "run.log").read_text()
    assert json.loads((folder / "0.7" / "failed.json").read_text())["overrides"][-1] == "agent.gamma=0.7"
    assert "frame/s" not in output  # no progress bars on top of each other
    assert f"ended: agent.gamma=0.7 failed ({folder / '0.7' / 'run.log'})" in output
    assert all(f"ended: agent.gamma={name} complete, J = " in output for name in ("0.8", "0.6"))
    assert all(f"{k} of 3 ended: " in output for k in (1, 2, 3))
    assert "3 of 4 runs complete in sweep (each run's output: run.log); python report.py sweep=sweep\n" in output
    assert "Traceback" not in output
    assert not list(folder.glob(".stop_*"))


def test_local(program, tmp_path):
    code, output = program(train.main, "-m", *prepare(tmp_path / "sweep"), "hydra/launcher=local")
    check_sweep(tmp_path / "sweep", code, output)
    code, output = program(report.main, "sweep=sweep", "resamples=100", "incomplete=true")
    assert code == 0, output


def test_local_evaluations_end_with_what_reads_them(program, tmp_path):
    code, output = program(train.main, *TINY, "hydra.run.dir=run")
    assert code == 0, output
    short = ("-m", "hydra/launcher=local", "steps=3", "num_envs=2", "pictures=false", "seed=0,1")
    code, output = program(evaluate.main, *short, f"run={tmp_path}/run")  # its processes may be the last test's
    assert code == 0, output
    assert "1 of 2 ended: seed=" in output
    assert "2 of 2 runs complete in run/eval (each run's output: run.log)\n" in output  # no run of their own
    code, output = program(evaluate.main, *short, "controller=lloyd", f"folder={tmp_path}/there")
    assert "2 of 2 runs complete in there (each run's output: run.log); python report.py sweep=there\n" in output


@pytest.mark.slow
def test_submitit_on_this_machine(program, tmp_path):
    pytest.importorskip("submitit", reason="needs the extra slurm")
    code, output = program(train.main, "-m", *prepare(tmp_path / "sweep"), "hydra/launcher=submitit_local")
    check_sweep(tmp_path / "sweep", code, output)


def preempt(folder, frames):
    """Send SIGUSR2, as Slurm does before a job's time is up, to the process that trains in ``folder``."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        time.sleep(0.2)
        log = folder / "run.log"
        lock = folder / ".hydra" / "lock"
        if not log.is_file() or not lock.is_file() or "frame/s" not in log.read_text():
            continue
        for process in Path("/proc").glob("[0-9]*/fd/*"):
            with contextlib.suppress(OSError):
                if process.resolve() == lock.resolve():
                    os.kill(int(process.parts[2]), signal.SIGUSR2)
                    return


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="finds the job's process in /proc")
@pytest.mark.parametrize("cluster", ["slurm", "submitit_local"])
def test_a_job_whose_time_is_up_is_queued_again_and_goes_on(program, tmp_path, monkeypatch, cluster):
    pytest.importorskip("submitit", reason="needs the extra slurm")
    if cluster == "slurm":
        fake_slurm.install(tmp_path / "slurm")
        monkeypatch.setenv("PATH", str(tmp_path / "slurm"), prepend=os.pathsep)
    frames = 20_000
    runs = (*TINY, f"collector.total_frames={frames}", "collector.num_envs=50", "eval.interval_frames=0", "seed=0,1")
    sender = threading.Thread(target=preempt, args=(tmp_path / "sweep" / "0", frames))
    sender.start()
    code, output = program(
        train.main, "-m", *runs, f"hydra/launcher={cluster}", "hydra.sweep.dir=sweep", "hydra.sweep.subdir='${seed}'"
    )
    sender.join()
    assert code == 0, output
    log = (tmp_path / "sweep" / "0" / "run.log").read_text()
    assert "going on from" in log, log
    for seed in ("0", "1"):
        assert json.loads((tmp_path / "sweep" / seed / "summary.json").read_text())["frames"] == frames
    assert "going on from" not in (tmp_path / "sweep" / "1" / "run.log").read_text()
    assert "Requeued job" in log
    if cluster == "slurm":
        script = (tmp_path / "slurm" / "script").read_text()
        assert "#SBATCH --array=0-1" in script
        assert "#SBATCH --requeue" in script
        assert (tmp_path / "slurm" / "requeued_4242_0").exists()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="finds the run's process in /proc")
def test_a_process_that_is_killed_takes_no_other_run_with_it(program, tmp_path, monkeypatch):
    monkeypatch.setattr(signal, "SIGUSR2", signal.SIGKILL)  # what preempt() sends
    runs = (*TINY, "collector.total_frames=10000", "collector.num_envs=50", "seed=0,1,2")
    sender = threading.Thread(target=preempt, args=(tmp_path / "sweep" / "0", 0))
    sender.start()
    code, output = program(
        train.main, "-m", *runs, "hydra/launcher=local", "hydra.sweep.dir=sweep", "hydra.sweep.subdir='${seed}'"
    )
    sender.join()
    assert code == 0, output
    assert "a run's process died" in output
    for seed in ("0", "1", "2"):
        assert json.loads((tmp_path / "sweep" / seed / "summary.json").read_text())["frames"] == 10_000


@pytest.mark.slow
def test_a_study_goes_on(program, tmp_path):
    optuna = pytest.importorskip("optuna", reason="needs the extra optuna")
    tiny = (
        "experiment=tune",
        "train=smoke",
        "collector.total_frames=256",
        "eval.interval_frames=0",
        "hydra.sweeper.params={agent.actor_lr:'choice(1e-3,5)',agent.tau:'interval(0.001,0.05)'}",
    )
    code, output = program(train.main, "-m", *tiny, "hydra.sweeper.n_trials=4")
    assert code == 1, output  # learning rates of 5 are refused; the study went on
    assert "agent.actor_lr=5" in output.split("of the sweep's runs failed")[1]
    storage = f"sqlite:///{tmp_path}/runs/tune/study.db"
    (summary,) = optuna.get_all_study_summaries(storage)

    def load():
        return optuna.load_study(study_name=summary.study_name, storage=storage)

    study = load()
    assert len(study.trials) == 4
    values = [trial.value for trial in study.trials if trial.state.name == "COMPLETE"]
    assert 0 < len(values) < 4
    costs = [json.loads(path.read_text())["eval"]["coverage_cost"] for path in tmp_path.rglob("summary.json")]
    assert sorted(costs) == pytest.approx(sorted(values))

    # a trial that was killed is made again, then the study ends where it would have
    killed = study.ask({"agent.actor_lr": optuna.distributions.CategoricalDistribution([0.001, 5])})
    assert killed.number == 4
    _, output = program(train.main, "-m", *tiny, "hydra.sweeper.n_trials=6")
    states = [trial.state.name for trial in load().trials]
    assert states[4] == "FAIL"
    assert load().trials[5].params["agent.actor_lr"] == killed.params["agent.actor_lr"]
    assert len(states) == 7
    assert "RUNNING" not in states
    program(train.main, "-m", *tiny, "hydra.sweeper.n_trials=6")
    assert len(load().trials) == 7
    program(train.main, "-m", *tiny, "hydra.sweeper.n_trials=1", "agent.gamma=0.9")  # other settings, another study
    assert len(optuna.get_all_study_summaries(storage)) == 2


@pytest.mark.slow
def test_ray_on_this_machine(program, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_ray_launcher", reason="needs the extra ray")
    import ray

    code, output = program(train.main, "-m", *prepare(tmp_path / "sweep"), "hydra/launcher=ray_local")
    ray.shutdown()
    check_sweep(tmp_path / "sweep", code, output)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("seed=0,1,0", "hydra/launcher=local"), "seed=0,1,0 lists 0 more than once"),
        (("agent=maddpg,ddpg,maddpg",), "agent=maddpg,ddpg,maddpg lists maddpg more than once"),
        (("device=cpu,auto",), "'device=cpu' and 'device=auto' are the same run"),
        (
            ("seed=0,1", "hydra.sweep.subdir=here"),
            "'seed=0' and 'seed=1' are the same run, or would write the same folder",
        ),
    ],
)
def test_two_runs_in_one_folder_are_refused(program, tmp_path, overrides, message):
    code, output = program(train.main, "-m", *TINY, *overrides)
    assert code == 1
    assert message in " ".join(output.split())
    assert "Nothing was started" in " ".join(output.split())
    assert len(output.strip().splitlines()) <= 8
    assert not list(tmp_path.iterdir())


def test_evaluations_in_one_folder_are_refused(program, tmp_path):
    code, output = program(evaluate.main, "-m", "controller=lloyd", "steps=3", "num_envs=2", "device=cpu,auto")
    assert code == 1
    assert "would write the same folder" in " ".join(output.split())
    assert not list(tmp_path.iterdir())


def test_a_folder_of_another_configuration_is_refused(program, tmp_path):
    folder = tmp_path / "sweep" / "7"
    (folder / ".hydra").mkdir(parents=True)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        OmegaConf.save(compose("config", overrides=[*TINY, "agent.gamma=0.5", "seed=7"]), folder / ".hydra/config.yaml")
    (folder / "summary.json").write_text("{}")
    before = sorted((path, path.stat().st_mtime) for path in tmp_path.rglob("*"))
    for arguments in (
        ("-m", "hydra.sweep.dir=sweep", "hydra.sweep.subdir='${seed}'", "seed=6,7"),
        ("-m", "hydra.sweep.dir=sweep", "hydra.sweep.subdir='${seed}'", "seed=6,7", "resume=never"),
        ("hydra.run.dir=sweep/7", "seed=7"),
    ):
        code, output = program(train.main, *arguments, *TINY)
        assert code == 1
        assert "sweep/7 holds a run of another configuration" in " ".join(output.split())
        assert sorted((path, path.stat().st_mtime) for path in tmp_path.rglob("*")) == before
    code, output = program(train.main, *TINY, "hydra.run.dir=sweep/7", "seed=7", "agent.gamma=0.5")
    assert code == 0
    assert "finished run: nothing to do" in output


def test_bad_runs_in_several_batches_are_all_named(program, tmp_path):
    code, output = program(train.main, "-m", *TINY, "agent.gamma=2,3,4", "hydra.sweeper.max_batch_size=1")
    assert code == 1
    assert "3 of the sweep's runs failed" in output
    assert all(f"agent.gamma={value}.0 is out of range" in output for value in (2, 3, 4))
    assert not list(tmp_path.iterdir())  # no run, no folder
    (tmp_path / "runs" / "smoke").mkdir(parents=True)
    program(train.main, "-m", *TINY, "agent.gamma=2,3")
    assert [path.name for path in tmp_path.rglob("*.*")] == ["multirun.yaml"]  # of a folder that was there


@pytest.mark.parametrize(
    ("plugin", "option", "command"),
    [
        ("joblib", "hydra/launcher=local", "pip install -c constraints.txt hydra-joblib-launcher"),
        ("submitit_slurm", "hydra/launcher=slurm", "pip install -c constraints.txt -e '.[slurm]'"),
        ("ray", "hydra/launcher=ray_local", "pip install -c constraints-extras.txt -e '.[ray]'"),
        ("optuna", "experiment=tune", "pip install -c constraints-extras.txt -e '.[optuna]'"),
    ],
)
def test_a_missing_package_is_named(program, tmp_path, monkeypatch, plugin, option, command):
    for group in ("launcher", "sweeper"):
        monkeypatch.delitem(ConfigStore.instance().repo["hydra"][group], f"{plugin}.yaml", raising=False)
    code, output = program(train.main, "-m", *(TINY if plugin != "optuna" else ()), option, "seed=0,1")
    assert code == 1
    assert command in " ".join(output.split())
    assert len(output.strip().splitlines()) <= 8
    assert not list(tmp_path.iterdir())


def test_a_machine_without_slurm_is_named(program, tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason="needs the extra slurm")
    monkeypatch.setenv("PATH", str(tmp_path))
    code, output = program(train.main, "-m", *TINY, "hydra/launcher=slurm", "seed=0,1")
    assert code == 1
    assert "hydra/launcher=slurm: no sbatch and no srun on this machine" in output
    assert not list(tmp_path.iterdir())


def test_a_ray_cluster_that_does_not_answer_is_named(monkeypatch, tmp_path):
    def settings(address):
        return OmegaConf.create({"_target_": "x.RayLauncher", "ray": {"init": {"address": address}}})

    launching.check_launcher("ray_local", settings("local"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody listens
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(launching.SweepError, match=f"the Ray cluster at {address} does not answer"):
            launching.check_launcher("ray_local", settings(address))
        taken.listen()  # somebody does, who is no Ray
        monkeypatch.setattr(ray_cluster, "REACH_SECONDS", 0.1)
        waits = tmp_path / "waits"
        waits.write_text("#!/bin/sh\nexec sleep 20\n")
        waits.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(waits))
        with pytest.raises(launching.SweepError, match="does not answer"):
            launching.check_launcher("ray_local", settings(address))


def test_runs_at_once(monkeypatch):
    monkeypatch.setattr(launching, "cores", lambda: 8)
    for threads, runs in ((1, 8), (2, 4), (3, 2), (16, 1), (0, 1)):
        assert launcher_settings("local", f"threads={threads}").n_jobs == runs
    assert launcher_settings("local", "threads=2", "workers.count=1").n_jobs == 2
    assert launcher_settings("slurm", "threads=2", "workers.count=3").cpus_per_task == 8


def test_slurm_asks_for_what_was_given(monkeypatch, tmp_path):
    submitit = pytest.importorskip("submitit", reason="needs the extra slurm")
    settings = launcher_settings(
        "slurm", "hydra.launcher.partition=gpu", "hydra.launcher.gpus_per_node=1", "threads=4", "hydra.sweep.dir=sweep"
    )
    srun = tmp_path / "srun"
    srun.write_text("#!/bin/sh\n")
    srun.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    executor = submitit.SlurmExecutor(folder="jobs", max_num_timeout=settings.max_num_timeout)
    shared = ("timeout_min", "cpus_per_task", "gpus_per_node", "mem_gb")
    names = {"timeout_min": "time", "mem_gb": "mem"}
    own = ("partition", "array_parallelism", "signal_delay_s", "additional_parameters")
    given = executor._convert_parameters({name: settings[name] for name in shared}) | {n: settings[n] for n in own}
    assert set(names.values()) <= set(given)
    executor.update_parameters(**OmegaConf.to_container(OmegaConf.create(given)))
    lines = executor._make_submission_file_text("run", "0").splitlines()
    for line in (
        "time=240",
        "cpus-per-task=4",
        "gpus-per-node=1",
        "mem=8GB",
        "partition=gpu",
        "signal=USR2@120",
        "requeue",
    ):
        assert f"#SBATCH --{line}" in lines


def test_the_extras_have_the_versions_of_the_rest():
    def versions(name):
        lines = (ROOT / name).read_text().splitlines()
        return dict(line.split("==") for line in lines if not line.startswith("#"))

    usual, extras = versions("constraints.txt"), versions("constraints-extras.txt")
    assert set(usual) < set(extras)
    assert {name for name in usual if usual[name] != extras[name]} == {"cloudpickle", "joblib", "python-dateutil"}


def test_one_process_per_folder(tmp_path):
    (tmp_path / ".hydra").mkdir()
    with (
        only_writer(tmp_path),
        pytest.raises(BusyFolderError, match="written by another process"),
        only_writer(tmp_path),
    ):
        pass
    with only_writer(tmp_path):
        pass


def test_errors_come_back_from_other_processes():
    for error in (InterruptedRunError(signal.SIGTERM, "stopped"), FailedRunError("text", "ValueError", True)):
        copy = pickle.loads(pickle.dumps(error))
        assert (str(copy), copy.args) == (str(error), error.args)
    assert str(FailedRunError("text", "TypeError", False)) == "TypeError: text"


def test_a_batch_systems_handler_follows_the_checkpoint():
    seen, before = [], signal.signal(signal.SIGUSR2, lambda *_: seen.append("requeue"))
    try:
        with StopSignals() as stop:
            os.kill(os.getpid(), signal.SIGUSR2)
            assert stop.received == signal.SIGUSR2
            assert not seen  # first the checkpoint
            stop.check("after it")
            assert seen == ["requeue"]
            assert stop.received is None  # the handler came back: the run goes on ...
            os.kill(os.getpid(), signal.SIGTERM)
            with pytest.raises(InterruptedRunError, match="SIGTERM"):  # ... until it is stopped
                stop.check("later")
    finally:
        signal.signal(signal.SIGUSR2, before)


def test_a_sweep_stops_its_runs_by_a_file(monkeypatch, tmp_path):
    monkeypatch.setenv(STOP_FILE, str(tmp_path / "stop"))
    with StopSignals() as stop:
        stop._looked = 0.0
        assert stop.received is None
        (tmp_path / "stop").touch()
        stop._looked = 0.0
        assert stop.received == signal.SIGTERM
        with pytest.raises(InterruptedRunError):
            stop.check("here")
