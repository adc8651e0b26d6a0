"""python tests/benchmarks/bench_workers.py [--worlds 250,1000,4000] [--workers 1,2] [--seconds 5] [--repeats 3] [override ...]

Collection by workers against collection in the learner's process: the loop of train.py without evaluation, logging and
checkpoints, the contestants in turn on the same machine, medians of the rounds. Ratio: frames/s over those of no workers.
"wait" is the time that the learner waits for batches, "learn" all else that it does. Other words are overrides of train.py.

While the learner learns, workers collect for nothing: one of them saves at most the shorter of the two. Two or more pay
where collecting takes longer than learning, and there are cores for them.
"""

import argparse
import logging
import statistics
import time
from collections.abc import Sequence

import harness
from bench_training import Contestant, composed, ours

from agents.pipeline import use_threads


def measure(contestant: Contestant, batches: int) -> tuple[float, float]:
    """Seconds per batch of waiting and of learning; a batch before is not counted, which may have been collected already."""
    contestant.run(1)
    spent = contestant.run(batches)
    wait = spent.pop("collect") * contestant.frames
    return wait, sum(spent.values()) * contestant.frames


def table(worlds: int, options: argparse.Namespace, overrides: Sequence[str]) -> None:
    """Print the rows of one size."""
    sizes = (f"collector.num_envs={worlds}", f"collector.total_frames={10**6 * worlds}", "collector.steps_per_batch=1")
    names: dict[str, tuple[str, ...]] = {"no workers": ()}
    for count in options.workers.split(","):
        names[f"{count}, in turn"] = (f"workers.count={count}", "workers.overlap=false")
        names[f"{count}, overlap"] = (f"workers.count={count}", "workers.overlap=true")
    contestants = {name: ours(composed(*sizes, *overrides, *own))[0] for name, own in names.items()}
    start = time.perf_counter()
    contestants["no workers"].run(5)
    batches = max(3, round(options.seconds / (time.perf_counter() - start) * 5))
    rounds: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for k in range(options.repeats + 1):
        for name, contestant in contestants.items():
            found = measure(contestant, batches)
            if k:  # the first is the warm-up
                rounds[name].append(found)
    base = statistics.median(sum(own) for own in rounds["no workers"])
    for name, own in rounds.items():
        wait, learn = (statistics.median(entry[k] for entry in own) for k in (0, 1))
        whole = statistics.median(sum(entry) for entry in own)
        numbers = (f"{1e3 * wait:.1f}", f"{1e3 * learn:.1f}", f"{worlds / whole:,.0f}", f"{base / whole:.2f}")
        print(f"| {worlds} | {name} | {' | '.join(numbers)} |", flush=True)
    for contestant in contestants.values():
        contestant.batches.close()  # pyright: ignore[reportAttributeAccessIssue]  a generator: ends its workers


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default="250,1000,4000")
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--repeats", type=int, default=3)
    options, overrides = parser.parse_known_args(arguments)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    use_threads(1)
    print(f"### {' '.join(overrides) or 'default settings'}, {harness.machine('cpu')}\n")
    print("| worlds | workers | wait ms | learn ms | frames/s | ratio |\n|---|---|---|---|---|---|")
    for worlds in options.worlds.split(","):
        table(int(worlds), options, overrides)


if __name__ == "__main__":
    main()
