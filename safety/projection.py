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

Conventions as in :mod:`safety.qp_exact`: flat batch B, unit rows, a row that cannot bind is g = 0, h = 1. Inside, the
batch is the last dimension: all loops run along it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from envs.dynamics import dot, pair_indices
from safety.kkt import norm

PARALLEL = 1e-11
"""Sine of the angle below which a row counts as parallel to a line."""
SLACK = 1e-10
"""Violation, relative to the lengths that occur, up to which a row parallel to a line, or an empty interval, is a rounding."""
ROUND = 1e-14
"""Violation, relative to the length, up to which the foot on one row satisfies the others."""


class Projected(NamedTuple):
    """Best candidate of every sample and its multipliers.

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
    """The lines that n - 1 rows ``g (n, m, B), h (m, B)`` leave: direction and foot of the origin ``(n, L, B)``.

    Also whether they exist ``(L, B)``, and their row numbers ``(L, n - 1)``.
    """
    n, m, _ = g.shape
    rows = torch.arange(m, device=g.device)
    if n == 1:
        one = torch.ones_like(g[:, :1])
        return one, torch.zeros_like(one), one[0] > 0, rows.new_zeros(1, 0)
    if n == 2:
        return torch.stack([-g[1], g[0]]), h * g, (g[0] != 0) | (g[1] != 0), rows.unsqueeze(-1)
    pairs = torch.stack(pair_indices(len(rows), rows.device), dim=1)
    a, b = g[:, pairs[:, 0]], g[:, pairs[:, 1]]
    e = torch.linalg.cross(a, b, dim=0)
    size = _sum(e, e).sqrt()
    exists = size > PARALLEL
    size = torch.where(exists, size, 1.0)
    e = e / size
    foot = h[pairs[:, 0]] * torch.linalg.cross(b, e, dim=0) + h[pairs[:, 1]] * torch.linalg.cross(e, a, dim=0)
    return e, foot / size, exists, pairs


def nearest_on_one_row(t: Tensor, G: Tensor, h: Tensor, radius: float | None) -> tuple[Projected, Tensor]:
    """Nearest point to ``t`` on the row that it violates most, in the ball, and whether it solves the whole problem.

    Most filter problems need no more: one robot, one row, and the speed limit. Arguments as :func:`nearest_on_lines`.
    """
    worst, row = (dot(G, t.unsqueeze(1)) - h).max(-1, keepdim=True)
    normal = G.gather(1, row.unsqueeze(-1).expand(-1, -1, G.shape[-1])).squeeze(1)
    bound, c = h.gather(1, row), torch.ones_like(worst)
    flat = t - (worst + bound) * normal
    if radius is not None:
        half = ((radius - bound) * (radius + bound)).clamp_min((SLACK * radius) ** 2).sqrt()
        c = (norm(flat).unsqueeze(-1) / half).clamp_min(1.0)
    u, force = bound * normal + flat / c, worst + (1 - c) * bound
    size = norm(u)
    done = (worst > 0).squeeze(-1) & (force >= 0).squeeze(-1)
    done = done & ((dot(G, u.unsqueeze(1)) - h).amax(-1) <= ROUND * size)
    if radius is not None:
        done = done & (size <= radius * (1 + ROUND))
    return Projected(u, torch.zeros_like(h).scatter(1, row, force), c.squeeze(-1)), done


def nearest_on_lines(t: Tensor, G: Tensor, h: Tensor, radius: float | None) -> Projected:
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
        rows = torch.cat([G, torch.zeros_like(G)], 1), torch.cat([h, torch.ones_like(h)], 1)
        found = nearest_on_lines(t, *rows, radius)
        return found._replace(lam=found.lam[:, :m])
    g, h, target = G.permute(2, 1, 0).contiguous(), h.mT.contiguous(), t.mT.contiguous().unsqueeze(1)
    e, foot, ok, sets = _lines(g, h)  # (n, L, B)
    # every row's bound on the place along every line
    slope = _sum(e.unsqueeze(2), g.unsqueeze(1))  # (L, m, B)
    rest = h - _sum(foot.unsqueeze(2), g.unsqueeze(1))
    size = _sum(foot, foot).sqrt()
    along = _sum(e, target)  # (L, B)
    scale = size + along.abs()
    flat = slope.abs() <= PARALLEL
    bound = rest / slope
    high = torch.where(flat | (slope < 0), torch.inf, bound).amin(1)
    low = torch.where(flat | (slope > 0), -torch.inf, bound).amax(1)
    if radius is not None:
        half = ((radius - size) * (radius + size)).clamp_min(0).sqrt()
        ok = ok & (size <= radius * (1 + SLACK))
        low, high = torch.maximum(low, -half), torch.minimum(high, half)
        scale = scale.clamp_max(radius)
    ok = ok & ~(flat & (rest < -SLACK * scale.unsqueeze(1))).any(1) & (high - low >= -SLACK * scale)
    place = torch.minimum(torch.maximum(along, low), high)
    points = torch.addcmul(foot, e, place)
    gap = points - target
    cost, line = torch.where(ok, _sum(gap, gap), torch.inf).min(0, keepdim=True)  # (1, B)
    # the chosen line, and what stopped the target on it
    u = points.gather(1, line.expand(n, 1, -1))
    place, along = place.gather(0, line), along.gather(0, line)
    wide = line.unsqueeze(1).expand(1, m, -1)
    slope, bound, flat = (x.gather(0, wide).squeeze(0) for x in (slope, bound, flat))  # (m, B)
    push = along - place
    stops = ~flat & (slope * push > 0)
    gap, stop = torch.where(stops, (bound - place).abs(), torch.inf).min(0, keepdim=True)
    blocked = push != 0
    c = torch.ones_like(push)
    if radius is not None:
        at_ball = blocked & ((radius - _sum(u, u).sqrt()).abs() <= gap)
        c = torch.where(at_ball, (along / place).nan_to_num(1.0, 1.0, 1.0).clamp_min(1.0), c)
        blocked = blocked & ~at_ball
    force = torch.where(blocked, push / slope.gather(0, stop), 0.0)
    lam = torch.zeros_like(h).scatter(0, stop, force)
    pull = target - c * u - force * g.gather(1, stop.expand(n, 1, -1))
    lam = _add_set(lam, pull, g, sets[line[0]].mT)
    best = (u, lam, c)
    if radius is not None:
        c = (_sum(target, target).sqrt() / radius).clamp_min(1.0)
        best, cost = _choose(best, cost, target, target / c, c, torch.zeros_like(h).unsqueeze(0), g, h)
    if n == 3:
        best, _ = _choose(best, cost, target, *_in_planes(target, g, h, radius), g, h)
    u, lam, c = best
    return Projected(u[:, 0].mT, lam.mT, c[0])


def _add_set(lam: Tensor, pull: Tensor, g: Tensor, sets: Tensor) -> Tensor:
    """Multipliers of the line's own rows ``sets (n - 1, B)``, by Gram-Schmidt: what is left of the force ``(n, 1, B)``."""
    if len(sets) == 0:
        return lam
    rows = g.gather(1, sets.expand(len(g), -1, -1))  # (n, n - 1, B)
    first, last = rows[:, :1], rows[:, -1:]
    if len(sets) == 1:
        return lam.scatter_add(0, sets, _sum(first, pull))
    cosine = _sum(first, last)
    axis = last - cosine * first
    second = _sum(axis, pull) / _sum(axis, axis)
    return lam.scatter_add(0, sets, torch.cat([_sum(first, pull) - cosine * second, second]))


