"""Enumeration of active sets: the slow and sure way to project on half-spaces and a ball, flat batch B, float64.

With target t and a set S of linearly independent rows, write {G_S u = h_S} = f + null(G_S), f the foot point of the
origin, and Pt the projection of t on null(G_S). The best point of that plane inside the ball is u_S = f + Pt/c with
c = max(1, ‖Pt‖ / sqrt(radius² - ‖f‖²)); it is stationary with row multipliers λ_S from G_Sᵀλ_S = t - c u_S and ball
multiplier c - 1 ≥ 0. The problem is convex, so u_S is *the* solution if and only if it satisfies the other rows and
λ_S ≥ 0, and by Carathéodory some S with |S| ≤ n does. So sizes |S| = 0..n are enumerated in turn and a sample stops at
the first size that has such a set. Nothing here loops over samples or rows.

Conventions: rows are normalised to unit norm (`normalise_rows`); a row that can never bind is g = 0, h = 1.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from safety.kkt import SCALE_FLOOR, TINY, column_norm, norm

EARLY_STOP = 1e-12
"""KKT violation (relative) at which no larger active set is tried: a few thousand roundings of float64."""
RANK_TOL = 1e-12
"""Sine of the angle below which a row counts as linearly dependent on the rows chosen before it."""
GRAZE = 1e-8
"""Least half-chord, relative to the radius, of a plane through the ball. A plane that only touches the ball has no
multipliers; opening the chord by 1e-8 radii changes ‖u‖ by 5e-17 relative and makes them exist."""
CHUNK_BYTES = 256 * 2**20
"""Bound on the temporaries of one step, bytes."""


def _candidates(
    t: Tensor, G: Tensor, h: Tensor, sets: Tensor, radius: float | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Best point of each plane {G_S u = h_S} in the ball, by Gram-Schmidt on the rows of S (no normal equations).

    Args:
        t: (B, n) targets.
        G: (B, m, n) unit rows.
        h: (B, m).
        sets: (C, k) row numbers of the active sets.
        radius: ball radius or None.

    Returns:
        u (B, C, n), λ_S (B, C, k), c (B, C), relative primal violation (B, C), relative dual violation (B, C).
    """
    (C, k), n = sets.shape, t.shape[-1]
    planes = G.permute(2, 0, 1)  # components first: sums over them are then additions of long contiguous runs
    foot, flat = t.new_zeros(n, len(t), C), t.mT[:, :, None].expand(-1, -1, C)
    ok = torch.ones_like(foot[0], dtype=torch.bool)
    axes: list[Tensor] = []
    R: list[list[Tensor]] = []  # R[j][i] = component of row j on axis i
    y: list[Tensor] = []
    z: list[Tensor] = []
    for j in range(k):
        v, coef = planes[:, :, sets[:, j]], [torch.zeros_like(foot[0])] * j
        for _ in range(2):  # second pass restores orthogonality between nearly parallel rows
            for i in range(j):
                part = (v * axes[i]).sum(0)
                v, coef[i] = v - part * axes[i], coef[i] + part
        size = column_norm(v)
        ok = ok & (size > RANK_TOL)
        size = torch.where(size > RANK_TOL, size, 1.0)
        rest = h[:, sets[:, j]]
        for i in range(j):
            rest = rest - coef[i] * y[i]
        axes.append(v / size)
        R.append([*coef, size])
        y.append(rest / size)
        z.append((axes[j] * flat).sum(0))
        foot, flat = foot + axes[j] * y[j], flat - axes[j] * z[j]
    if k == n:
        flat = torch.zeros_like(foot)
    else:
        for axis in axes:
            flat = flat - axis * (axis * flat).sum(0)
    c = torch.ones_like(foot[0])
    if radius is not None and k < n:
        away = column_norm(foot)
        half = ((radius - away) * (radius + away)).clamp(min=(GRAZE * radius) ** 2).sqrt()
        c = (column_norm(flat) / half).clamp(min=1.0)
    u = foot + flat / c
    lam: list[Tensor] = [c] * k
    for j in reversed(range(k)):
        rest = z[j] - c * y[j]
        for i in range(j + 1, k):
            rest = rest - R[i][j] * lam[i]
        lam[j] = rest / R[j][j]

    size, target = column_norm(u), norm(t)[:, None]
    length = torch.maximum(size, SCALE_FLOOR * (target if radius is None else target.clamp(max=radius)))
    primal = torch.baddbmm(-h[..., None], G, u.transpose(0, 1)).amax(1) / length.clamp(min=TINY)
    if radius is not None:
        primal = torch.maximum(primal, size / radius - 1)
    dual = torch.zeros_like(size)
    for x in lam:
        dual = torch.maximum(dual, -x)
    dual = dual / torch.maximum(target, size).clamp(min=TINY)
    ok = ok & torch.isfinite(primal) & torch.isfinite(dual)
    primal, dual = torch.where(ok, primal.clamp(min=0.0), torch.inf), torch.where(ok, dual, torch.inf)
    return u.permute(1, 2, 0), torch.stack(lam, -1) if k else c[..., None][..., :0], c, primal, dual


