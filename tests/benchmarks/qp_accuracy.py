"""python tests/benchmarks/qp_accuracy.py [--problems 10000] [--solvers exact,active_set,pdipm,qpth] [--dtypes float64,float32]

The solvers of safety/qp.py against Clarabel, an independent interior-point solver, on easy and on hard problems. Per
category, solver and dtype, over as many problems in all as --problems says:

* problems: exact has n = 2, 3 and m = 3..12 rows, with and without the unit ball, the others n = 6, 10, 16, 24 and m = 2 n + 2;
  Q is the identity in one half and SPD in the other. For float32 the data are rounded first; Clarabel gets the same data.
* error: worst ‖u - u'‖ to Clarabel's u' over max(‖u'‖, 1e-3 ‖unconstrained u‖), the length of the KKT residual.
* KKT: worst relative KKT residual of what is SOLVED. For float64 the larger of the reported one and one computed from value
  and dual over all rows; for float32 the reported one, of the solution before it is rounded.
* SOLVED: share; infeasible: reported of constructed (or refuted by Clarabel or a linear program, too: float32 data that the
  rounding has made infeasible); NaN: problems with a NaN or inf in an output.
* unsure: Clarabel's own residual is above 1e-12 and above the solver's, or above 1e-10. Then the values are not compared;
  instead the solver's must satisfy the rows and its objective must not be above Clarabel's.

Clarabel is taken as the reference after Newton steps from its solution and multipliers, as its tolerances leave a solution
uncertain by their square root. Rows nearly parallel, a third each: as they come, the solution where two of them cross, and
the solution in the tip of a thin wedge. Infeasible by 1e-3 to 1: rows that contradict each other, a zero row, or a cone of
rows outside the ball. Thin slabs are 1e-9 (float32: 1e-5) to 1e-3 wide, and so is the room that almost infeasible rows leave.

The second table is on gradients: each solver's against central differences, the other solvers', and those of one problem
at a time.

The status is 1, and an example is printed, if a SOLVED value differs from a sure Clarabel's by more than 1e-6 + 10 κ r (r the
KKT residual, κ the condition of the rows at the solution and of Q, times ‖unconstrained u‖ / ‖u‖), or fails the checks where
Clarabel is unsure; if an infeasible problem is not called so (by qpth: is called SOLVED, as it proves only gross
contradictions) or a feasible one is; if there is a NaN; or if gradients, or what is solved one by one, differ by more than
1e-6.
"""

import argparse
import dataclasses
import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import clarabel
import harness
import numpy as np
import torch
from scipy import optimize, sparse
from torch import Tensor

from safety.kkt import SCALE_FLOOR, TINY, kkt_residual, norm, normalise_rows
from safety.qp import KKT_TOL, QPSolution, QPStatus, project_halfspaces_ball, solve_qp
from tests import test_qp, test_qp_joint

DTYPES = {"float64": torch.float64, "float32": torch.float32}
SOLVERS = ("exact", "active_set", "pdipm", "qpth")
TOLERANCE = 1e-6  # of values (where KKT residual and condition are small) and of gradients, relative
SURE, UNSURE = 1e-12, 1e-10  # KKT residuals at which Clarabel's value is, and is not, compared whatever the solver's
FINE = 1e-14  # KKT residual at which it is not refined
ATTEMPTS = ((1e-14, False), (1e-12, True), (1e-9, True))
"""Clarabel's tolerance, and whether each row is scaled by a power of two to size one; the next one where it is not sure."""
THRESHOLDS = (1.0, 1e2, 1e4, 1e6, 0.0)
"""Starts of the refinement, see Judge.refine; the next one where Clarabel is not sure."""
EXAMPLES = 3  # that are printed


class Size(NamedTuple):
    """Of one batch of problems."""

    n: int
    m: int
    spd: bool
    radius: float | None = None

    def __str__(self) -> str:
        ball = "" if self.radius is None else ", ball"
        return f"n = {self.n}, m = {self.m}, {'SPD' if self.spd else 'identity'}{ball}"


