"""python tests/benchmarks/bench_filter.py [--batches 128,512] [--robots 3,8] [--controllers random,patrol] [--filters ...]

The safety filter on B worlds of N robots: certified, stacked, paper (the literal reading) and joint, on states that a
roll-out behind the certified filter reaches. Forward only as in a roll-out, and forward and backward to the nominal action
as with ``safety.in_loss``; "/ stacked" is the time over the stacked filter's, "/ step" over the unfiltered pipeline step
(speed limit, world, coverage, observation). The joint filter has a row for every solver that its configuration takes.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import harness
import torch
from tensordict import TensorDictBase

import safety.qp
from envs import SurveillanceConfig, SurveillanceEnv, keys
from safety import SafetyConfig, SafetyFilter

STEP = "step"  # the unfiltered pipeline step, among the filters
GRADIENT = " with gradient"


def make_filters(names: Sequence[str]) -> dict[str, SafetyConfig]:
    """Filters by name; ``joint`` once for every solver that it takes."""
    out = {}
    for name in names:
        out[name] = harness.FILTERS[name]
        if name == "joint":
            del out[name]
            for solver in getattr(safety.qp, "SOLVERS", None) or safety.qp._SOLVERS:
                try:
                    out[f"joint, {solver}"] = dataclasses.replace(harness.FILTERS[name], solver=solver)
                except ValueError:  # not for a joint problem, or not for the filter
                    continue
    return out


def chain(safety_filter: SafetyFilter, states: Sequence[TensorDictBase], *, gradient: bool) -> harness.Chain:
    """Filter all states, with or without the gradient."""

    def forward() -> list[TensorDictBase]:
        with torch.set_grad_enabled(gradient):
            return [safety_filter(state.clone().set(keys.NOMINAL_ACTION, nominal(state))) for state in states]

    def nominal(state: TensorDictBase) -> torch.Tensor:
        return state[keys.NOMINAL_ACTION].detach().requires_grad_(gradient)

    def both() -> None:
        torch.stack([state[keys.ACTION].square().sum() for state in forward()]).sum().backward()

    return (both if gradient else forward,)


def step_chain(world: SurveillanceConfig, states: Sequence[TensorDictBase], device: str) -> harness.Chain:
    """The unfiltered pipeline step, as often as there are states."""
    env = SurveillanceEnv(world, len(states[0]), device, seed=1)
    speed_limit = SafetyFilter(harness.FILTERS["none"], world)
    env.reset()

    def step() -> None:
        with torch.no_grad():
            for state in states:
                env.step(speed_limit(state.clone()))

    return (step,)


def rows_of(n: int, controller: str, options, budget: harness.Budget) -> Iterator[list]:
    """Table rows of one world."""
    world, filters = harness.make_world(n, options.dimension), make_filters(options.filters.split(","))
    modules = {name: SafetyFilter(config, world) for name, config in filters.items()}
    for batch in options.batches:
        source = harness.rollout(world, batch, behind="certified", controller=controller, device=options.device)
        states = list(itertools.islice(source, 10, 10 + 20 * options.states, 20))
        cases = {name + suffix: name for name in modules for suffix in ("", GRADIENT)}

        def chain_of(case: str, size: int, states=states, cases=cases) -> harness.Chain:
            gradient = case.endswith(GRADIENT)
            return chain(modules[cases[case]], [state[:size] for state in states], gradient=gradient)

        key = (n, controller)
        chains: dict = {STEP: step_chain(world, states, options.device)}
        for case in cases:
            allowed = budget.probe((case, key), batch, lambda size, case=case: chain_of(case, size))
            chains[case] = chain_of(case, batch) if allowed else None
        times = {name: t and t[0] / len(states) for name, t in budget.medians(chains, batch, key).items()}
        for name in modules:
            forward, both = times[name], times[name + GRADIENT]
            yield [
                *(batch, n, name, controller, forward, harness.ratio(forward, times.get("stacked"))),
                *(harness.ratio(forward, times[STEP]), both, harness.ratio(both, times.get("stacked" + GRADIENT))),
            ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = harness.make_parser(__doc__, batches="128,512", robots="3")
    parser.add_argument("--controllers", default="random,patrol", help="nominal actions, default random,patrol")
    parser.add_argument("--filters", default="certified,stacked,paper,joint", help="default all")
    parser.add_argument("--states", type=int, default=3, help="per roll-out, 20 steps apart, default 3")
    options = harness.parse(parser, arguments)
    budget, worlds = harness.Budget(options), itertools.product(options.robots, options.controllers.split(","))
    rows = itertools.chain.from_iterable(rows_of(n, controller, options, budget) for n, controller in worlds)
    header = (
        *("B", "N", "filter", "controller", "forward ms", "/ stacked", "/ step"),
        *("forward + backward ms", "/ stacked"),
    )
    harness.table(f"Safety filter, d = {options.dimension}", header, rows, budget.footnote)


if __name__ == "__main__":
    main()