def _in_planes(t: Tensor, g: Tensor, h: Tensor, radius: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """The target's foot in every row's plane, cut to the ball: ``u (3, m, B)``, ``c (m, B)`` and multipliers ``(m, m, B)``."""
    reach = _sum(g, t)  # (m, B)
    flat = t - g * reach
    c, ok = torch.ones_like(reach), (g != 0).any(0)
    if radius is not None:
        half = ((radius - h) * (radius + h)).clamp_min(0).sqrt()
        ok = ok & (half > 0)
        c = (_sum(flat, flat).sqrt() / torch.where(ok, half, 1.0)).clamp_min(1.0)
    u = torch.where(ok, g * h + flat / c, torch.inf)
    return u, c, torch.diag_embed((reach - c * h).mT).permute(1, 2, 0)


def _choose(
    best: tuple[Tensor, Tensor, Tensor],
    cost: Tensor,
    t: Tensor,
    u: Tensor,
    c: Tensor,
    lam: Tensor,
    g: Tensor,
    h: Tensor,
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Take the nearest feasible one of C candidates ``u (n, C, B), c (C, B), lam (C, m, B)`` where it beats the best."""
    violation = (_sum(u.unsqueeze(2), g.unsqueeze(1)) - h).amax(1)
    gap = u - t
    offer = torch.where(violation <= SLACK * _sum(u, u).sqrt(), _sum(gap, gap), torch.inf)
    offer, index = offer.min(0, keepdim=True)
    take = offer < cost
    u = u.gather(1, index.expand(len(u), 1, -1))
    lam = lam.gather(0, index.unsqueeze(1).expand(1, len(h), -1)).squeeze(0)
    best_u, best_lam, best_c = best
    chosen = (
        torch.where(take, u, best_u),
        torch.where(take, lam, best_lam),
        torch.where(take, c.gather(0, index), best_c),
    )
    return chosen, torch.minimum(offer, cost)
