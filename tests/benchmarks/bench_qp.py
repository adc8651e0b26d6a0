"""python tests/benchmarks/bench_qp.py [--batches 64,512] [--robots 3,8] [--dimension 2] [--problems robot,joint]

The quadratic programs of the safety filter, forward and backward: our solvers against qpth, proxsuite and moreau (those
installed). B worlds of N robots; a table per kind of problem:

* robot: one problem per robot, rows of the certified filter; B N problems, of as many states as it takes if the filter poses
  none for robots that need none. The exact solver takes the speed limit as a ball ("exact, ball", the filter's own problem);
  everybody solves the one with the faces of a polygon in the ball's place.
* joint: one problem per world over all velocities, rows of the stacked filter with split=joint.

The rows are the filter's own, recorded on the way from the filter to its solver, at states of roll-outs behind the stacked
filter with random nominal actions. All solvers get the same float64 tensors, the same threads and the same judge: SOLVED is
the share of problems whose relative KKT residual (safety.kkt, float64) is at most 1e-6, "worst residual" the largest among
the problems that the solver itself calls solved (stock qpth calls nothing: among all).

Solving with proxsuite includes setting up its objects from the tensors and reading the results, "solve only" does not; it
runs with the tolerance of its PyTorch layer, whose gradients are off by about a hundredth here.
"""

import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple
from unittest import mock

import harness
import numpy as np
import torch
from qpth.qp import QPFunction
from tensordict import TensorDictBase
from torch import Tensor, nn

import safety.programs
import safety.qp
from envs import SurveillanceConfig
from safety import QPStatus, SafetyConfig, SafetyFilter, solve_qp
from safety.kkt import kkt_residual, normalise_rows
from safety.qp import KKT_TOL, project_halfspaces_ball

SOLVERS: tuple[str, ...] = getattr(safety.qp, "SOLVERS", None) or safety.qp._SOLVERS
OURS = "qpth, guarded"  # as the tables call our solver="qpth"
STOCK, PROX, PROX_SOLVE, MOREAU = "qpth, stock", "proxsuite", "proxsuite, solve only", "moreau"
SPLITS = {
    "robot": SafetyConfig(solver="qpth"),
    "ball": SafetyConfig(),
    "joint": SafetyConfig(mode="paper", split="joint"),
}


class Problems(NamedTuple):
    """min ½ |u|² - target·u  s.t.  G u ≤ h and, if there is a radius, |u| ≤ radius; flat batch, float64, with gradients."""

    target: Tensor
    G: Tensor
    h: Tensor
    radius: float | None = None

    def head(self, count: int) -> "Problems":
        """The first ``count`` problems, as leaves that want gradients; shares memory."""
        return Problems(*(x[:count].detach().requires_grad_() for x in self[:3]), self.radius)

    @property
    def identity(self) -> Tensor:
        """Q of every problem, ``(B, n, n)``."""
        n = self.target.shape[-1]
        return torch.eye(n, dtype=self.target.dtype, device=self.target.device).expand(len(self.target), n, n)


class Answer(NamedTuple):
    """Solution, multipliers and what the solver calls solved; any of the last two may be unknown (None)."""

    u: Tensor
    dual: Tensor | None = None
    claimed: Tensor | None = None


# ---- the filter's problems ------------------------------------------------------------------------------------------
class Recorded(Exception):
    """Carries the arguments of the filter's call past its solver."""


def record(safety_filter: SafetyFilter, state: TensorDictBase) -> Problems | None:
    """The problems that the filter poses at a state, flattened; None if it poses none."""

    def caught(*arguments, **_):
        raise Recorded(*arguments)

    with (
        mock.patch.object(safety.programs, "solve_qp", caught),
        mock.patch.object(safety.programs, "project_halfspaces_ball", caught),
        torch.no_grad(),
    ):
        try:
            safety_filter(state)
        except Recorded as call:
            arguments = call.args
        else:
            return None
    radius = None if isinstance(arguments[-1], Tensor) else arguments[-1]
    target, G, h = arguments[:3] if radius else (-arguments[1], *arguments[2:])
    batch = target.shape[:-1]

    def flat(x: Tensor, trailing: int) -> Tensor:
        tail = x.shape[x.ndim - trailing :]
        return x.double().expand(*batch, *tail).reshape(-1, *tail)

    return Problems(flat(target, 1), flat(G, 2), flat(h, 1), radius)


