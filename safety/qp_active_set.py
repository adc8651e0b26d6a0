"""Batched dual active-set method for projections on polyhedra, after Goldfarb & Idnani.

Source: D. Goldfarb, A. Idnani, "A numerically stable dual method for solving strictly convex quadratic programs",
Mathematical Programming 27 (1983), 1-33.

Every sample starts at its target, which is optimal for the empty set of rows, and takes in its most violated row g: with
N the active rows, z = Hg is the part of g orthogonal to them and r = N⁺g their share, so w - τz and λ - τr stay optimal
while the row's own multiplier grows with τ. Either the row is reached (full step, g becomes active), or a multiplier
reaches 0 first (partial step, that row is dropped and g tried again), or, if z = 0 and no multiplier falls, g and -r
prove that the rows contradict each other. The objective grows with every full step, so no set of rows occurs twice.

H = I - NN⁺ and N⁺, one slot per active row, are stacked in one (2n, n) matrix that changes by rank one in either step.
"""

from __future__ import annotations

import torch

from safety.kkt import norm
from safety.qp_joint import Found, Nearest, refutes, take_rows

DEPENDENT = 1e-9
"""Sine of the angle to the span of the active rows below which a row counts as linearly dependent on them."""
SATISFIED = 1e-13
"""Violation, relative to ‖t‖ + ‖w‖, that counts as rounding."""
CANCELLED = 1e-4
"""Squared length of z below which Hg is projected once more."""


def active_set(problem: Nearest) -> Found:
    """Project every target; each must violate a row. Finished samples leave the batch at once."""
    t, rows, bound = problem
    B, m, n = rows.shape
    found = Found(
        t.clone(),
        torch.zeros(B, n, dtype=torch.int64, device=t.device),
        t.new_zeros(B, n),
        torch.zeros(B, dtype=torch.bool, device=t.device),
        torch.zeros(B, dtype=torch.int64, device=t.device),
    )
    who, size = torch.arange(B, device=t.device), norm(t)
    state = torch.cat([t, found.lam], 1)  # w and the multipliers by slot
    picks, used = found.picks.clone(), torch.zeros_like(found.lam)
    row, own = found.steps.clone(), torch.zeros_like(size)  # entering row and its multiplier
    over = torch.zeros_like(found.infeasible)  # neither a step nor a row to drop
    again = over.clone()  # the entering row took a partial step and enters once more
    W = torch.cat([torch.eye(n, dtype=t.dtype, device=t.device), t.new_zeros(n, n)]).repeat(B, 1, 1)
    every, partial, stuck = who, False, False
    for step in range(10 * (n + m) + 1):
        w = state[:, :n]
        excess = torch.bmm(rows, w[..., None])[..., 0] - bound
        gap, worst = excess.max(1)
        live = gap > SATISFIED * (size + norm(w))
        if partial:
            live = live | again
            gap = torch.where(again, excess.gather(1, row[:, None])[:, 0].clamp(min=0.0), gap)
            worst = torch.where(again, row, worst)
        if stuck:
            live = live & ~over
        row = worst
        keep = live.nonzero()[:, 0]
        if len(keep) < len(who):
            out = (~live).nonzero()[:, 0]
            gone = who[out]
            found.w[gone], found.lam[gone], found.picks[gone] = state[out, :n], state[out, n:], picks[out]
            found.steps[gone] = step
            if not len(keep):
                return found
            who, rows, bound, size, state, W = (x[keep] for x in (who, rows, bound, size, state, W))
            picks, used, row, own, gap = (x[keep] for x in (picks, used, row, own, gap))
        each = every[: len(who)]
        d = torch.bmm(W, rows[each, row][..., None])[..., 0]
        z, r = d[:, :n], d[:, n:]
        zz = (z * z).sum(-1)
        if bool((zz < CANCELLED).any()):
            z = torch.bmm(W[:, :n], z[..., None])[..., 0]
            zz = (z * z).sum(-1)
            d = torch.cat([z, r], 1)
        taken, slot = used.min(1)
        reach = torch.where((zz > DEPENDENT**2) & (taken == 0), gap / zz, torch.inf)
        stop, blocking = torch.where(r > 1e-12, state[:, n:] / r, torch.inf).min(1)
        again = stop < reach
        length = torch.minimum(stop, reach)
        over = length.isinf()
        stuck = bool(over.any())
        if stuck:  # what happens below to the other quantities of these samples does not matter
            i = over.nonzero()[:, 0]
            ray = torch.cat([-r[i], torch.ones_like(zz[i, None])], 1).clamp(min=0.0)
            some = torch.cat([picks[i], row[i, None]], 1)
            span = size[i] + norm(state[i, :n])
            found.infeasible[who[i]] = refutes(take_rows(rows[i], some), bound[i].gather(1, some), ray, span)
            length = torch.where(over, 0.0, length)
        state = state - length[:, None] * d
        state[:, n:].clamp_(min=0.0)
        own = own + length
        # One rank-one change W - v xᵀ/xᵀx: x = z, v = (z, r - e) takes the row in at the slot e,
        x, v = z, d.index_put((each, n + slot), -torch.ones_like(own))
        drop = again.nonzero()[:, 0]
        partial = len(drop) > 0
        if partial:  # and x = N⁺_l, v = (-x, N⁺x) drops the row of slot l.
            slot = torch.where(again, blocking, slot)
            inside = W[drop]
            a = inside[every[: len(drop)], n + slot[drop]]
            v[drop] = torch.cat([-a, torch.bmm(inside[:, n:], a[..., None])[..., 0]], 1)
            x, zz = x.index_put((drop,), a), zz.index_put((drop,), (a * a).sum(-1))
        W.baddbmm_((v / zz[:, None])[..., None], x[:, None], alpha=-1.0)
        state[each, n + slot] = torch.where(again, 0.0, own)
        used[each, slot] = (~again).to(used.dtype)
        picks[each, slot] = row
        own = torch.where(again, own, 0.0)
    found.w[who], found.lam[who], found.picks[who], found.steps[who] = state[:, :n], state[:, n:], picks, step
    return found
