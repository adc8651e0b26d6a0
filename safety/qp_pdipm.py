"""Batched primal-dual interior-point method for projections on polyhedra, with n x n systems.

Source: S. Mehrotra, "On the implementation of a primal-dual interior point method", SIAM Journal on Optimization 2
(1992), 575-601; reduction to the normal matrix as in Nocedal & Wright, "Numerical Optimization" (2006), section 16.6.

In x = (w - t)/e, e the largest violation at the target, the problem is min ½‖x‖² s.t. rows·x + s = c, s ≥ 0, with every
length of order one except slack bounds, which are capped. Newton's equations reduce to (I + rowsᵀ diag(z/s) rows) dx, so
a step costs O(m n²) and a Cholesky factorisation of size n, where qpth factorises a matrix of size m.
"""

from __future__ import annotations

import torch
from torch import Tensor

from safety.kkt import norm
from safety.qp_active_set import active_set
from safety.qp_joint import Found, Nearest, gather_rows, refutes

STEPS = 60
"""Most Newton steps; 8 to 15 are usual."""
CONVERGED, ROUGH = 1e-13, 1e-6
"""s·z and residuals at which the rows near the solution are told from the others."""
LOST = 1e-18
"""s·z at which the normal matrix is too ill-conditioned to go on."""
NEAR = 1e-4
"""Rows with z > 1e-4 s are near: z s is at most 1e-13, so a slack of 3e-5 or a multiplier above 3e-9."""
FARTHEST = 1e8  # cap of the slack bounds, over the largest violation


def interior_point(problem: Nearest) -> Found:
    """Project every target. The active rows, z > s, are few; the others' multipliers are dropped."""
    t, rows, bound = problem
    (B, _, n), device = rows.shape, t.device
    room = torch.baddbmm(bound[..., None], rows, t[..., None], alpha=-1.0)[..., 0]
    unit = -room.amin(1)
    unit = torch.where((unit > 0) & unit.isfinite(), unit, 1.0)
    c = (room / unit[:, None]).clamp(max=FARTHEST)
    span = 1.0 + norm(t) / unit  # of the problem, in these units
    x, s = torch.zeros_like(t), c.clamp(min=1.0)
    z = 1 / s
    last_s, last_z, sound = s.clone(), z.clone(), torch.ones_like(x[:, :1], dtype=torch.bool)
    infeasible = torch.zeros(B, dtype=torch.bool, device=device)
    steps = torch.zeros(B, dtype=torch.int64, device=device)
    who = torch.arange(B, device=device)
    eye = torch.eye(n, dtype=t.dtype, device=device)
    for _ in range(STEPS):
        primal = c - times(rows, x) - s
        pull = times(rows.mT, z)
        dual = -x - pull
        far = torch.maximum(norm(x), torch.ones_like(x[:, 0]))
        error = torch.maximum(primal.abs().amax(1), norm(dual)) / far
        worst = (s * z).amax(1) / far.square()
        # the noise of the slack rows would swamp boundᵀz
        ray = torch.where(z > 1e-8 * z.amax(1, keepdim=True), z, 0.0)
        hopeless = refutes(rows, c, ray, span)
        infeasible[who] = hopeless
        done = ~sound[:, 0] | ((worst <= CONVERGED) & (error <= ROUGH)) | (worst <= LOST) | hopeless | ~error.isfinite()
        if bool(done.any()):
            last_s[who], last_z[who] = s, z
            keep = (~done).nonzero()[:, 0]
            if not len(keep):
                break
            who, x, s, z, c, rows, primal, dual, span = (y[keep] for y in (who, x, s, z, c, rows, primal, dual, span))
        steps[who] += 1
        slope = z / s
        H = torch.baddbmm(eye, rows.mT, slope[..., None] * rows)
        L, _ = torch.linalg.cholesky_ex(H)
        mu = (s * z).mean(1, keepdim=True)
        ds, dz = newton(L, rows, s, z, primal, dual, -s * z)[1:]
        length = step_length(s, ds, z, dz)
        ahead = ((s + length * ds) * (z + length * dz)).mean(1, keepdim=True)
        center = (ahead / mu).pow(3) * mu
        dx, ds, dz = newton(L, rows, s, z, primal, dual, center - s * z - ds * dz)
        length = 0.995 * step_length(s, ds, z, dz)
        # Near the solution the factorisation may break down; the iterate before that is near enough.
        sound = (dx.isfinite().all(1) & dz.isfinite().all(1))[:, None]
        x, s, z = (torch.where(sound, y + length * dy, y) for y, dy in ((x, dx), (s, ds), (z, dz)))
    else:
        last_s[who], last_z[who] = s, z
    # Crossover: the rows near the solution, solved exactly.
    sample, row, slot, k = gather_rows(last_z > NEAR * last_s)
    near, level = t.new_zeros(B, k, n), t.new_full((B, k), torch.inf)
    near[sample, slot], level[sample, slot] = problem.rows[sample, row], bound[sample, row]
    number = steps.new_zeros(B, k).index_put((sample, slot), row)
    found = active_set(Nearest(t, near, level))
    return found._replace(picks=number.gather(1, found.picks), infeasible=infeasible | found.infeasible, steps=steps)


def times(A: Tensor, x: Tensor) -> Tensor:
    """Matrix times vector."""
    return torch.bmm(A, x[..., None])[..., 0]


def newton(
    L: Tensor, rows: Tensor, s: Tensor, z: Tensor, primal: Tensor, dual: Tensor, comp: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve rows dx + ds = primal, dx + rowsᵀdz = dual, z ds + s dz = comp; L factorises I + rowsᵀ diag(z/s) rows."""
    lead = (comp - z * primal) / s
    dx = torch.cholesky_solve((dual - times(rows.mT, lead))[..., None], L)[..., 0]
    move = times(rows, dx)
    return dx, primal - move, lead + z / s * move


def step_length(s: Tensor, ds: Tensor, z: Tensor, dz: Tensor) -> Tensor:
    """Longest step in [0, 1] with s + step ds ≥ 0 and z + step dz ≥ 0: (b, 1)."""
    shrink = torch.maximum((-ds / s).amax(1, keepdim=True), (-dz / z).amax(1, keepdim=True))
    return 1 / shrink.clamp(min=1.0)