EXACT = [Size(*size) for size in itertools.product((2, 3), range(3, 13), (False, True), (None, 1.0))]
JOINT = [Size(n, 2 * n + 2, spd) for n, spd in itertools.product((6, 10, 16, 24), (False, True))]
CATEGORIES = {
    "random": "random",
    "degenerate vertex": "vertex",
    "duplicate rows": "duplicate",
    "zero rows": "zero",
    "nearly parallel, 1e-3": 1e-3,
    "nearly parallel, 1e-6": 1e-6,
    "nearly parallel, 1e-8": 1e-8,
    "weakly active": "weak",
    "badly scaled rows": "scaled",
    "spread bounds": "spread",
    "bounds of +inf": "infinite",
    "equality pairs": "equality",
    "thin slabs": "slab",
    "infeasible": "infeasible",
    "almost infeasible": "almost",
}
PLAIN = ("random", "duplicate", "zero", "scaled", "spread", "infinite")  # as tests/test_qp_joint.py makes them


# ---- problems -------------------------------------------------------------------------------------------------------
class Problems(NamedTuple):
    """A flat batch, of the dtype that the solvers get."""

    Q: Tensor
    p: Tensor
    G: Tensor
    h: Tensor
    radius: float | None
    infeasible: bool

    def double(self) -> "Problems":
        """The same numbers in float64."""
        return Problems(*(x.double() for x in self[:4]), *self[4:])

    def at(self, index: Tensor) -> "Problems":
        """Some of them."""
        return Problems(*(x[index] for x in self[:4]), *self[4:])


def make(kind: str | float, size: Size, count: int, dtype: torch.dtype, seed: int) -> Problems:
    """Problems of one category, see CATEGORIES; all but the infeasible ones are built around a feasible point x."""
    n, m, spd, radius = size
    Q, p, G, h = test_qp_joint.problems(
        kind if kind in PLAIN else "random", count, m, n, spd=spd, seed=100_000 * seed + (7 if radius else 0)
    )
    if kind not in PLAIN:
        p, G, h = hard(kind, Q, p, G, radius, 1e-9 if dtype == torch.float64 else 1e-5, seed)
    data = (x.to(dtype) for x in ((Q + Q.mT) / 2, p, G, h))
    return Problems(*data, radius, kind == "infeasible")


