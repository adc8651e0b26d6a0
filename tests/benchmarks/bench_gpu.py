"""python tests/benchmarks/bench_gpu.py [--batches 512,4096] [--compiled 4096] [--robots 3] [--device cuda]

A certified step and the filter alone on a GPU: selecting what needs work, at fixed sizes, by CUDA graphs, and compiled without
graphs (for the batches of ``--compiled``; most of a minute each). Medians of three rounds, the device waited for at the end of
each; "first" is what the first five steps take, compilation and recording included.
"""

import statistics
from collections.abc import Callable, Iterator, Sequence

import harness
import torch

from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

ROUNDS, WARM_UP = 3, 5


def median_ms(run: Callable[[int], object], repeats: int, device: str) -> float:
    """Milliseconds of one call, median of the rounds."""
    rounds = []
    for _ in range(ROUNDS):
        start = harness.clock(device)
        for k in range(repeats):
            run(k)
        rounds.append((harness.clock(device) - start) / repeats * 1e3)
    return statistics.median(rounds)


@torch.no_grad()
def measure(batch: int, n: int, device: str, repeats: int, name: str) -> list:
    """A row of the table."""
    compiled, sizes = "compiled" in name, {"fixed_sizes": name != "selecting", "cuda_graphs": "graphs" in name}
    world = SurveillanceConfig(n_agents=n, on_violation="continue")  # the host need not ask whether a world is done
    env = SurveillanceEnv(world, batch, device, seed=1, compile_functions=compiled, **sizes)
    policy = SafetyFilter(SafetyConfig(), world, compile=compiled, **sizes)
    state = [env.reset()]
    actions = [world.max_speed * torch.randn(batch, n, 2, device=device) for _ in range(4)]

    def step(k: int) -> None:
        state[0] = env.step(policy(state[0].set(keys.NOMINAL_ACTION, actions[k % 4])))["next"]

    start = harness.clock(device)
    for k in range(WARM_UP):
        step(k)
    first = harness.clock(device) - start
    whole = median_ms(step, repeats, device)
    td = state[0].clone()
    alone = median_ms(lambda k: policy(td.set(keys.NOMINAL_ACTION, actions[k % 4])), repeats, device)
    return [batch, n, name, whole, 1e3 * batch / whole, alone, first]


def rows(options) -> Iterator[list]:
    """All rows."""
    for n in options.robots:
        for batch in options.batches:
            kinds = ("selecting", "fixed sizes", "fixed sizes, graphs", "fixed sizes, compiled")
            for name in kinds if batch in options.compiled else kinds[:-1]:
                yield measure(batch, n, options.device, options.repeats, name)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = harness.make_parser(__doc__, batches="512,4096,32768,65536", robots="3", repeats=20)
    parser.add_argument("--compiled", type=harness.integers, default=harness.integers("4096"), help="default 4096")
    parser.set_defaults(device="cuda", threads=1)
    options = harness.parse(parser, arguments)
    header = ("B", "N", "filter", "step, ms", "world-steps/s", "filter alone, ms", "first, s")
    harness.table("A certified step", header, rows(options))


if __name__ == "__main__":
    main()