def collect(world: SurveillanceConfig, count: int, kinds: Sequence[str], device: str) -> dict[str, Problems]:
    """``count`` problems of each kind, in random order, of roll-outs of up to 512 worlds from their 20th step on.

    Fewer if they would take more than a tenth of the free memory, or are still not found after 1000 steps.
    """
    states = harness.rollout(world, min(count, 512), behind="stacked", device=device)
    parts: dict[str, list[Problems]] = {kind: [] for kind in kinds}
    filters = {kind: SafetyFilter(SPLITS[kind], world) for kind in kinds}
    room = 0.1 * harness.free_memory(device)
    for state in itertools.islice(states, 20, 1020):
        for kind, found in parts.items():
            problems = record(filters[kind], state.clone())
            if problems:
                found.append(problems)
        everything = [p for found in parts.values() for p in found]
        enough = all(sum(len(p.h) for p in found) >= count for found in parts.values())
        if enough or 8 * sum(p.G.numel() for p in everything) > room:
            break
    if not all(parts.values()):
        raise RuntimeError(
            "the filter called no solver: bench_qp no longer records the arguments of the right functions"
        )
    return {kind: join(found, count) for kind, found in parts.items()}


def join(parts: Sequence[Problems], count: int) -> Problems:
    """The first ``count`` of all problems in random order, with idle rows where some have fewer rows than others."""
    rows = max(p.h.shape[-1] for p in parts)
    G = torch.cat([nn.functional.pad(p.G, (0, 0, 0, rows - p.G.shape[-2])) for p in parts])
    h = torch.cat([nn.functional.pad(p.h, (0, rows - p.h.shape[-1]), value=torch.inf) for p in parts])
    order = torch.randperm(len(h), generator=torch.Generator().manual_seed(0))[:count].to(h.device)
    return Problems(torch.cat([p.target for p in parts])[order], G[order], h[order], parts[0].radius)


# ---- solvers: a chain (forward, backward) and the last answer ---------------------------------------------------------
class Solver:
    """One solver on one batch; ``answer`` is the last forward's."""

    def __init__(self, problems: Problems, name: str, threads: int) -> None:
        self.problems, self.name, self.threads = problems, name, threads
        generator = torch.Generator().manual_seed(1)
        seed = torch.randn(problems.target.shape, generator=generator, dtype=torch.float64)
        self.cotangent = seed.to(problems.target.device)
        self.answer: Answer | None = None

    def chain(self) -> harness.Chain:
        """Forward and backward."""
        return self.forward, self.backward

    def forward(self) -> Tensor:
        """Solve, with the graph for the gradient."""
        target, G, h, radius = self.problems
        if radius:
            solution = project_halfspaces_ball(target, G, h, radius)
        else:
            solution = solve_qp(self.problems.identity, -target, G, h, solver=self.name)
        self.answer = Answer(solution.value, solution.dual, solution.status == QPStatus.SOLVED)
        return solution.value

    def backward(self, value: Tensor) -> tuple[Tensor, ...]:
        """Gradients of target, G and h."""
        return torch.autograd.grad(value, self.problems[:3], self.cotangent)

    def bytes(self) -> int:
        """What the solver keeps of all problems at once, roughly: the rows, their gradient, and a few copies of them."""
        return 8 * 6 * self.problems.G.numel()


class Stock(Solver):
    """qpth as its users call it; an infinite bound, which it answers with NaN, is given to it as 1000."""

    def forward(self) -> Tensor:
        target, G, h, _ = self.problems
        none = target.new_empty(0)
        value = QPFunction(verbose=-1)(self.problems.identity, -target, G, h.clamp(max=1e3), none, none)
        self.answer = Answer(value, value.grad_fn.lams)
        return value

    def bytes(self) -> int:
        return super().bytes() + 8 * 6 * self.problems.h.numel() * self.problems.h.shape[-1]