def hard(
    kind: str | float, Q: Tensor, p: Tensor, G: Tensor, radius: float | None, least: float, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    """p, G and h of the categories that are not PLAIN, from random ones; ``least`` is the smallest width of slabs."""
    (B, m, n), gen = G.shape, torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=gen, dtype=G.dtype)

    def between(low: float, high: float) -> Tensor:
        return low * (high / low) ** uniform(B)

    x = torch.nn.functional.normalize(torch.randn(B, n, generator=gen, dtype=G.dtype), dim=-1) * uniform(B, 1) * 0.8
    length, lam, room = norm(G), torch.zeros(B, m, dtype=G.dtype), 0.1 + 0.5 * uniform(B, m)
    variant = torch.arange(B)
    optimal = torch.zeros(B, dtype=torch.bool)  # x is the solution, with the multipliers lam
    if isinstance(kind, float):
        half = m // 2
        a = G[:, :half]
        other = torch.randn(B, half, n, generator=gen, dtype=G.dtype)
        other = other - (other * a).sum(-1, keepdim=True) / (a * a).sum(-1, keepdim=True) * a
        other *= (norm(a) / norm(other))[..., None]
        sign = 1.0 - 2.0 * (variant % 3 == 2)[:, None, None]
        G[:, half : 2 * half] = sign * (math.cos(kind) * a + math.sin(kind) * other)
        room[:, half : 2 * half] = room[:, :half]
        optimal = variant % 3 > 0
        pair = torch.tensor([0, half])
        lam[:, pair], room[:, pair] = 0.1 + uniform(B, 2), torch.where(optimal[:, None], 0.0, room[:, pair])
    elif kind == "vertex":
        many = min(m, n + max(1, n // 2))
        lam[:, :many], room[:, :many], optimal = 0.1 + uniform(B, many), 0.0, ~optimal
        lam[:, n + 1 :] *= uniform(B, max(0, m - n - 1)) < 0.5
    elif kind == "weak":
        many, optimal = max(2, n // 2), ~optimal
        lam[:, 0:many:2] = 0.1 + uniform(B, len(range(0, many, 2)))
        room[:, :many] = 0.0
        if radius is not None:  # every other one: only the ball touches, with multiplier 0
            only = variant % 2 == 1
            x[only] *= radius / norm(x[only])[:, None]
            lam[only], room[only] = 0.0, 0.2
    elif kind in ("equality", "slab"):
        pairs = 2 * torch.arange(max(1, n // 4))
        G[:, pairs + 1] = -G[:, pairs]
        room[:, pairs] = room[:, pairs + 1] = 0.0
        if kind == "slab":
            room[:, pairs] = between(least, 1e-3)[:, None] * length[:, pairs]
    else:  # the last of `many` rows is opposite to a sum of the others
        many = n + 1 if m > n else 2
        weight = 0.2 + uniform(B, many - 1)
        last = -(weight[..., None] * G[:, : many - 1]).sum(1)
        G[:, many - 1] = last / norm(last)[:, None] if many > 2 else -G[:, 0]
        room[:, :many] = between(least, 1e-3)[:, None] if kind == "almost" else 0.0
    h = (G @ x[..., None])[..., 0] + room
    if kind in ("equality", "slab"):  # exactly opposite bounds, at whatever rounding
        h[:, pairs + 1] = -h[:, pairs] + room[:, pairs]
    if kind == "infeasible":
        gap = between(1e-3, 1.0)
        h[:, many - 1] -= gap
        variant = variant % (2 if radius is None else 3)
        zero, outside = variant == 1, variant == 2
        G[zero, 0], h[zero, 0] = 0.0, -gap[zero]
        if radius is not None:
            point = -((0.1 + uniform(B, 2, 1)) * G[:, :2]).sum(1)
            point *= (radius * (1 + gap) / norm(point))[:, None]
            h[outside, :2] = (G[outside, :2] @ point[outside, :, None])[..., 0]
    held = -(Q @ x[..., None])[..., 0] - (lam[:, None] @ G)[:, 0]
    return torch.where(optimal[:, None], held, p), G, h


# ---- the reference --------------------------------------------------------------------------------------------------
class Judged(NamedTuple):
    """Points (B, n) with multipliers of the unit rows (B, m') and of the ball (B,), and the KKT residual (B,)."""

    u: Tensor
    lam: Tensor
    mu: Tensor
    residual: Tensor

    def at(self, index: Tensor) -> "Judged":
        """Some of them."""
        return Judged(*(x[index] for x in self))

    def put(self, index: Tensor, other: "Judged") -> None:
        """Replace my samples ``index`` by the other's, in place, where its residual is smaller."""
        better = other.residual < self.residual[index]
        for mine, theirs in zip(self, other, strict=True):
            mine[index[better]] = theirs[better]


class Judge:
    """What is computed about given problems in float64, from unit rows."""

    def __init__(self, problems: Problems) -> None:
        self.problems = problems.double()
        self.Q, self.p, G, h, self.radius, _ = self.problems
        self.G, self.h, self.size, _ = normalise_rows(G, h)
        self.target = norm(torch.linalg.solve(self.Q, self.p))
        self.free = self.target if self.radius is None else self.target.clamp(max=self.radius)

    def length(self, u: Tensor) -> Tensor:
        """The length that errors are relative to."""
        return torch.maximum(norm(u), SCALE_FLOOR * self.free).clamp(min=TINY)

    def pull(self, u: Tensor, lam: Tensor) -> Tensor:
        """Qu + p + Gᵀλ."""
        return (self.Q @ u[..., None])[..., 0] + self.p + (lam[:, None] @ self.G)[:, 0]

    def slack(self, u: Tensor) -> Tensor:
        """Of the unit rows."""
        return self.h - (self.G @ u[..., None])[..., 0]

    def __call__(self, u: Tensor, lam: Tensor, mu: Tensor | None = None) -> Judged:
        """KKT residual; the ball's multiplier from stationarity if it is not known."""
        if mu is None:
            mu = -(self.pull(u, lam) * u).sum(-1) / (u * u).sum(-1).clamp(min=TINY)
            mu = torch.zeros_like(mu) if self.radius is None else mu.clamp(min=0.0)
        return Judged(u, lam, mu, kkt_residual(self.Q, self.p, self.G, self.h, u, lam, mu, self.radius))

    def violation(self, u: Tensor) -> Tensor:
        """Of rows and ball, relative."""
        worst = -self.slack(u).amin(-1) / self.length(u)
        return worst if self.radius is None else torch.maximum(worst, norm(u) / self.radius - 1)

    def excess(self, mine: Judged, other: Tensor) -> Tensor:
        """How far my objective is above the other point's, relative; its violations of my active rows are added to it."""
        values = []
        for u in (mine.u, other):
            values.append((0.5 * u * (self.Q @ u[..., None])[..., 0] + self.p * u).sum(-1))
        allowance = (mine.lam * (-self.slack(other)).clamp(min=0.0)).sum(-1)
        if self.radius is not None:
            allowance = allowance + mine.mu * ((other * other).sum(-1) - self.radius**2).clamp(min=0.0) / 2
        return (values[0] - values[1] - allowance) / (norm(self.p) * self.length(mine.u)).clamp(min=TINY)

    def refine(self, start: Judged, threshold: float, steps: int = 6) -> Judged:
        """The best of some semismooth Newton steps: a row is active if its relative multiplier is above its slack.

        Before the first one, rows whose multiplier is below threshold times the slack are dropped.
        """
        best, (u, lam, mu, _) = Judged(*(x.clone() for x in start)), start
        force, length = norm(self.p).clamp(min=TINY)[:, None], self.length(u)[:, None]
        lam = torch.where(lam / force > threshold * self.slack(u) / length, lam, 0.0)
        eye = torch.eye(u.shape[-1], dtype=u.dtype)
        for _ in range(steps):
            room, nu = self.slack(u), torch.cat([lam, mu[:, None]], 1)
            held, ball = lam / force > room / length, torch.zeros_like(mu, dtype=torch.bool)
            if self.radius is not None:
                ball = mu * self.radius / force[:, 0] > 1 - norm(u) / self.radius
            held, half = torch.cat([held, ball[:, None]], 1), ((self.radius or 0.0) ** 2 - (u * u).sum(-1)) / 2
            nu = torch.where(held, nu, 0.0)
            L, _ = torch.linalg.cholesky_ex(self.Q + nu[:, -1, None, None] * eye)
            rows = torch.where(held[..., None], torch.cat([self.G, u[:, None]], 1), 0.0)
            rows = torch.linalg.solve_triangular(L, rows.mT, upper=False).mT
            g = torch.linalg.solve_triangular(L, (self.pull(u, nu[:, :-1]) + nu[:, -1:] * u)[..., None], upper=False)
            inverse = torch.linalg.pinv(rows, rtol=1e-12)
            step = inverse @ torch.where(held, torch.cat([room, half[:, None]], 1), 0.0)[..., None]
            step = step - (g - inverse @ (rows @ g))
            nu = nu - (inverse.mT @ (g + step))[..., 0]
            u = u + torch.linalg.solve_triangular(L.mT, step, upper=True)[..., 0]
            lam, mu = nu[:, :-1], nu[:, -1].clamp(min=0.0)
            best.put(torch.arange(len(u)), self(u, lam, mu))
        return best

    def condition(self, u: Tensor) -> Tensor:
        """By how much a KKT residual may show in u: of the rows that u touches, of Q, and of u to the unconstrained one."""
        touched = self.slack(u) <= 1e-5 * self.length(u)[:, None]
        size = torch.linalg.svdvals(torch.where(touched[..., None], self.G, 0.0))
        least = torch.where(size > 1e-12, size, 1.0).amin(-1)
        return torch.linalg.cond(self.Q) / least * (self.target / self.length(u)).clamp(min=1.0)

    def contradict(self, i: int) -> bool:
        """Whether the rows of problem i contradict each other, by a linear program for the least violation."""
        G, h = self.G[i].numpy(), self.h[i].numpy()
        rows, cost = np.c_[G, -np.ones(len(h))], np.r_[np.zeros(G.shape[1]), 1.0]
        tolerances = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
        found = optimize.linprog(cost, A_ub=rows, b_ub=h, bounds=(None, None), options=tolerances)
        return bool(found.status == 0 and found.fun > 1e-9)

    def clarabel(self) -> tuple[Judged, Tensor]:
        """Clarabel's solutions, refined, and which problems it calls infeasible."""
        best = self(torch.zeros_like(self.p), torch.zeros_like(self.h))
        best = best._replace(residual=torch.full_like(best.residual, torch.inf))
        infeasible = torch.zeros_like(best.mu, dtype=torch.bool)
        for tolerance, scaled in ATTEMPTS:
            todo = ((best.residual > SURE) & ~infeasible).nonzero()[:, 0]
            if not len(todo):
                break
            some = Judge(self.problems.at(todo))
            found = [clarabel_solve(some.problems, i, tolerance, scaled) for i in range(len(todo))]
            status, u, lam, mu = zip(*found, strict=True)
            infeasible[todo] = torch.tensor(["PrimalInfeasible" in x for x in status])
            lam = torch.nn.functional.pad(torch.stack(lam), (0, self.h.shape[1] - len(lam[0]))) * some.size
            lam = torch.where(some.G.any(-1), lam, 0.0)
            numbers = (
                torch.nan_to_num(x, 0.0, 0.0, 0.0) for x in (torch.stack(u), lam, torch.tensor(mu, dtype=lam.dtype))
            )
            start = some(*numbers)
            best.put(todo, start)
            for threshold in THRESHOLDS:
                goal = FINE if threshold == THRESHOLDS[0] else SURE
                left = (best.residual[todo] > goal).nonzero()[:, 0]
                if len(left):
                    best.put(todo[left], Judge(some.problems.at(left)).refine(start.at(left), threshold))
        return best, infeasible


def clarabel_solve(problems: Problems, i: int, tolerance: float, scaled: bool) -> tuple[str, Tensor, Tensor, float]:
    """Clarabel's status, solution and multipliers of the rows and the ball (stationarity Qu + p + Gᵀλ + μu = 0)."""
    Q, p, G, h = (x[i].numpy() for x in problems[:4])
    finite, n = np.isfinite(h), len(p)
    factor = np.ones_like(h)
    if scaled:  # exact
        size = np.maximum(np.linalg.norm(G, axis=1), np.where(finite, np.abs(h), 0.0))
        factor = np.exp2(-np.round(np.log2(np.where(size > 0, size, 1.0))))
    A, b = [(G * factor[:, None])[finite]], [(h * factor)[finite]]
    cones = [clarabel.NonnegativeConeT(int(finite.sum()))]
    if problems.radius is not None:
        A.append(np.vstack([np.zeros((1, n)), -np.eye(n)]))
        b.append(np.r_[problems.radius, np.zeros(n)])
        cones.append(clarabel.SecondOrderConeT(n + 1))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    data = sparse.csc_matrix(np.triu(Q)), p, sparse.csc_matrix(np.vstack(A)), np.concatenate(b)
    found = clarabel.DefaultSolver(*data, cones, settings).solve()
    z, lam = np.array(found.z), np.zeros_like(h)
    lam[finite] = z[: finite.sum()]
    mu = 0.0 if problems.radius is None else float(z[finite.sum()]) / problems.radius
    return str(found.status), torch.tensor(found.x, dtype=torch.float64), torch.from_numpy(lam * factor), mu


# ---- the comparison -------------------------------------------------------------------------------------------------
@dataclasses.dataclass
class Tally:
    """Of one solver and dtype, in one category or in all."""

    problems: int = 0
    error: float = 0.0
    residual: float = 0.0
    solved: int = 0
    reported: int = 0
    infeasible: int = 0
    nan: int = 0
    unsure: int = 0

    def add(self, other: "Tally") -> None:
        """The other's problems, too."""
        for field in dataclasses.fields(self):
            mine, theirs = getattr(self, field.name), getattr(other, field.name)
            setattr(self, field.name, max(mine, theirs) if isinstance(mine, float) else mine + theirs)

    def cells(self) -> list[str]:
        """Of the table."""
        share = "" if not self.problems else f"{math.floor(1000 * self.solved / self.problems) / 10:g} %"
        numbers = [f"{x:.0e}" if self.solved else harness.DASH for x in (self.error, self.residual)]
        return [*numbers, share, f"{self.reported} of {self.infeasible}", str(self.nan), str(self.unsure)]


class Failures:
    """Counts what must not happen and keeps an example of each kind, a small one if there is one."""

    def __init__(self) -> None:
        self.seen: dict[tuple[str, str], list] = {}

    def add(self, reason: str, where: str, judge: Judge, bad: Tensor, *details: tuple[str, Tensor]) -> None:
        """The problems of one batch for which ``bad`` (B,) is true; details are printed with the example."""
        if not bad.any():
            return
        i = int(bad.nonzero()[0, 0])
        data = dict(zip("QpGh", (x[i].tolist() for x in judge.problems), strict=False))
        data |= {"radius": judge.radius} | {name: x[i].tolist() for name, x in details}
        entry = self.seen.setdefault((reason, where), [0, data])
        entry[0] += int(bad.sum())
        if len(data["p"]) < len(entry[1]["p"]):
            entry[1] = data

    def report(self) -> int:
        """Print them; the program's status."""
        for (reason, where), (count, _) in self.seen.items():
            print(f"FAILED: {reason}: {count} x {where}")
        for (reason, where), (_, data) in sorted(self.seen.items(), key=lambda x: len(x[1][1]["p"]))[:EXAMPLES]:
            print(f"\nExample, {reason}, {where}:")
            for name, value in data.items():
                print(f"  {name} = {value!r}")
        return int(bool(self.seen))


def compare(
    judge: Judge,
    reference: tuple[Judged, Tensor],
    solution: QPSolution,
    dtype: torch.dtype,
    where: str,
    failures: Failures,
    lenient: bool,
) -> Tally:
    """One solver's answers to one batch, against Clarabel's; lenient: INACCURATE is enough of a report of infeasibility."""
    theirs, refuted = reference
    u, lam = solution.value.double(), torch.zeros_like(judge.h)
    lam[:, : solution.dual.shape[1]] = solution.dual.double()
    mine = judge(u, torch.where(judge.G.any(-1), lam * judge.size, 0.0))
    residual = solution.residual.double()
    if dtype == torch.float64:
        residual = torch.maximum(residual, mine.residual)
    status, impossible = solution.status, torch.full_like(refuted, judge.problems.infeasible)
    solved, reported = status == QPStatus.SOLVED, status == QPStatus.INFEASIBLE
    refuted = refuted.clone()
    for i in (reported & ~impossible & ~refuted).nonzero()[:, 0].tolist():
        refuted[i] = judge.contradict(i)
    odd = ~(u.isfinite().all(-1) & solution.dual.isfinite().all(-1)) | solution.residual.isnan()
    sure = theirs.residual <= residual.clamp(SURE, UNSURE)
    unsure = torch.where(impossible, ~refuted, solved & ~sure)
    compared = solved & sure & ~impossible
    error = norm(u - theirs.u) / judge.length(theirs.u)
    tolerance = TOLERANCE + 10 * judge.condition(theirs.u) * residual.nan_to_num(0.0, 0.0)
    limit = 10 * KKT_TOL[dtype]
    broken = solved & ~impossible & ((judge.violation(u) > limit) | (residual > limit))
    above = unsure & solved & theirs.residual.isfinite() & ~refuted & (judge.excess(mine, theirs.u) > TOLERANCE)
    details = ("value", u), ("residual", residual), ("status", status)
    details = *details, ("Clarabel's value", theirs.u), ("Clarabel's residual", theirs.residual)
    failures.add("value differs from Clarabel's", where, judge, compared & ~(error <= tolerance), *details)
    failures.add("SOLVED, but rows or KKT conditions are violated", where, judge, broken, *details)
    failures.add("objective above Clarabel's", where, judge, above, *details)
    failures.add("infeasible, not reported", where, judge, impossible & (solved if lenient else ~reported), *details)
    failures.add("feasible, called infeasible", where, judge, reported & ~impossible & ~refuted, *details)
    failures.add("NaN or inf", where, judge, odd, *details)

    def worst(x: Tensor, some: Tensor) -> float:
        return float(torch.nan_to_num(x[some], math.inf).max()) if some.any() else 0.0

    return Tally(
        len(u),
        worst(error, compared),
        worst(residual, solved),
        int(solved.sum()),
        int(reported.sum()),
        int((impossible | (reported & refuted)).sum()),
        int(odd.sum()),
        int(unsure.sum()),
    )


def solve(problems: Problems, solver: str) -> QPSolution:
    """By the projection where the problem is one in a ball."""
    Q, p, G, h, radius, _ = problems
    if radius is not None and (torch.eye(p.shape[-1], dtype=p.dtype) == Q).all():
        return project_halfspaces_ball(-p, G, h, radius)
    return solve_qp(Q, p, G, h, radius=radius, solver=solver)


def split(count: int, sizes: Sequence[Size]) -> Iterator[tuple[Size, int]]:
    """``count`` problems spread over the sizes."""
    order = torch.randperm(len(sizes), generator=torch.Generator().manual_seed(0)).tolist()
    for k, index in enumerate(order):
        if share := (count + len(sizes) - 1 - k) // len(sizes):
            yield sizes[index], share


def accuracy(options: argparse.Namespace, failures: Failures) -> Iterator[list]:
    """Rows of the first table, category by category; the last ones are the totals."""
    count = -(-options.problems // len(CATEGORIES))
    totals = {solver: {dtype: Tally() for dtype in options.dtypes} for solver in options.solvers}
    for seed, (category, kind) in enumerate(CATEGORIES.items(), 1):
        found = {solver: {dtype: Tally() for dtype in options.dtypes} for solver in options.solvers}
        for dtype, sizes in itertools.product(options.dtypes, (EXACT, JOINT)):
            solvers = [solver for solver in options.solvers if (solver == "exact") == (sizes is EXACT)]
            for size, share in split(count, sizes) if solvers else ():
                problems = make(kind, size, share, DTYPES[dtype], seed)
                judge = Judge(problems)
                reference = judge.clarabel()
                for solver in solvers:
                    where = f"{solver}, {dtype}, {category}"
                    solution = solve(problems, solver)
                    tally = compare(judge, reference, solution, DTYPES[dtype], where, failures, solver == "qpth")
                    found[solver][dtype].add(tally)
        for solver, tallies in found.items():
            for dtype, tally in tallies.items():
                totals[solver][dtype].add(tally)
            yield row(solver, category, tallies)
    for solver, tallies in totals.items():
        yield row(solver, "all", tallies)


def row(solver: str, category: str, tallies: dict[str, Tally]) -> list:
    """Of the first table."""
    cells = itertools.chain.from_iterable(tally.cells() for tally in tallies.values())
    return [next(iter(tallies.values())).problems, solver, category, *cells]


# ---- gradients ------------------------------------------------------------------------------------------------------
def well_posed() -> Iterator[tuple[Size, list[Tensor]]]:
    """Problems without small multipliers and slacks, float64: Q, p, G, h."""
    for size in (Size(2, 4, False), Size(3, 5, True), Size(3, 5, False, 0.8), Size(3, 5, True, 0.8)):
        n, m, spd, radius = size
        yield size, test_qp.smooth_problems(12, m, n, spd=spd, radius=radius, seed=n)
    for size in (Size(6, 9, False), Size(6, 9, True), Size(10, 12, True)):
        yield size, test_qp_joint.smooth_problems(6, size.m, size.n, spd=size.spd)


def flatten(parts: Sequence[Tensor]) -> Tensor:
    """One vector per sample."""
    return torch.cat([x.flatten(1) for x in parts], 1)


def differences(
    data: Sequence[Tensor], weights: Tensor, radius: float | None, solver: str, step: float = 1e-5
) -> Tensor:
    """Gradients (B, K) of weights·value by central differences in every entry of Q, p, G and h."""
    result = []
    for *sample, weight in zip(*data, weights, strict=True):
        vector = flatten([x[None] for x in sample])[0]
        moves = step * torch.eye(len(vector), dtype=vector.dtype)
        parts = torch.cat([vector + moves, vector - moves]).split([x.numel() for x in sample], 1)
        moved = [x.reshape(-1, *y.shape) for x, y in zip(parts, sample, strict=True)]
        above, below = (solve_qp(*moved, radius=radius, solver=solver).value @ weight).chunk(2)
        result.append((above - below) / (2 * step))
    return torch.stack(result)


def gradients(options: argparse.Namespace, failures: Failures) -> Iterator[list]:
    """Rows of the second table."""
    for size, inputs in well_posed():
        data = [x.detach() for x in inputs]
        weights = torch.randn(len(data[1]), size.n, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        able = [s for s in options.solvers if (size.n <= 3 or s != "exact") and (size.radius is None or s == "exact")]
        found = {s: flatten(test_qp.gradients(data, weights, radius=size.radius, solver=s)) for s in able}
        if not able:
            continue
        found["differences"] = differences(data, weights, size.radius, able[0])
        for solver in able:
            value = solve_qp(*data, radius=size.radius, solver=solver).value
            looped, slopes = [], []
            for i in range(len(value)):
                one = [x[i] for x in data]
                looped.append(solve_qp(*one, radius=size.radius, solver=solver).value)
                slope = test_qp.gradients(one, weights[i], radius=size.radius, solver=solver)
                slopes.append(torch.cat([x.flatten() for x in slope]))
            pairs = {name: (found[solver], found[name]) for name in found if name != solver}
            pairs |= {
                "looped value": (value, torch.stack(looped)),
                "looped gradient": (found[solver], torch.stack(slopes)),
            }
            errors = {}
            for name, (one, other) in pairs.items():
                error = norm(one - other) / norm(other)
                bad = ~(error <= TOLERANCE)
                failures.add(f"gradients or loop, against {name}", f"{solver}, {size}", judge_of(data, size), bad)
                errors[name] = f"{float(error.max()):.0e}"
            columns = ["differences", *options.solvers, "looped value", "looped gradient"]
            yield [len(value), solver, str(size), *(errors.get(name) for name in columns)]


def judge_of(data: Sequence[Tensor], size: Size) -> Judge:
    """For the example of a failure."""
    return Judge(Problems(*data, size.radius, False))


# ---- program --------------------------------------------------------------------------------------------------------
def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables and return the status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=10_000, help="per solver and dtype, default 10000")
    parser.add_argument("--solvers", type=lambda x: names(x, SOLVERS), default=SOLVERS, help="default all")
    parser.add_argument("--dtypes", type=lambda x: names(x, DTYPES), default=tuple(DTYPES), help="default both")
    options, failures = parser.parse_args(arguments), Failures()
    print(f"{harness.machine('cpu')}, clarabel {clarabel.__version__}\n")
    columns = ["error", "KKT", "SOLVED", "infeasible", "NaN", "unsure"]
    header = [f"{name} {dtype}" for dtype, name in itertools.product(options.dtypes, columns)]
    harness.table("Accuracy", ["problems", "solver", "category", *header], accuracy(options, failures))
    header = ["problems", "solver", "problem", "differences", *options.solvers, "looped value", "looped gradient"]
    harness.table("Gradients, worst relative difference, float64", header, gradients(options, failures))
    return failures.report()


def names(text: str, allowed: Sequence[str]) -> tuple[str, ...]:
    """Comma-separated ones of those allowed."""
    chosen = tuple(text.split(","))
    if unknown := set(chosen) - set(allowed):
        raise argparse.ArgumentTypeError(f"{', '.join(sorted(unknown))}: not of {', '.join(allowed)}")
    return chosen


if __name__ == "__main__":
    sys.exit(main())
