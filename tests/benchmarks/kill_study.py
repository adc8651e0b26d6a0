"""Kills training runs at many instants, lets them go on, and compares them bit for bit with a run that nothing happened to.

``python tests/benchmarks/kill_study.py [--kills 60] [--seed 0] [--workers 0]``: half of the kills come at a random time, the
others inside a write (a checkpoint, replay rows, TensorBoard's file, summary.json, the moving aside of an earlier run). With
workers a third of the kills are theirs: the run goes on by itself.
"""

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the programs are run as files

from conf.versions import git_hash
from tests.killing import RUN, STAGES, differences, result, run, run_killed_after


def study(kills: int, seed: int, work: Path, workers: int = 0) -> tuple[Counter, Counter, list[str]]:
    """Kill until ``kills`` processes have died.

    Returns:
        Kills by instant, runs by the number of kills they went through, and what differed.
    """
    draw, died, runs, wrong = random.Random(seed), Counter(), Counter(), []
    start = time.monotonic()
    arguments = (*RUN, f"workers.count={workers}")
    code = run(work / "whole", arguments)
    length = time.monotonic() - start
    if code:
        raise RuntimeError(Path(f"{work / 'whole'}.log").read_text())
    whole = result(work / "whole")
    while sum(died.values()) < kills:
        folder, code, times = work / f"run_{sum(runs.values())}", -1, 0
        while code:  # killed again and again, until it ends
            lost = 0
            if draw.random() < 0.2:
                code, instant = run(folder, arguments), "none"
            elif workers and draw.random() < 1 / 3:
                code, instant = run(folder, arguments, stage="in a worker", count=draw.randint(1, 32)), "in a worker"
                lost = "was lost" in Path(f"{folder}.log").read_text()
                Path(f"{folder}.log").unlink()
            elif draw.random() < 0.5:
                code, instant = run_killed_after(folder, draw.uniform(0.05, length), arguments), "random time"
            else:
                instant = draw.choice(STAGES)
                once = instant in ("in summary", "in set-aside", "in clearing")  # comes once, if at all
                code = run(folder, arguments, stage=instant, count=1 if once else draw.choice((1, 1, 2, 3, 5, 8, 13)))
            if code > 0:
                raise RuntimeError(Path(f"{folder}.log").read_text())
            times += (code < 0) + lost
            died[instant] += (code < 0) + lost
        runs[times] += 1
        found = differences(whole, result(folder))
        wrong += [f"{folder.name}: {name}" for name in found]
        print(f"{folder.name}: {times} kills, {len(found)} differences", file=sys.stderr, flush=True)
        shutil.rmtree(folder)
    return +died, runs, wrong


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and print its tables; 1 if anything differed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=60, help="processes to kill")
    parser.add_argument("--seed", type=int, default=0, help="of the instants")
    parser.add_argument("--workers", type=int, default=0, help="processes that collect")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as work:
        died, runs, wrong = study(options.kills, options.seed, Path(work), options.workers)
    print(f"### Kill study, seed {options.seed}, {options.workers} workers, commit {git_hash()[:12]}\n")
    print("| killed | processes |\n| :-- | --: |")
    print("\n".join(f"| {instant} | {count} |" for instant, count in sorted(died.items())))
    print(f"\n{sum(died.values())} kills in {sum(runs.values())} runs (kills per run: ", end="")
    print(f"{', '.join(f'{k}: {count} runs' for k, count in sorted(runs.items()))}); {len(wrong)} differences.")
    print("\n".join(wrong))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
