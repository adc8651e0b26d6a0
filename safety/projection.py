"""Projection on half-spaces and a ball in one, two or three variables, without a search over active sets.

    min_u  ½ ‖u - t‖²    s.t.  G u ≤ h  and, optionally,  ‖u‖ ≤ radius,        u ∈ Rⁿ, n ≤ 3

The solution is the target itself, the target cut to the ball, or it lies on the boundary of a row. In the plane every
row's boundary is a line; on it, the other rows and the ball leave an interval, and the best point of the line is the
target's foot clamped to that interval: feasible by construction. The best of the m lines' points is the solution, m²
operations in all. In space the same holds for the lines in which two rows' planes meet, and a plane may hold the
solution in its inside: there the foot, cut to the disc in which the plane meets the ball, is a candidate.

No loops over samples or rows, no data-dependent shapes. Rounding can go wrong where rows are nearly parallel or more than
n of them meet in the solution; the caller sees that in the KKT residual and solves such samples by enumeration
(:mod:`safety.qp_exact`), which alone may call a sample infeasible.

Conventions as in :mod:`safety.qp_exact`: flat batch B, unit rows, a row that cannot bind is g = 0, h = 1. Components
first, ``(n, B, m)``: sums over them are additions of long contiguous runs.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

PARALLEL = 1e-11
"""Sine of the angle below which a row counts as parallel to a line."""
SLACK = 1e-10
"""Violation, relative to the lengths that occur, up to which a row parallel to a line, or an empty interval, is a rounding."""


class Nearest(NamedTuple):
    """Best candidate of every sample and its multipliers; +inf cost where there is none.

    Attributes:
        u: (B, n).
        lam: (B, m) row multipliers.
        c: (B,) one plus the ball multiplier.
    """

    u: Tensor
    lam: Tensor
    c: Tensor


def _sum(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products over the leading components, ``(n, ...), (n, ...) -> (...)``."""
    total = a[0] * b[0]
    for k in range(1, len(a)):
        total = torch.addcmul(total, a[k], b[k])
    return total


