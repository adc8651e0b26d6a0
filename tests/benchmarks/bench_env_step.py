"""python tests/benchmarks/bench_env_step.py [--batches 512,4096] [--robots 3] [--profile] [--no-memory]

One whole step of B worlds of N robots: filter, world, coverage and observation, with random nominal actions, unfiltered and
behind the stacked and the certified filter, also compiled (a minute for each size) and at fixed sizes. Baseline of the ratio:
an unfiltered step of VMAS simple_spread with the same B and N, if vmas is installed. Both get actions drawn beforehand; no
resets. ``--rows certified`` leaves out all rows whose name does not begin so.

"peak MB" is the peak resident memory of a fresh process that does nothing else, less what it had after its imports (on a GPU
the peak of its allocator). ``--profile`` adds the share of one certified step's time per part.
"""

import contextlib
import importlib
import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from unittest import mock

import harness
import torch
from tensordict import TensorDictBase

from agents import make_controller
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyFilter

STEPS = 4  # per timed run
VMAS, UNFILTERED = "VMAS simple_spread", "unfiltered"
OURS = {UNFILTERED: "none", "stacked": "stacked", "certified": "certified"}
COMPILED, FIXED = ", compiled", ", fixed sizes"
OURS |= {name + COMPILED: own for name, own in OURS.items()}
OURS |= {f"certified{FIXED}": "certified", f"certified{FIXED}{COMPILED}": "certified"}

PARTS = {
    "filter: rows": ["safety.filter.certified_rows", "safety.filter.sampled_energy_row"],
    "filter: anchors": ["safety.certified_rows.anchors"],
    "filter: programs": ["safety.filter.SafetyFilter._solve_per_robot"],
    "filter: shield": ["safety.filter.shield", "safety.filter.outside"],
    "filter: rest (barriers, packing)": ["safety.filter.SafetyFilter.filter"],
    "world: transition": ["envs.surveillance.SurveillanceEnv.transition"],
    "world: violations": ["envs.surveillance.violations"],
    "world: Voronoi distances and cost": ["envs.surveillance.SurveillanceEnv._watch"],
    "world: density": ["envs.density.Density.advance", "envs.density.Density.weights"],
    "world: slot reassignment": ["envs.surveillance.reassign_slots"],
    "world: observation": ["envs.surveillance.SurveillanceEnv._observe"],
    "world: rest of the step (packing)": ["envs.surveillance.SurveillanceEnv._step"],
}
"""Functions that make up a step; the time of one that another one calls counts for itself only."""
OVERHEAD = "TensorDict and TorchRL overhead"


# ---- the steps ------------------------------------------------------------------------------------------------------
def make_chain(name: str, world: SurveillanceConfig, batch: int, device: str) -> harness.Chain:
    """``STEPS`` steps of VMAS or of ours, the state going on from run to run."""
    advance = vmas_step(world, batch, device) if name == VMAS else our_step(name, world, batch, device)

    def steps() -> None:
        with torch.no_grad():
            for _ in range(STEPS):
                advance()

    return (steps,)


def our_step(name: str, world: SurveillanceConfig, batch: int, device: str) -> Callable[[], None]:
    """Filter and environment."""
    fast, fixed = COMPILED in name, FIXED in name
    env = SurveillanceEnv(world, batch, device, seed=1, compile_functions=fast, fixed_sizes=fixed)
    policy = SafetyFilter(harness.FILTERS[OURS[name]], world, compile=fast, fixed_sizes=fixed)
    nominal = make_controller("random", world)
    td = env.reset()
    actions = [nominal(td.clone())[keys.NOMINAL_ACTION] for _ in range(STEPS)]
    state: list[TensorDictBase] = [td]

    def advance() -> None:
        actions.append(actions.pop(0))
        state[0] = env.step(policy(state[0].set(keys.NOMINAL_ACTION, actions[0])))["next"]

    return advance


def vmas_step(world: SurveillanceConfig, batch: int, device: str) -> Callable[[], None]:
    """VMAS with random actions."""
    env = harness.optional("vmas").make_env(
        scenario="simple_spread",
        num_envs=batch,
        n_agents=world.n_agents,
        device=device,
        continuous_actions=True,
        seed=1,
    )
    env.reset()
    actions = [[env.get_random_action(agent) for agent in env.agents] for _ in range(STEPS)]

    def advance() -> None:
        actions.append(actions.pop(0))
        env.step(actions[0])

    return advance