class Projection(NamedTuple):
    """Best candidate of every sample.

    Attributes:
        u: (B, n) candidate with the least max(primal, dual) violation.
        lam: (B, m) its row multipliers.
        c: (B,) its scale, one plus the ball multiplier.
        nearest: (B, n) candidate with the least primal violation.
        violation: (B,) that least primal violation, relative.
        sizes: (B,) int64 number of active-set sizes tried.
    """

    u: Tensor
    lam: Tensor
    c: Tensor
    nearest: Tensor
    violation: Tensor
    sizes: Tensor


def enumerate_projection(t: Tensor, G: Tensor, h: Tensor, radius: float | None, first: int = 0) -> Projection:
    """Project t on {G u ≤ h} ∩ ball by enumeration of active sets (module docstring).

    Args:
        t: (B, n) targets.
        G: (B, m, n) unit rows.
        h: (B, m).
        radius: ball radius or None.
        first: least size of the active sets; 1 where no target satisfies its rows and all lie in the ball.
    """
    (B, m, n) = G.shape
    inf = t.new_full((B,), torch.inf)
    best = Projection(t.clone(), t.new_zeros(B, m), t.new_ones(B), t.clone(), inf, torch.zeros_like(inf).long())
    score = inf.clone()
    rows, todo = torch.arange(m, device=t.device), torch.arange(B, device=t.device)
    for k in range(first, min(n, m) + 1):
        sets = torch.combinations(rows, k) if k else rows.new_zeros(1, 0)
        step = max(1, CHUNK_BYTES // (8 * len(sets) * (3 * m + n * (3 * k + 6))))
        for some in todo.split(step):
            u, lam, c, primal, dual = _candidates(t[some], G[some], h[some], sets, radius)
            low, j = torch.maximum(primal, dual).min(1)
            take = low < score[some]
            who, j = some[take], j[take]
            score[who] = low[take]
            best.u[who], best.c[who] = u[take, j], c[take, j]
            best.lam[who] = t.new_zeros(len(who), m).scatter(1, sets[j], lam[take, j])
            low, j = primal.min(1)
            closer = low < best.violation[some]
            best.violation[some[closer]] = low[closer]
            best.nearest[some[closer]] = u[closer, j[closer]]
        best.sizes[todo] = k + 1
        todo = todo[score[todo] > EARLY_STOP]
        if not len(todo):
            break
    return best


def enumerate_reachable(t: Tensor, G: Tensor, h: Tensor, radius: float | None) -> Projection:
    """:func:`enumerate_projection` without the rows that lie beyond the ball everywhere: they cannot bind."""
    m = G.shape[1]
    if radius is None:
        return enumerate_projection(t, G, h, radius)
    first = 0 if bool((norm(t) > radius).any()) else 1
    most = max(1, int((h < radius).sum(-1).max()))
    if most == m:
        return enumerate_projection(t, G, h, radius, first)
    rows = h.topk(most, dim=-1, largest=False).indices
    found = enumerate_projection(
        t, G.gather(1, rows[..., None].expand(-1, -1, t.shape[-1])), h.gather(1, rows), radius, first
    )
    return found._replace(lam=torch.zeros_like(h).scatter(1, rows, found.lam))
