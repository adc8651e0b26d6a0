"""python tests/benchmarks/bench_gpu.py [--batches 512,4096] [--compiled 4096] [--robots 3] [--device cuda]

A certified step and the filter alone on a GPU: selecting what needs work, at fixed sizes, and at fixed sizes as one compiled graph
(for the batches of ``--compiled``; most of a minute each). Medians of three rounds, the device waited for at the end of each;
"first" is what the first four steps take, compilation included.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence

import harness
import torch

from agents.pipeline import use_threads
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

ROUNDS, WARM_UP = 3, 4


def wait(device: str) -> None:
    """Wait for the device."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize()


def median_ms(run: Callable[[int], object], repeats: int, device: str) -> float:
    """Milliseconds of one call, median of the rounds."""
    rounds = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for k in range(repeats):
            run(k)
        wait(device)
        rounds.append((time.perf_counter() - start) / repeats * 1e3)
    return statistics.median(rounds)


@torch.no_grad()
def measure(batch: int, n: int, device: str, repeats: int, *, fixed_sizes: bool, compiled: bool) -> list:
    """A row of the table."""
    world = SurveillanceConfig(n_agents=n, on_violation="continue")
    env = SurveillanceEnv(world, batch, device, seed=1, fixed_sizes=fixed_sizes, compile_functions=compiled)
    policy = SafetyFilter(SafetyConfig(), world, fixed_sizes=fixed_sizes, compile=compiled)
    state = [env.reset()]
    actions = [world.max_speed * torch.randn(batch, n, 2, device=device) for _ in range(4)]

    def step(k: int) -> None:
        state[0] = env.step(policy(state[0].set(keys.NOMINAL_ACTION, actions[k % 4])))["next"]

    start = time.perf_counter()
    for k in range(WARM_UP):
        step(k)
    wait(device)
    first = time.perf_counter() - start
    whole = median_ms(step, repeats, device)
    td = state[0].clone()
    alone = median_ms(lambda k: policy(td.set(keys.NOMINAL_ACTION, actions[k % 4])), repeats, device)
    name = "fixed sizes, compiled" if compiled else "fixed sizes" if fixed_sizes else "selecting"
    return [batch, n, name, whole, 1e3 * batch / whole, alone, first]


def rows(options) -> Iterator[list]:
    """All rows."""
    numbers = {
        name: [int(x) for x in getattr(options, name).split(",") if x] for name in ("batches", "compiled", "robots")
    }
    for n in numbers["robots"]:
        for batch in numbers["batches"]:
            kinds = [(False, False), (True, False), *([(True, True)] if batch in numbers["compiled"] else [])]
            for fixed_sizes, compiled in kinds:
                yield measure(batch, n, options.device, options.repeats, fixed_sizes=fixed_sizes, compiled=compiled)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", default="512,4096,32768,65536")
    parser.add_argument("--compiled", default="4096")
    parser.add_argument("--robots", default="3")
    parser.add_argument("--repeats", type=int, default=20, help="steps of a round, default 20")
    parser.add_argument("--device", default="cuda")
    options = parser.parse_args(arguments)
    use_threads(1)
    print(f"{harness.machine(options.device)}\n")
    header = ("B", "N", "filter", "step, ms", "world-steps/s", "filter alone, ms", "first, s")
    harness.table("A certified step", header, rows(options))


if __name__ == "__main__":
    main()
