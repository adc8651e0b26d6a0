"""Exact solution of small quadratic programmes.

Problem (one per sample, flat batch B, always float64 here; see safety/qp.py for the public border):

    min_u  ½ uᵀQu + pᵀu    s.t.  G u ≤ h  and, optionally,  ‖u‖ ≤ radius,        u ∈ Rⁿ, n ≤ 3.

With Q a multiple of the identity it is a projection, solved on the most violated row alone where that is enough, on the
rows' lines elsewhere (:mod:`safety.projection`), and by enumeration of active sets (:mod:`safety.enumeration`) where
rounding spoils these or nothing is feasible. Any other Q takes the enumeration in its metric, and a search for the
ball's multiplier around it.

Conventions: rows are normalised to unit norm (`normalise_rows`); a row that can never bind is g = 0, h = 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.dynamics import batch_last, dot
from safety.enumeration import CHUNK_BYTES, enumerate_projection, enumerate_reachable
from safety.kkt import TINY, QPStatus, Raw, choose, kkt_residual, norm, normalise_rows, pivoted_basis
from safety.projection import Projected, nearest_on_lines, nearest_on_one_row

FAST_TOL = 1e-11
"""KKT residual (relative) up to which the solution of the short way stands; above it the sample is enumerated."""
NEAREST_ROWS = 12
"""Rows of a sample that the short ways look at where sizes are fixed; more within reach are rare (docs/results.md)."""
ROOT_ITERATIONS = 80
"""Most steps of the search for the ball multiplier; 4 to 8 are usual."""


def settle(raw: Raw, violation: Tensor, nearest: Tensor, radius: float | None, tol: float) -> Raw:
    """Fill in the status from the residual and make everything that is not SOLVED finite and inside the ball."""
    solved = raw.residual <= tol
    status = torch.where(violation > tol, QPStatus.INFEASIBLE.value, QPStatus.INACCURATE.value)
    status = torch.where(solved, QPStatus.SOLVED.value, status)
    u = torch.where(solved[:, None], raw.u, torch.nan_to_num(nearest, 0.0, 0.0, 0.0))
    if radius is not None:
        size = norm(u)
        u = torch.where((solved | (size <= radius))[:, None], u, u * (radius / size.clamp(min=radius))[:, None])
    lam = torch.where(solved[:, None], raw.lam, 0.0)
    return raw._replace(u=u, status=status, lam=lam.clamp(min=0.0), mu=torch.where(solved, raw.mu, 0.0))


def solve_projection(
    t: Tensor, G: Tensor, h: Tensor, radius: float | None, tol: float, *, fixed_sizes: bool = False
) -> Raw:
    """Exact projection; targets that are feasible are returned as they are.

    Args:
        t: (B, n) finite targets.
        G: (B, m, n) finite rows, any scale.
        h: (B, m) bounds, +inf allowed.
        radius: ball radius or None.
        tol: KKT tolerance.
        fixed_sizes: all samples take the short ways, and what these do not settle to ``tol`` is INACCURATE.
    """
    raw, m = Raw.blank(t, G.shape[1]), G.shape[1]
    outside = (dot(G, t[:, None]) > h).any(-1)
    if radius is not None:
        outside = outside | (dot(t, t).sqrt() > radius)
    if fixed_sizes:
        return choose(outside, _short_ways(t, G, h, radius, tol), raw)
    index = outside.nonzero()[:, 0]
    if len(index):
        t, G, h = (batch_last(x[index]) for x in (t, G, h))
        G, h, size, impossible = normalise_rows(G, h)
        (u, lam, c), done = nearest_on_one_row(t, G, h, radius)
        more = (~done).nonzero()[:, 0]
        if len(more):
            for mine, part in zip((u, lam, c), _project(t[more], G[more], h[more], radius), strict=True):
                mine[more] = part
        mu = c - 1
        residual = kkt_residual(None, -t, G, h, u, lam, mu, radius)
        part = Raw(u, lam, mu, torch.zeros_like(index), residual, torch.ones_like(index))
        hard = (impossible | (residual > FAST_TOL)).nonzero()[:, 0]
        if len(hard):
            part.put(hard, _enumerate(t[hard], G[hard], h[hard], impossible[hard], radius, tol))
        raw.put(index, part._replace(lam=(part.lam / size)[:, :m]))
    return raw


def _short_ways(t: Tensor, G: Tensor, h: Tensor, radius: float | None, tol: float) -> Raw:
    """The most violated row or the rows' lines, both for all samples, with the status that their residual leads to."""
    m = G.shape[1]
    t, G, h = (batch_last(x) for x in (t, G, h))
    G, h, size, impossible = normalise_rows(G, h)
    on_one_row, done = nearest_on_one_row(t, G, h, radius)
    u, lam, c = choose(done, on_one_row, _project(t, G, h, radius, fixed_sizes=True))
    residual = kkt_residual(None, -t, G, h, u, lam, c - 1, radius)
    residual = torch.where(impossible, torch.inf, residual)
    one = torch.ones_like(impossible, dtype=torch.int64)
    raw = Raw(u, (lam / size)[:, :m], c - 1, one, residual, one)
    return settle(raw, torch.where(impossible, torch.inf, 0.0), u, radius, tol)


