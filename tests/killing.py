"""Runs of train.py in processes that are really killed, and what is compared with a run that was not."""

import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents import checkpoint, worker_pools
from agents.recorder import TrainingRecorder

RUN = (
    *("experiment=smoke", "env=moving_density", "env.horizon=20", "agent.n_steps=3", "agent.noise=ou", "device=cpu"),
    *("collector.num_envs=8", "collector.steps_per_batch=4", "collector.total_frames=1024", "buffer.capacity=500"),
    *("eval.interval_frames=256", "eval.num_envs=2", "eval.steps=5", "train.n_updates=2"),
    *("checkpoint.interval_episodes=0", "checkpoint.interval_frames=96", "log.figures=false"),
)
"""A run of seconds with everything that has a state: moving density, OU noise, n-step returns, a buffer that overflows. Of the
pictures in its event file the animations are left, which take a tenth of the figures' time."""

STAGES = (
    *("before", "half written", "before rename", "after rename", "after rows", "after checkpoint", "in set-aside"),
    *("in event file", "in clearing", "in summary"),
)
"""Instants inside a write at which a process can kill itself."""


def context():
    """Processes forked from a server that has imported train.py already: starting one takes a moment instead of seconds."""
    fork = multiprocessing.get_context("forkserver")
    fork.set_forkserver_preload(["train", "tests.killing"])
    return fork


def start(
    folder: Path,
    arguments: tuple[str, ...],
    stage: str | None = None,
    count: int = 1,
    limit: int = 0,
    by: int = signal.SIGKILL,
):
    """Start train.py in its own process, its output in ``<folder>.log``.

    Args:
        folder: the run's folder.
        arguments: overrides.
        stage: one of :data:`STAGES`, or "in training" (a batch): the process sends itself a signal there;
            "in a worker", "in a Ray worker": it sends one of its workers a signal at a batch.
        count: the how many-th time it gets there.
        limit: bytes that a file may have; 0 = no limit.
        by: the signal.
    """
    process = context().Process(target=_train, args=(str(folder), arguments, stage, count, limit, by))
    process.start()
    return process


def run(folder: Path, arguments: tuple[str, ...] = RUN, **options) -> int:
    """Run train.py to its end, or to where it kills itself; the exit code, negative for a signal."""
    process = start(folder, arguments, **options)
    process.join()
    return process.exitcode


def run_killed_after(folder: Path, seconds: float, arguments: tuple[str, ...] = RUN) -> int:
    """Run train.py and kill it ``seconds`` after it began; its exit code."""
    process = start(folder, arguments)
    end = time.monotonic() + seconds
    while process.is_alive() and time.monotonic() < end:
        time.sleep(0.005)
    if process.is_alive():
        os.kill(process.pid, signal.SIGKILL)
    process.join()
    return process.exitcode


def _train(
    folder: str, arguments: tuple[str, ...], stage: str | None, count: int, limit: int, by: int = signal.SIGKILL
) -> None:
    import train

    # a test that started workers in pytest's own process has started this one's server too, with these blocked
    signal.pthread_sigmask(signal.SIG_UNBLOCK, worker_pools.GROUP_SIGNALS)
    torch.set_num_threads(1)
    with Path(f"{folder}.log").open("a") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    if limit:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    if stage is not None:
        _arm(stage, count, by)
    sys.argv = ["train.py", *arguments, f"hydra.run.dir={folder}"]
    train.main()