class ProxSuite(Solver):
    """proxsuite's batch of dense problems, solved and differentiated in its own threads; CPU only."""

    def __init__(self, problems: Problems, name: str, threads: int) -> None:
        super().__init__(problems, name, threads)
        self.dense = harness.optional("proxsuite").proxqp.dense

    def chain(self) -> harness.Chain:
        if self.name == PROX:
            return super().chain()
        self.build()  # "solve only": neither setting up nor reading the results
        return (partial(self.dense.solve_in_parallel, qps=self.batch, num_threads=self.threads),)

    def build(self) -> None:
        """A solver object per problem."""
        target, G, h = (x.detach().cpu().numpy() for x in self.problems[:3])
        (count, m, n), identity = G.shape, self.problems.identity[0].cpu().numpy()
        self.batch, low = self.dense.BatchQP(), np.full(m, -1e20)
        for k in range(count):
            qp = self.batch.init_qp_in_place(n, 0, m)
            qp.settings.eps_abs, qp.settings.eps_rel = 1e-9, 0.0  # the tolerance of its PyTorch layer
            qp.init(H=identity, g=-target[k], C=G[k], l=low, u=h[k].clip(max=1e20))

    def forward(self) -> Tensor:
        self.build()
        self.dense.solve_in_parallel(qps=self.batch, num_threads=self.threads)
        results = [self.batch.get(k).results for k in range(self.batch.size())]
        device, solved = self.problems.target.device, harness.optional("proxsuite").proxqp.PROXQP_SOLVED
        u, dual = (
            torch.tensor([list(getattr(r, x)) for r in results], dtype=torch.float64, device=device) for x in "xz"
        )
        claimed = torch.tensor([r.info.status == solved for r in results], device=device)
        self.answer = Answer(u, dual, claimed)
        return u

    def backward(self, value: Tensor) -> tuple[Tensor, ...]:
        cotangent, rows = self.cotangent.cpu(), self.problems.h.shape[-1]
        losses = self.dense.VectorLossDerivatives()
        for line in torch.cat([cotangent, cotangent.new_zeros(len(cotangent), rows)], -1).numpy():
            losses.append(line)
        self.dense.solve_backward_in_parallel(num_threads=self.threads, qps=self.batch, loss_derivatives=losses)
        data = [self.batch.get(k).model.backward_data for k in range(self.batch.size())]
        found = ([getattr(d, name) for d in data] for name in ("dL_dg", "dL_dC", "dL_du"))
        dp, dG, dh = (torch.stack([torch.from_numpy(x.copy()) for x in xs]).to(value.device) for xs in found)
        return -dp, dG, dh

    def bytes(self) -> int:
        count, m, n = self.problems.G.shape
        return super().bytes() + 8 * 4 * count * (m + n) ** 2


class Moreau(Solver):
    """moreau's PyTorch solver with its default settings: one dense cone program per problem."""

    def __init__(self, problems: Problems, name: str, threads: int) -> None:
        super().__init__(problems, name, threads)
        moreau, layer = harness.optional("moreau"), harness.optional("moreau.torch")
        (count, m, n), steps = problems.G.shape, torch.arange
        kind = problems.target.device.type
        settings = moreau.Settings(device=kind, batch_size=count, enable_grad=True)
        pattern = (steps(n + 1), steps(n), steps(m + 1) * n, steps(n).repeat(m))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the active-set solver's gradients have kinks: so has the solution
            self.solver = layer.Solver(n, m, *pattern, moreau.Cones(num_nonneg_cones=m), settings=settings)
        self.ones = torch.ones_like(problems.target)

    def forward(self) -> Tensor:
        target, G, h, _ = self.problems
        solution = self.solver.solve(self.ones, G.flatten(1), -target, h.clamp(max=1e20))
        claimed = torch.tensor([s.name == "Solved" for s in self.solver.info.status], device=target.device)
        self.answer = Answer(solution.x, solution.z, claimed)
        return solution.x


def judge(problems: Problems, answer: Answer) -> tuple[float, float]:
    """Share SOLVED, % and the worst residual of what is called solved."""
    target, G, h, radius = (x.detach() if isinstance(x, Tensor) else x for x in problems)
    G, h, size, _ = normalise_rows(G, h)
    u, dual = answer.u.detach(), answer.dual.detach().clamp(min=0)
    lam = dual * size
    mu = torch.zeros_like(u[:, 0])
    if radius:  # the ball's multiplier is what the rows leave, along u, where u is at the ball
        rest = target - u - (G * lam[..., None]).sum(1)
        mu = ((rest * u).sum(-1) / u.square().sum(-1).clamp(min=1e-300)).clamp(min=0)
        mu = torch.where(u.norm(dim=-1) > radius * (1 - 1e-9), mu, 0.0)
    residual = kkt_residual(None, -target, G, h, u, lam, mu, radius)
    claimed = torch.ones_like(mu, dtype=torch.bool) if answer.claimed is None else answer.claimed
    worst = residual[claimed].max().item() if claimed.any() else float("nan")
    return 100 * (residual <= KKT_TOL[torch.float32]).double().mean().item(), worst


