"""python tests/benchmarks/bench_seeds.py [--seeds 3,10] [--threads 1,2] [--frames 50000] [--repeats 1] [override ...]

Many seeds in one program (``n_seeds=S``) against single runs: whole programs, interpreter start and evaluation included, without
pictures. Ratio: wall time of the program over S times the wall time of a single run with one thread, both of the same round.
Processor time is that of the process. Other words are overrides of train.py, such as method=in_loss.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def train(folder: Path, overrides: Sequence[str]) -> tuple[float, float, dict]:
    """Wall and processor seconds of a program of train.py, and where its time went (``time`` of summary.json)."""
    before, start = os.times(), time.perf_counter()
    command = [sys.executable, "train.py", *overrides, f"hydra.run.dir={folder}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    wall, after = time.perf_counter() - start, os.times()
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    summary = min(folder.rglob("summary.json"))
    return wall, processor, json.loads(summary.read_text())["time"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="3,10")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--frames", type=int, default=50_000)
    parser.add_argument("--repeats", type=int, default=1)
    options, overrides = parser.parse_known_args(arguments)
    shared = [f"collector.total_frames={options.frames}", "log.gif=false", "log.figures=false", *overrides]
    cases = [(1, 1)] + [(int(s), int(t)) for s in options.seeds.split(",") for t in options.threads.split(",")]
    found: dict[tuple[int, int], list] = {case: [] for case in cases}
    for _ in range(options.repeats):
        for seeds, threads in cases:
            with tempfile.TemporaryDirectory() as temporary:
                own = [f"n_seeds={seeds}", f"threads={threads}"]
                found[seeds, threads].append(train(Path(temporary) / "run", [*shared, *own]))
    print(f"### {options.frames} world-steps a seed, {' '.join(overrides) or 'default settings'}\n")
    print(
        "| seeds | threads | wall s | processor s | collect s | update s | evaluate s | ratio to single runs in turn |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for seeds, threads in cases:
        rounds = found[seeds, threads]
        ratios = [own[0] / (seeds * alone[0]) for own, alone in zip(rounds, found[1, 1], strict=True)]
        wall, processor = (statistics.median(entry[k] for entry in rounds) for k in (0, 1))
        parts = [statistics.median(entry[2][name] for entry in rounds) for name in ("collect", "update", "evaluate")]
        numbers = [*(f"{value:.1f}" for value in (wall, processor, *parts)), f"{statistics.median(ratios):.2f}"]
        print(f"| {seeds} | {threads} | {' | '.join(numbers)} |")


if __name__ == "__main__":
    main()