def _project(t: Tensor, G: Tensor, h: Tensor, radius: float | None, *, fixed_sizes: bool = False) -> Projected:
    """:func:`nearest_on_lines`, in chunks and without the rows that lie beyond the ball everywhere: they cannot bind.

    At fixed sizes with the ``NEAREST_ROWS`` rows that are nearest to the origin: the residual, of all rows, tells whether
    that was enough.
    """
    (B, width, n), all_rows = G.shape, None
    m = width
    if radius is not None:
        most = NEAREST_ROWS if fixed_sizes else max(1, int((h < radius).sum(-1).max()))
        if most < m:
            all_rows = h.topk(most, dim=-1, largest=False).indices
            G, h, m = G.gather(1, all_rows[..., None].expand(-1, -1, n)), h.gather(1, all_rows), most
    step = max(1, CHUNK_BYTES // (8 * m ** max(n, 2) * 8))
    parts = [nearest_on_lines(*part, radius) for part in zip(t.split(step), G.split(step), h.split(step), strict=True)]
    found = parts[0] if len(parts) == 1 else Projected(*(torch.cat(x) for x in zip(*parts, strict=True)))
    if all_rows is None:
        return found
    return found._replace(lam=found.lam.new_zeros(B, width).scatter(1, all_rows, found.lam))


def _enumerate(t: Tensor, G: Tensor, h: Tensor, impossible: Tensor, radius: float | None, tol: float) -> Raw:
    """Enumeration of active sets for the samples that the short way does not settle, with the status it leads to."""
    found = enumerate_reachable(t, G, h, radius)
    mu = found.c - 1
    residual = kkt_residual(None, -t, G, h, found.u, found.lam, mu, radius)
    residual = torch.where(impossible, torch.inf, residual)
    part = Raw(found.u, found.lam, mu, found.sizes, residual, found.sizes + 1)
    return settle(part, torch.where(impossible, torch.inf, found.violation), found.nearest, radius, tol)


class Metric:
    """Change of variables w = Lᵀu with Q = LLᵀ, in which the objective is ½‖w‖² - (-L⁻¹p)ᵀw.

    Attributes:
        L: (B, n, n) Cholesky factor, identity where Q is not positive definite.
        bad: (B,) whether Q is not positive definite.
        rows: (B, m, n) unit rows of G L⁻ᵀ.
        scale: (B, m) their norms before scaling.
    """

    def __init__(self, Q: Tensor, G: Tensor) -> None:
        L, info = torch.linalg.cholesky_ex(Q)
        self.bad = (info != 0) | ~torch.isfinite(L).all(-1).all(-1)
        self.L = torch.where(self.bad[:, None, None], torch.eye(Q.shape[-1], dtype=Q.dtype, device=Q.device), L)
        rows = torch.linalg.solve_triangular(self.L, G.mT, upper=False).mT
        size = norm(rows)
        self.scale = torch.where(size > 0, size, 1.0)
        self.rows = rows / self.scale[..., None]

    def down(self, x: Tensor) -> Tensor:
        """L⁻¹x for x (B, n)."""
        return torch.linalg.solve_triangular(self.L, x[..., None], upper=False)[..., 0]

    def up(self, w: Tensor, index: Tensor | None = None) -> Tensor:
        """Back to u = L⁻ᵀw for w (B, n), or (b, n) for the samples `index` (b,)."""
        L = self.L if index is None else self.L[index]
        return torch.linalg.solve_triangular(L.mT, w[..., None], upper=True)[..., 0]


def _solve_rows(Q: Tensor, p: Tensor, G: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Metric]:
    """Rows only, SPD Q, unit rows: u, λ, least violation, sizes tried, metric."""
    metric = Metric(Q, G)
    idle = ~G.any(-1)
    found = enumerate_projection(-metric.down(p), metric.rows, torch.where(idle, 1.0, h / metric.scale), None)
    violation = torch.where(metric.bad, 0.0, found.violation)
    return metric.up(found.u), found.lam / metric.scale, violation, found.sizes, metric


def _find_ball_multiplier(
    Q: Tensor, p: Tensor, G: Tensor, h: Tensor, radius: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find μ ≥ 0 with ‖u(μ)‖ = radius, u(μ) the rows-only solution for Q + μI; the norm falls as μ grows.

    Newton on 1/‖u(μ)‖ (nearly linear in μ while the active set stays), safeguarded by a bracket in τ = μ/(μ + s) ∈
    [0, 1). Where the step leaves the bracket, the one from its left end is taken, from which Newton converges
    monotonically; every fourth step bisects, because the norm has kinks where the active set changes.

    Returns:
        u (B, n), λ (B, m), μ (B,), steps (B,).
    """
    eye = torch.eye(Q.shape[-1], dtype=Q.dtype, device=Q.device)
    s = Q.diagonal(dim1=-2, dim2=-1).mean(-1)
    lo, hi, mu, left = torch.zeros_like(s), torch.ones_like(s), torch.zeros_like(s), torch.zeros_like(s)
    u, lam = torch.zeros_like(p), torch.zeros_like(h)
    best, steps, best_mu = torch.full_like(s, torch.inf), torch.zeros_like(s, dtype=torch.int64), torch.zeros_like(s)
    todo = torch.arange(len(p), device=p.device)
    for step in range(ROOT_ITERATIONS):
        H = Q[todo] + mu[todo, None, None] * eye
        v, dual, _, _, metric = _solve_rows(H, p[todo], G[todo], h[todo])
        size = norm(v)
        gap = (size / radius - 1).abs()
        better = gap < best[todo]
        who = todo[better]
        best[who], u[who], lam[who], best_mu[who] = gap[better], v[better], dual[better], mu[who]
        steps[todo] = step + 1
        tau = mu[todo] / (mu[todo] + s[todo])
        lo[todo] = torch.where(size > radius, tau, lo[todo])
        hi[todo] = torch.where(size > radius, hi[todo], tau)
        slope = norm(pivoted_basis(metric.rows, dual > 0).project(metric.down(v))).square()  # uᵀ(du/dμ) = -slope
        newton = mu[todo] + (size / radius - 1) * size.square() / slope.clamp(min=TINY)
        newton = newton / (newton + s[todo])
        left[todo] = torch.where(size > radius, newton, left[todo])
        a, b, start = lo[todo], hi[todo], left[todo]
        tau = (a + b) / 2
        if step % 4 != 3:
            tau = torch.where((start > a) & (start < b), start, tau)
            tau = torch.where((newton > a) & (newton < b), newton, tau)
        mu[todo] = s[todo] * tau / (1 - tau).clamp(min=1e-16)
        todo = todo[(best[todo] > 1e-13) & (b - a > 1e-16)]
        if not len(todo):
            break
    return u, lam, best_mu, steps


def solve_general(Q: Tensor, p: Tensor, G: Tensor, h: Tensor, radius: float | None, tol: float) -> Raw:
    """Exact solution for SPD Q (B, n, n); other arguments as `solve_projection` with p (B, n)."""
    m, (G, h, size, impossible) = G.shape[1], normalise_rows(G, h)
    u, lam, violation, steps, metric = _solve_rows(Q, p, G, h)
    mu, nearest = torch.zeros_like(steps, dtype=u.dtype), u
    if radius is not None:
        index = ((norm(u) > radius) | (violation > tol)).nonzero()[:, 0]
        if len(index):
            # The least-norm point tells whether rows and ball meet at all; relative to the radius, unlike `violation`.
            centre = enumerate_projection(torch.zeros_like(u[index]), G[index], h[index], radius)
            violation[index], nearest = centre.violation, nearest.index_copy(0, index, centre.nearest)
            index = index[(centre.violation <= tol) & ~metric.bad[index]]
            v, dual, ball, extra = _find_ball_multiplier(Q[index], p[index], G[index], h[index], radius)
            u, lam = u.index_copy(0, index, v), lam.index_copy(0, index, dual)
            mu, steps = mu.index_copy(0, index, ball), steps.index_copy(0, index, extra)
    residual = kkt_residual(Q, p, G, h, u, lam, mu, radius)
    residual = torch.where(impossible | metric.bad, torch.inf, residual)
    raw = Raw(u, (lam / size)[:, :m], mu, steps, residual, steps)
    return settle(raw, torch.where(impossible, torch.inf, violation), nearest, radius, tol)


def solve_exact(
    Q: Tensor | None, p: Tensor, G: Tensor, h: Tensor, radius: float | None, tol: float, *, fixed_sizes: bool = False
) -> Raw:
    """Exact solution, by projection where Q is a multiple of the identity.

    Args:
        Q: (B, n, n) symmetric, or None for the identity.
        p: (B, n).
        G: (B, m, n).
        h: (B, m), +inf allowed; everything else finite.
        radius: ball radius, length unit of u, or None.
        tol: KKT tolerance, relative.
        fixed_sizes: as :func:`solve_projection`'s; for Q None only.
    """
    if Q is None:
        return solve_projection(-p, G, h, radius, tol, fixed_sizes=fixed_sizes)
    c = Q[:, :1, :1]
    ball = c * torch.eye(Q.shape[-1], dtype=Q.dtype, device=Q.device)
    round_ = ((ball == Q) & (c > 0)).all(-1).all(-1)
    raw = Raw.blank(p, G.shape[1])
    index = round_.nonzero()[:, 0]
    if len(index):
        c = c[index, 0]
        part = solve_projection(-p[index] / c, G[index], h[index], radius, tol)
        raw.put(index, part._replace(lam=part.lam * c, mu=part.mu * c[:, 0]))
    index = (~round_).nonzero()[:, 0]
    if len(index):
        raw.put(index, solve_general(Q[index], p[index], G[index], h[index], radius, tol))
    return raw