# ---- program --------------------------------------------------------------------------------------------------------
def contestants(kind: str, device: str) -> dict[str, tuple[str, Callable[..., Solver]]]:
    """Names in the table: the kind of problem that is solved and what solves it."""
    ours = {OURS if name == "qpth" else name: (kind, partial(Solver, name=name)) for name in SOLVERS}
    if kind == "robot":
        ours = {"exact, ball": ("ball", partial(Solver, name="exact")), **ours}
    else:
        del ours["exact"]
    rivals: dict[str, tuple[str, Callable[..., Solver]]] = {STOCK: (kind, partial(Stock, name=STOCK))}
    if harness.optional("proxsuite"):
        rivals |= {name: (kind, partial(ProxSuite, name=name)) for name in (PROX, PROX_SOLVE)}
    if harness.optional("moreau.torch") and harness.optional("moreau").device_available(device):
        rivals[MOREAU] = (kind, partial(Moreau, name=MOREAU))
    return ours | rivals


def rows_of(kind: str, options, budget: harness.Budget) -> Iterator[list]:
    """Table rows of one kind of problem."""
    for n in options.robots:
        world, names = harness.make_world(n, options.dimension), contestants(kind, torch.device(options.device).type)
        most = options.batches[-1] * (n if kind == "robot" else 1)
        found = collect(world, most, sorted({k for k, _ in names.values()}), options.device)
        for batch in options.batches:
            count = batch * n if kind == "robot" else batch
            solvers: dict[str, Solver] = {}

            def make(name: str, size: int, names=names, found=found) -> Solver:
                problem, build = names[name]
                return build(found[problem].head(size), threads=options.threads)

            for name in names:
                small = make(name, 1)
                known = len(found[names[name][0]].target)
                if known < count or small.bytes() * count > 0.5 * harness.free_memory(options.device):
                    budget.skipped.add(name)
                elif budget.probe((name, (kind, n)), count, lambda size, name=name: make(name, size).chain()):
                    solvers[name] = make(name, count)
            chains = {name: solvers[name].chain() if name in solvers else None for name in names}
            times = budget.medians(chains, count, (kind, n))
            yield from (row(batch, n, name, times, solvers.get(name)) for name in names)


def row(batch: int, n: int, name: str, times: dict[str, list[float] | None], solver: Solver | None) -> list:
    """One solver's line: times, ratios (above 1: faster than the baseline), accuracy."""

    def total(who: str, phases: int = 2) -> float | None:
        spent = times.get(who)
        return None if spent is None else sum(spent[:phases])

    mine = times[name] or [None]
    phases = len(mine)
    ratios = [harness.ratio(total(who, phases), total(name)) for who in (STOCK, OURS, PROX, MOREAU)]
    solved, worst = judge(solver.problems, solver.answer) if solver and solver.answer else (None, None)
    return [
        *(batch, n, name, mine[0], mine[1] if phases > 1 else None, *ratios),
        *(solved, harness.DASH if worst is None else f"{worst:.1e}"),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = harness.make_parser(__doc__, batches="64,512", robots="3")
    parser.add_argument("--problems", default="robot,joint", help="kinds of problem, default robot,joint")
    options = harness.parse(parser, arguments)
    header = (
        *("B", "N", "solver", "forward ms", "backward ms"),
        *(f"speed-up on {who}" for who in (STOCK, OURS, PROX, MOREAU)),
        *("SOLVED %", "worst residual"),
    )
    for kind in options.problems.split(","):
        budget = harness.Budget(options)
        title = f"{'One problem per robot' if kind == 'robot' else 'Joint problems'}, d = {options.dimension}"
        note = "Speed-up: the baseline's forward + backward time over this solver's (solve only: forward alone, not judged)."
        rows = rows_of(kind, options, budget)
        harness.table(title, header, rows, note, harness.missing("proxsuite", "moreau"), budget.footnote)


if __name__ == "__main__":
    main()