def _arm(stage: str, count: int, by: int) -> None:
    """Make the process send itself a signal when it gets to ``stage`` for the ``count``-th time."""
    left = count

    def die(condition: bool = True, victim: Callable[[], int] = os.getpid) -> None:
        nonlocal left
        left -= condition
        if condition and not left:
            os.kill(victim(), by)

    save, replace = torch.save, Path.replace

    def patched_save(content, file, **options):
        mine = str(getattr(file, "name", "")).endswith(".tmp")  # copies of modules are made with torch.save too
        die(stage == "before" and mine)
        save(content, file, **options)
        if stage == "half written" and mine and left > 1:
            die()
        elif stage == "half written" and mine:
            file.truncate(file.tell() // 2)
            die()

    def patched_replace(path, target):
        mine = Path(target).suffix == ".pt"
        die(stage == "before rename" and mine)
        die(stage == "in summary" and Path(target).name == "summary.json")
        found = replace(path, target)
        die(stage == "after rename" and mine)
        die(stage == "after rows" and Path(target).name.startswith("rows_"))
        die(stage == "after checkpoint" and Path(target).name.startswith("frames_"))
        return found

    def patched_rmdir(path, rmdir=Path.rmdir):
        die(stage == "in clearing")
        rmdir(path)

    def patched_rename(path, target, rename=Path.rename):
        found = rename(path, target)
        die(stage == "in set-aside")
        return found

    def patched_update(self, counted, update=TrainingRecorder.update):
        die(stage == "in training")
        die(stage == "in a worker", _worker)
        die(stage == "in a Ray worker", _worker_of_ray)
        return update(self, counted)

    TrainingRecorder.update = patched_update
    torch.save, Path.replace, Path.rename, Path.rmdir = patched_save, patched_replace, patched_rename, patched_rmdir
    if stage == "in event file":
        from tensorboard.summary.writer.record_writer import RecordWriter

        write = RecordWriter.write

        def patched_write(self, data):
            if left <= 1:  # half a record reaches the disk
                self._writer.write(data[: len(data) // 2])
                self._writer.flush()
            die()
            write(self, data)

        RecordWriter.write = patched_write


def _worker() -> int:
    pid = multiprocessing.active_children()[0].pid
    assert pid is not None
    return pid


def _worker_of_ray() -> int:
    titles = {int(path.parent.name): path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline")}
    return max(pid for pid, title in titles.items() if title.startswith(b"ray::WorldsCollector"))


def result(folder: Path) -> dict:
    """All that two runs of the same seed must share: networks, optimisers, buffer-driven counters, curves, summary."""
    summary = json.loads((folder / "summary.json").read_text())
    for name in ("wall_time_s", "frames_per_second", "time"):
        summary.pop(name)
    content = checkpoint.load_checkpoint(checkpoint.latest_checkpoint(folder))
    content["parts"].pop("seconds")
    summary.pop("workers_lost", None)  # they change nothing, it is promised
    content["parts"]["env"].pop("lost", None)
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "histograms": 0, "images": 0}).Reload()
    tags = [tag for tag in sorted(events.Tags()["scalars"]) if not tag.startswith("time/")]
    curves: dict[str, list] = {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags}
    for tag in events.Tags()["histograms"]:
        curves[tag] = [(event.step, tuple(event.histogram_value.bucket)) for event in events.Histograms(tag)]
    for tag in events.Tags()["images"]:
        curves[tag] = [(event.step, event.encoded_image_string) for event in events.Images(tag)]
    best = checkpoint.load_checkpoint(folder / "checkpoints" / "best.pt")
    files = sorted(str(path.relative_to(folder)) for path in (folder / "checkpoints").rglob("*"))
    return {"summary": summary, "checkpoint": content, "curves": curves, "best": best, "files": files}


def differences(a, b, name: str = "") -> list[str]:
    """Names of the leaves in which two results differ, bit for bit."""
    if isinstance(a, dict) and isinstance(b, dict):
        missing = [f"{name}.{key}" for key in set(a) ^ set(b)]
        return missing + [d for key in a if key in b for d in differences(a[key], b[key], f"{name}.{key}")]
    if isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) == len(b):
        return [d for k, pair in enumerate(zip(a, b, strict=True)) for d in differences(*pair, f"{name}[{k}]")]
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return [] if a.dtype == b.dtype and torch.equal(a, b) else [name]
    return [] if a == b or (a != a and b != b) else [name]
