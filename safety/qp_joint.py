"""Quadratic programmes of many variables: what the two batched solvers for joint problems share.

With Q = LLᵀ, w = Lᵀu and the unconstrained minimiser t the problem is a projection, the nearest point to t with
rows·w ≤ bound (`Nearest`). A method (safety/qp_active_set.py, safety/qp_pdipm.py) answers with the rows that hold the
solution and their multipliers (`Found`). Here: the way there, samples without a violated row left out, and the way back,
one recomputation with a stable factorisation where the answer is not accurate, and the KKT residual as the judge.

Conventions: flat batch, float64; rows of unit norm; bound = +inf for a row that can never bind. The rows are the large
tensor (512 x 164 x 16 for eight robots), so they are read by matrix products only and never copied without need.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from safety.kkt import QPStatus, Raw, kkt_residual, norm, pivoted_basis
from safety.qp_exact import Metric

ACCURATE = 1e-12
"""KKT residual (relative) above which a solution is recomputed from its active rows."""
REACH = 10.0
"""A proof of infeasibility excludes solutions up to this many times the distances that occur in the problem."""
GAP = 1e-9
"""Least violation, in these distances, that such a proof must show."""
LARGEST = 1e150  # bounds below minus this would overflow when squared
ORDINARY = (1e-140, 1e140)  # row norms whose squares neither underflow nor overflow


class Nearest(NamedTuple):
    """min ½‖w - t‖² s.t. rows·w ≤ bound."""

    t: Tensor  # (b, n)
    rows: Tensor  # (b, m, n), unit norm
    bound: Tensor  # (b, m), +inf: never binds


class Found(NamedTuple):
    """Answer of a method. Slots that hold no row have multiplier 0 and any row number."""

    w: Tensor  # (b, n)
    picks: Tensor  # (b, k) row numbers
    lam: Tensor  # (b, k) multipliers
    infeasible: Tensor  # (b,) bool, proved by `refutes`
    steps: Tensor  # (b,) int64, iterations


Method = Callable[[Nearest], Found]


def take_rows(x: Tensor, picks: Tensor) -> Tensor:
    """Rows `picks` (b, k) of x (b, m, n): (b, k, n)."""
    return x[torch.arange(len(x), device=x.device)[:, None], picks]


def gather_rows(chosen: Tensor) -> tuple[Tensor, Tensor, Tensor, int]:
    """Where to put the chosen rows of (b, m) bool so that they take few slots: samples, rows, slots (c,), slots needed."""
    sample, row = chosen.nonzero(as_tuple=True)
    count = torch.bincount(sample, minlength=len(chosen))
    slot = torch.arange(len(sample), device=chosen.device) - (count.cumsum(0) - count)[sample]
    return sample, row, slot, max(1, int(count.max())) if len(chosen) else 1


def refutes(rows: Tensor, bound: Tensor, weight: Tensor, reach: Tensor) -> Tensor:
    """Whether weights ≥ 0 prove that rows·w ≤ bound has no solution with ‖w‖ ≤ 10 reach (Farkas).

    weightᵀ rows w ≤ weightᵀ bound for every solution, and the left side is at least -‖rowsᵀ weight‖‖w‖.

    Args:
        rows: (b, k, n) unit rows.
        bound: (b, k), finite where the weight is positive.
        weight: (b, k).
        reach: (b,) length.
    """
    terms = torch.where(weight > 0, bound * weight, 0.0)
    slope = norm((rows.mT @ weight[..., None])[..., 0])
    noise = 1e-12 * terms.abs().sum(-1) + GAP * reach * weight.sum(-1)
    return terms.sum(-1) + REACH * reach * slope < -noise


def polish(t: Tensor, rows: Tensor, bound: Tensor, active: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Projection of t (b, n) on the planes of the active rows, and their multipliers (b, m), by orthogonal factors.

    Args:
        t: (b, n).
        rows: (b, m, n) unit rows.
        bound: (b, m), finite where active.
        active: (b, m) bool.
        weight: (b, m) which rows to prefer where they are linearly dependent, positive.
    """
    basis = pivoted_basis(rows, active, weight)
    dead, picks = ~basis.axes.any(-1), basis.picks
    level = torch.where(dead, 0.0, bound.gather(1, picks))
    y = torch.linalg.solve_triangular(basis.R.mT, level[..., None], upper=False)
    w = basis.project(t) + (basis.axes * y).sum(1)
    lam = torch.linalg.solve_triangular(basis.R, basis.axes @ t[..., None] - y, upper=True)[..., 0]
    # An equality is a pair of opposite rows with any multipliers of the right difference: the other one may be meant.
    cosine, other = torch.where(active[:, None], take_rows(rows, picks) @ rows.mT, 1.0).min(-1)
    flip = (lam < 0) & (cosine < -1 + 1e-9)
    picks, lam = torch.where(flip, other, picks), torch.where(dead, 0.0, torch.where(flip, -lam, lam))
    return w, torch.zeros_like(bound).scatter_add(1, picks, lam)