def _lines(g: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The lines that n - 1 rows leave: direction and foot of the origin ``(n, B, L)``, whether they exist ``(B, L)``.

    Also their row numbers ``(L, n - 1)``.
    """
    n, batch, m = g.shape
    rows = torch.arange(m, device=g.device)
    if n == 1:
        one = g.new_ones(1, batch, 1)
        return one, torch.zeros_like(one), one[0] > 0, rows.new_zeros(1, 0)
    if n == 2:
        return torch.stack([-g[1], g[0]]), h * g, (g[0] != 0) | (g[1] != 0), rows.unsqueeze(-1)
    pairs = torch.combinations(rows, 2)
    a, b = g[..., pairs[:, 0]], g[..., pairs[:, 1]]
    e = torch.linalg.cross(a, b, dim=0)
    size = _sum(e, e).sqrt()
    exists = size > PARALLEL
    size = torch.where(exists, size, 1.0)
    e = e / size
    foot = h[:, pairs[:, 0]] * torch.linalg.cross(b, e, dim=0) + h[:, pairs[:, 1]] * torch.linalg.cross(e, a, dim=0)
    return e, foot / size, exists, pairs


def nearest_on_lines(t: Tensor, G: Tensor, h: Tensor, radius: float | None) -> Nearest:
    """Nearest feasible point to ``t`` among the candidates of the module docstring.

    Args:
        t: (B, n) targets.
        G: (B, m, n) unit rows.
        h: (B, m).
        radius: ball radius or None.

    Returns:
        The best candidate; where there is none, something that violates the KKT conditions.
    """
    n, m = t.shape[-1], G.shape[1]
    if m < n - 1:  # no two planes meet in a line: add a row that cannot bind
        found = nearest_on_lines(
            t, torch.cat([G, torch.zeros_like(G)], 1), torch.cat([h, torch.ones_like(h)], 1), radius
        )
        return found._replace(lam=found.lam[:, :m])
    g, target = G.permute(2, 0, 1).contiguous(), t.mT.unsqueeze(-1)  # (n, B, m), (n, B, 1)
    e, foot, ok, sets = _lines(g, h)
    # every row's bound on the place along every line
    slope = _sum(e.unsqueeze(-1), g.unsqueeze(-2))  # (B, L, m)
    rest = h.unsqueeze(-2) - _sum(foot.unsqueeze(-1), g.unsqueeze(-2))
    size = _sum(foot, foot).sqrt()
    along = _sum(e, target)
    scale = size + along.abs()
    flat = slope.abs() <= PARALLEL
    bound = rest / slope
    high = torch.where(flat | (slope < 0), torch.inf, bound).amin(-1)
    low = torch.where(flat | (slope > 0), -torch.inf, bound).amax(-1)
    if radius is not None:
        half = ((radius - size) * (radius + size)).clamp_min(0).sqrt()
        ok = ok & (size <= radius * (1 + SLACK))
        low, high = torch.maximum(low, -half), torch.minimum(high, half)
        scale = scale.clamp_max(radius)
    ok = ok & ~(flat & (rest < -SLACK * scale.unsqueeze(-1))).any(-1) & (high - low >= -SLACK * scale)
    place = torch.minimum(torch.maximum(along, low), high)
    points = foot + e * place
    cost = torch.where(ok, _sum(points - target, points - target), torch.inf)
    line_cost, line = cost.min(-1, keepdim=True)
    # the chosen line, and what stopped the target on it
    chosen = line.expand(n, -1, -1)
    e, u, place, along = e.gather(-1, chosen), points.gather(-1, chosen), place.gather(-1, line), along.gather(-1, line)
    wide = line.unsqueeze(-1).expand(-1, -1, m)
    slope = slope.gather(1, wide).squeeze(1)  # (B, m)
    bound, flat = bound.gather(1, wide).squeeze(1), flat.gather(1, wide).squeeze(1)
    push = along - place
    stops = ~flat & (slope * push > 0)
    gap, stop = torch.where(stops, (bound - place).abs(), torch.inf).min(-1, keepdim=True)
    blocked = push != 0
    c = torch.ones_like(push)
    if radius is not None:
        at_ball = blocked & ((radius - _sum(u, u).sqrt()).abs() <= gap)
        c = torch.where(at_ball, (along / place).nan_to_num(1.0, 1.0, 1.0).clamp_min(1.0), c)
        blocked = blocked & ~at_ball
    force = torch.where(blocked, push / slope.gather(1, stop), 0.0)
    lam = torch.zeros_like(h).scatter(1, stop, force)
    pull = target - c * u - force * g.gather(-1, stop.expand(n, -1, -1))
    lam = _add_set(lam, pull, g, sets[line.squeeze(-1)])
    if n == 1 and radius is None:
        return Nearest(u.squeeze(-1).mT, lam, c.squeeze(-1))
    return _better_inside(Nearest(u.squeeze(-1).mT, lam, c.squeeze(-1)), line_cost, target, g, h, radius)


def _add_set(lam: Tensor, pull: Tensor, g: Tensor, sets: Tensor) -> Tensor:
    """Multipliers of the line's own rows ``sets (B, n - 1)``, by Gram-Schmidt: what is left of the force ``(n, B, 1)``."""
    if sets.shape[-1] == 0:
        return lam
    rows = g.gather(-1, sets.expand(len(g), -1, -1))  # (n, B, n - 1)
    first, last = rows[..., :1], rows[..., -1:]
    if sets.shape[-1] == 1:
        return lam.scatter_add(1, sets, _sum(first, pull))
    cosine = _sum(first, last)
    axis = last - cosine * first
    second = _sum(axis, pull) / _sum(axis, axis)
    return lam.scatter_add(1, sets, torch.cat([_sum(first, pull) - cosine * second, second], -1))


def _better_inside(best: Nearest, cost: Tensor, t: Tensor, g: Tensor, h: Tensor, radius: float | None) -> Nearest:
    """Replace the best point on a line ``(B, 1)`` cost by a nearer one inside a plane (n = 3) or on the ball alone."""
    if radius is not None:
        size = _sum(t, t).sqrt()
        c = (size / radius).clamp_min(1.0)
        best, cost = _choose(best, cost, t, t / c, c, torch.zeros_like(h).unsqueeze(1), g, h)
    if len(g) == 3:
        height = _sum(g, t) - h  # (B, m)
        flat = t - g * _sum(g, t)
        c = torch.ones_like(height)
        ok = (g != 0).any(0)
        if radius is not None:
            half = ((radius - h) * (radius + h)).clamp_min(0).sqrt()
            ok = ok & (half > 0)
            c = (_sum(flat, flat).sqrt() / torch.where(ok, half, 1.0)).clamp_min(1.0)
        u = torch.where(ok, g * h + flat / c, torch.inf)
        lam = torch.diag_embed(_sum(g, t) - c * h)
        best, cost = _choose(best, cost, t, u, c, lam, g, h)
    return best


def _choose(
    best: Nearest, cost: Tensor, t: Tensor, u: Tensor, c: Tensor, lam: Tensor, g: Tensor, h: Tensor
) -> tuple[Nearest, Tensor]:
    """Take the nearest feasible one of C candidates ``u (n, B, C), c (B, C), lam (B, C or 1, m)`` where it is better."""
    violation = (_sum(u.unsqueeze(-1), g.unsqueeze(-2)) - h.unsqueeze(-2)).amax(-1)
    gap = u - t
    offer = torch.where(violation <= SLACK * _sum(u, u).sqrt(), _sum(gap, gap), torch.inf)
    offer, index = offer.min(-1, keepdim=True)
    take = offer < cost
    u = u.gather(-1, index.expand(len(u), -1, -1)).squeeze(-1).mT
    lam = lam.gather(1, index.unsqueeze(-1).expand(-1, -1, lam.shape[-1])).squeeze(1)
    chosen = Nearest(
        torch.where(take, u, best.u),
        torch.where(take, lam, best.lam),
        torch.where(take, c.gather(1, index), best.c.unsqueeze(-1)).squeeze(-1),
    )
    return chosen, torch.minimum(offer, cost)