# ---- memory ---------------------------------------------------------------------------------------------------------
def peak_memory(name: str, n: int, batch: int, options) -> float | None:
    """Megabytes that a fresh process needs for the step; None if it fails."""
    command = [sys.executable, "-W", "ignore", __file__, "--child", name, "--batches", str(batch), "--robots", str(n)]
    command += ["--device", options.device, "--threads", str(options.threads), "--dimension", str(options.dimension)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    return float(process.stdout.split()[-1]) if process.returncode == 0 else None


def measure_memory(options) -> None:
    """The child: two runs of the step, then print the peak."""
    world, device = harness.make_world(options.robots[0], options.dimension), options.device
    harness.run(make_chain(options.child, world, 2, device), device)  # lazy imports are no step's memory
    before = peak_resident()
    chain = make_chain(options.child, world, options.batches[0], device)
    for _ in range(2):
        harness.run(chain, device)
    cuda = torch.device(device).type == "cuda"
    print((torch.cuda.max_memory_allocated() if cuda else peak_resident() - before) / 1e6)


def peak_resident() -> int:
    """Peak resident memory of this process, bytes (not ``ru_maxrss``, which on Linux counts the parent before exec)."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return 1024 * next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM"))


# ---- profile --------------------------------------------------------------------------------------------------------
class Profile:
    """Time per part, each function's less that of the parts within it."""

    def __init__(self, device: str) -> None:
        self.device, self.seconds, self.inner = device, defaultdict(float), [0.0]

    def wrap(self, part: str, function: Callable) -> Callable:
        """``function``, timed."""

        def timed(*args, **kwargs):
            start = harness.clock(self.device)
            self.inner.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                spent = harness.clock(self.device) - start
                self.seconds[part] += spent - self.inner.pop()
                self.inner[-1] += spent

        return timed

    @contextlib.contextmanager
    def patched(self) -> Iterator[list[str]]:
        """Time all parts; yields the functions that this version does not have."""
        missing = []
        with contextlib.ExitStack() as stack:
            for part, paths in PARTS.items():
                for path in paths:
                    owner, name = resolve(path)
                    if owner is None or not hasattr(owner, name):
                        missing.append(path)
                        continue
                    stack.enter_context(mock.patch.object(owner, name, self.wrap(part, getattr(owner, name))))
            yield missing


def resolve(path: str) -> tuple[object | None, str]:
    """Module or class that owns a dotted name."""
    owner, name = path.rsplit(".", 1)
    module, _, cls = owner.rpartition(".") if owner.rsplit(".", 1)[-1][0].isupper() else (owner, "", "")
    try:
        found: object | None = importlib.import_module(module)
    except ImportError:
        return None, name
    return (getattr(found, cls, None) if cls else found), name


def print_profile(n: int, batch: int, options) -> None:
    """Shares of the certified step's time."""
    profile, world = Profile(options.device), harness.make_world(n, options.dimension)
    with profile.patched() as missing:
        chain = make_chain("certified", world, batch, options.device)
        harness.run(chain, options.device)
        profile.seconds.clear()
        start, runs = time.perf_counter(), 0
        while runs < options.repeats and time.perf_counter() - start < options.seconds:
            profile.seconds["total"] += sum(harness.run(chain, options.device))
            runs += 1
    total = profile.seconds.pop("total")
    profile.seconds[OVERHEAD] = total - sum(profile.seconds.values())
    rows = [
        [1e3 * seconds / runs / STEPS, 100 * seconds / total, part]
        for part in [*PARTS, OVERHEAD]
        if (seconds := profile.seconds[part])
    ]
    rows.append([1e3 * total / runs / STEPS, 100.0, "total"])
    absent = f"Not in this version, so its time counts elsewhere: {', '.join(missing)}." if missing else ""
    harness.table(f"Parts of a certified step, B = {batch}, N = {n}", ("ms", "%", "part"), rows, absent)


# ---- program --------------------------------------------------------------------------------------------------------
def rows_of(options, budget: harness.Budget) -> Iterator[list]:
    """Table rows of all sizes."""
    names = [name for name in OURS if name.startswith(options.rows)]
    names = [VMAS, *names] if harness.optional("vmas") else names
    for n in options.robots:
        world = harness.make_world(n, options.dimension)
        for batch in options.batches:
            chains = {
                name: make_chain(name, world, batch, options.device) if budget.allows((name, n), batch) else None
                for name in names
            }
            times = {name: t and t[0] / STEPS for name, t in budget.medians(chains, batch, n).items()}
            for name in names:
                milliseconds = times[name]
                memory = peak_memory(name, n, batch, options) if options.memory and milliseconds else None
                yield [
                    *(batch, n, name, milliseconds, milliseconds and 1e3 * batch / milliseconds),
                    milliseconds and 1e3 * milliseconds / batch,
                    *(harness.ratio(milliseconds, times.get(who)) for who in (VMAS, UNFILTERED)),
                    memory,
                ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = harness.make_parser(__doc__, batches="512,4096", robots="3")
    parser.add_argument("--profile", action="store_true", help="share of the certified step's time per part")
    parser.add_argument("--no-memory", dest="memory", action="store_false", help="no fresh processes for the memory")
    parser.add_argument("--rows", default="", help="only rows whose name begins so, and VMAS")
    parser.add_argument("--child", help="internal: measure this row's memory in this process")
    options = harness.parse(parser, arguments)
    if options.child:
        measure_memory(options)
        return
    budget = harness.Budget(options)
    header = (
        *("B", "N", "step", "ms", "world-steps/s", "µs per world"),
        *(f"/ {VMAS}", f"/ {UNFILTERED}", "peak MB"),
    )
    unmeasured = "" if options.memory else f"Peak MB {harness.DASH}: switched off by --no-memory."
    notes = (unmeasured, harness.missing("vmas"), budget.footnote)
    harness.table(f"Whole step, d = {options.dimension}", header, rows_of(options, budget), *notes)
    if options.profile:
        for n in options.robots:
            for batch in options.batches:
                print_profile(n, batch, options)


if __name__ == "__main__":
    main()