def unit_rows(G: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Scale rows to unit norm.

    Args:
        G: (b, m, n) finite rows; overwritten.
        h: (b, m) bounds; +inf means no constraint.

    Returns:
        rows (b, m, n), bounds (b, m), +inf where the row can never bind, row norms (b, m), 1 for zero rows, and whether
        a zero row demands 0 ≤ h < 0 (b,).
    """
    size = norm(G)
    odd = (size < ORDINARY[0]) | (size > ORDINARY[1])
    if bool(odd.any()):  # in two steps, or the squares would underflow or overflow
        some = G[odd]
        big = some.abs().amax(-1).clamp(min=torch.finfo(G.dtype).smallest_normal)
        size[odd] = (big * norm(some / big[:, None])).clamp(max=torch.finfo(G.dtype).max)
    zero = size == 0
    size = torch.where(zero, 1.0, size)
    bound = torch.where(zero, torch.inf, (h / size).clamp(min=-LARGEST))
    return G.div_(size[..., None]), bound, size, (zero & (h < 0)).any(-1)


def solve_joint(Q: Tensor | None, p: Tensor, G: Tensor, h: Tensor, tol: float, method: Method) -> Raw:
    """Solve a flat batch by `method`; samples whose unconstrained minimiser violates no row are returned at once.

    Args:
        Q: (B, n, n) symmetric, or None for the identity, for which those samples come back as -p bit for bit.
        p: (B, n).
        G: (B, m, n).
        h: (B, m), +inf allowed; everything else finite.
        tol: KKT tolerance.
        method: solver of the projection.
    """
    if Q is None:
        L, u = None, -p
        t, bad = u, torch.zeros_like(p[:, 0], dtype=torch.bool)
    else:
        L, info = torch.linalg.cholesky_ex(Q)
        bad = (info != 0) | ~torch.isfinite(L).all(-1).all(-1)
        L = torch.where(bad[:, None, None], torch.eye(Q.shape[-1], dtype=Q.dtype, device=Q.device), L)
        t = -torch.linalg.solve_triangular(L, p[..., None], upper=False)[..., 0]
        u = torch.linalg.solve_triangular(L.mT, t[..., None], upper=True)[..., 0]
    raw = Raw.blank(u, G.shape[1])
    if Q is not None:
        none = p.new_zeros(len(p), 1)
        residual = kkt_residual(Q, p, p.new_zeros(len(p), 1, p.shape[1]), none, u, none, none[:, 0], None)
        raw = raw._replace(residual=torch.where(bad, torch.inf, residual))
        raw.status.copy_(torch.where(raw.residual > tol, QPStatus.INACCURATE.value, QPStatus.SOLVED.value))
        raw = raw._replace(u=torch.nan_to_num(u, 0.0, 0.0, 0.0))
    free = ((G @ u[..., None])[..., 0] <= h).all(-1)  # false for NaN, after an overflow
    index = (~free & ~bad).nonzero()[:, 0]
    if len(index):
        some = (None if x is None else x[index] for x in (Q, L))
        raw.put(index, _constrained(*some, p[index], t[index], G[index], h[index], tol, method))
    return raw


def _constrained(
    Q: Tensor | None, L: Tensor | None, p: Tensor, t: Tensor, G: Tensor, h: Tensor, tol: float, method: Method
) -> Raw:
    """The samples with violated rows; arguments as `solve_joint`, L the Cholesky factor of Q, t the target."""
    m = G.shape[1]
    G, h, size, impossible = unit_rows(G, h)
    if L is None:
        rows, bound, scale = G, h, torch.ones_like(h)
    else:
        rows = torch.linalg.solve_triangular(L, G.mT, upper=False).mT
        scale = norm(rows)
        scale = torch.where(scale > 0, scale, 1.0)
        rows, bound = rows / scale[..., None], h / scale
    found = method(Nearest(t, rows, bound))

    def judge(w: Tensor, picks: Tensor, lam: Tensor, i: Tensor | slice) -> tuple[Tensor, Tensor, Tensor]:
        """u, multipliers of the unit rows of G, and the KKT residual, for the samples i."""
        u = w if L is None else torch.linalg.solve_triangular(L[i].mT, w[..., None], upper=True)[..., 0]
        lam = lam / scale[i].gather(1, picks)
        # Rows with λ = 0 and slack ≥ 0 add nothing to the residual, so it takes only the picks and the worst row.
        worst = (torch.bmm(G[i], u[..., None])[..., 0] - h[i]).argmax(1, keepdim=True)
        picks = torch.cat([picks, worst], 1)
        dual = torch.cat([lam, torch.zeros_like(lam[:, :1])], 1)
        rows, bound, mu = take_rows(G[i], picks), h[i].gather(1, picks), torch.zeros_like(u[:, 0])
        return u, lam, kkt_residual(None if Q is None else Q[i], p[i], rows, bound, u, dual, mu, None)

    u, lam, residual = judge(found.w, found.picks, found.lam, slice(None))
    weak = ((residual > ACCURATE) & ~found.infeasible & ~impossible).nonzero()[:, 0]
    if len(weak):
        picks, weight = found.picks[weak], found.lam[weak]
        active = take_rows(rows[weak], picks), bound[weak].gather(1, picks), weight > 0
        w, weight = polish(t[weak], *active, weight.clamp(min=1e-12 * weight.amax(-1, keepdim=True)))
        again = judge(w, picks, weight, weak)
        better = again[2] < residual[weak]
        for mine, theirs in zip((u, lam, residual), again, strict=True):
            mine[weak[better]] = theirs[better]
    residual = torch.where(impossible, torch.inf, residual)
    solved, hopeless = residual <= tol, impossible | found.infeasible
    status = torch.where(hopeless, QPStatus.INFEASIBLE.value, QPStatus.INACCURATE.value)
    status = torch.where(solved, QPStatus.SOLVED.value, status)
    lam = torch.where(solved[:, None], lam, 0.0).clamp(min=0.0) / size.gather(1, found.picks)
    dense = lam.new_zeros(len(lam), m).scatter_add(1, found.picks, lam)
    u = torch.where(solved[:, None], u, torch.nan_to_num(u, 0.0, 0.0, 0.0))
    return Raw(u, dense, torch.zeros_like(residual), status, residual, found.steps)


def differentiate(
    Q: Tensor | None,
    p: Tensor,
    G: Tensor,
    u: Tensor,
    lam: Tensor,
    mu: Tensor,
    solved: Tensor,
    grad: Tensor,
    tol: float,
    identity: bool,
    rows_too: bool,
) -> tuple[Tensor | None, Tensor, Tensor | None, Tensor | None]:
    """Gradients of ½uᵀQu + pᵀu → min with respect to Q, p, G, h for any of the solvers.

    Solve [[Q + μI, Aᵀ, u], [A, 0, 0], [uᵀ, 0, 0]] (dz, dλ, dμ) = -(grad, 0, 0), A the active rows. Then dp = dz,
    dQ = ½(dz uᵀ + u dzᵀ), dG_i = λ_i dz + dλ_i u, dh_i = -dλ_i: rows with λ = 0 have none, so none of them is touched.

    Args:
        Q: (B, n, n), or None for the identity.
        p: (B, n), of the input's dtype as Q and G are.
        G: (B, m, n).
        u: (B, n) solution in float64, as the multipliers are.
        lam: (B, m).
        mu: (B,) of the ball.
        solved: (B,) bool; the others' gradient is zero.
        grad: (B, n) of the value.
        tol: multipliers up to this, relative, count as 0.
        identity: whether every Q is the identity.
        rows_too: whether gradients of G and h are wanted.
    """
    grad = torch.where(solved[:, None], grad, 0.0)
    dp, dG, dh = -grad, None, None
    if rows_too:
        dG, dh = torch.zeros_like(G), torch.zeros_like(G[..., 0])
    whole = u
    # Where nothing binds the gradient of a projection is the identity, exactly.
    index = (solved & ((lam > 0).any(-1) | (mu > 0)) if identity else solved).nonzero()[:, 0]
    if len(index):
        g, u, lam, mu, p64 = grad[index].double(), u[index], lam[index], mu[index], p[index].double()
        sample, row, slot, k = gather_rows(lam > 0)
        A, held = u.new_zeros(len(u), k, u.shape[-1]), u.new_zeros(len(u), k)
        A[sample, slot], held[sample, slot] = G[index[sample], row].double(), lam[sample, row]
        big = A.abs().amax(-1).clamp(min=1e-300)
        size = big * norm(A / big[..., None])
        size = torch.where(size > 0, size, 1.0)
        length = norm(u).clamp(min=1e-300)[:, None]
        rows = torch.cat([A / size[..., None], (u / length)[:, None]], 1)
        H = None if Q is None or identity else (Q[index] + Q[index].mT).double() / 2
        Qu = u if H is None else (H @ u[..., None])[..., 0]
        force = torch.maximum(norm(p64), norm(Qu))[:, None]
        active = torch.cat([held * size, mu[:, None] * length], 1) > tol * force
        c = (1 + mu).sqrt()[:, None]  # the Cholesky factor where Q = I
        metric = None if H is None else Metric(H + torch.diag_embed(mu[:, None].expand_as(u)), rows)
        if metric is None:
            scale, g = (1 / c).expand_as(active), g / c
        else:
            rows, scale, g = metric.rows, metric.scale, metric.down(g)
        basis = pivoted_basis(rows, active)
        dz = -basis.project(g)
        dz = dz / c if metric is None else metric.up(dz)
        dy = torch.linalg.solve_triangular(basis.R, -(basis.axes @ g[..., None]), upper=True)[..., 0]
        dlam = (torch.zeros_like(scale).scatter_add(1, basis.picks, dy) / scale)[:, :-1] / size
        dp[index] = dz.to(dp.dtype)
        if dG is not None and dh is not None:
            change = lam[sample, row, None] * dz[sample] + dlam[sample, slot, None] * u[sample]
            dG[index[sample], row] = change.to(dG.dtype)
            dh[index[sample], row] = -dlam[sample, slot].to(dh.dtype)
    if Q is None:
        return None, dp, dG, dh
    outer = dp[..., None] * whole[:, None].to(dp.dtype)
    return (outer + outer.mT) / 2, dp, dG, dh
