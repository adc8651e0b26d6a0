"""Batched, differentiable, guarded quadratic programmes for the safety filter.

Problem, one per sample:

    min_u  ½ uᵀQu + pᵀu    s.t.  G u ≤ h,    and for the exact solver optionally  ‖u‖ ≤ radius

Q is symmetric positive definite (only its symmetric part matters), `dual` holds the multipliers λ ≥ 0 of G u ≤ h with
Qu + p + Gᵀλ + μu = 0, μ ≥ 0 belonging to the ball. h = +inf means no constraint, a zero row is ignored if h ≥ 0 and
makes the sample INFEASIBLE otherwise. Every tensor may have any batch shape; they are broadcast against each other.

Four solvers, the same guarantees:

* "exact", n ≤ 3 (safety/qp_exact.py): closed forms for the projection (`project_halfspaces_ball`, its hot path), enumeration
  of active sets otherwise.
* "active_set", any n: dual active-set method (safety/qp_active_set.py), for the joint problems of many robots.
* "pdipm", any n: interior-point method with n x n systems (safety/qp_pdipm.py), then the active set of the rows near its
  solution. Slower, but its steps hardly grow with the number of active rows.
* "qpth", any n: the batched interior-point method of Amos & Kolter, "OptNet" (ICML 2017). Stock qpth is silently wrong
  on up to a third of barrier QPs, mostly for a fault in its step length; the guard mends that, scales the problem, caps
  slack bounds, polishes the active set, and checks against the problem as it was given. Kept as a reference.

Whatever the solver, the KKT residual of the given problem, recomputed in float64, decides SOLVED; see `KKT_TOL`. All
arithmetic is float64 inside, so float32 results are correctly rounded solutions for the float32 data (the residual is
that of the solution before rounding). Nothing returned is NaN; where the status is not SOLVED the value is finite,
inside the ball, must not be executed, and its gradient is zero.

Gradients of `value` follow from implicit differentiation of the KKT system at the solution; the other outputs carry
none, and there is no double backward. Rows (and the ball) whose multiplier is at most KKT_TOL relative count as
inactive: at a weakly active row, where the solution map has a kink, the derivative of the inactive side is returned.
Of linearly dependent active rows one maximal independent subset carries the gradient.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from qpth.solvers.pdipm import batch as pdipm
from torch import Tensor

from safety.kkt import QPStatus, Raw, kkt_residual, norm, normalise_rows
from safety.qp_active_set import active_set
from safety.qp_exact import CHUNK_BYTES, Metric, settle, solve_exact
from safety.qp_joint import differentiate, polish, solve_joint
from safety.qp_pdipm import interior_point

__all__ = ["KKT_TOL", "QPSolution", "QPStatus", "project_halfspaces_ball", "solve_qp"]

KKT_TOL = {torch.float32: 1e-6, torch.float64: 1e-7}
"""Largest relative KKT residual (`safety.kkt.kkt_residual`) that counts as SOLVED, by dtype of the input."""

_JOINT = {"active_set": active_set, "pdipm": interior_point}
_SOLVERS = ("exact", "qpth", *_JOINT)
_CAP = 1.5  # slack rows end up at this multiple of the most they can need, given the bound on |u|
_BOUND_FACTORS = (1.0, 1.0, 10.0, 2.0, 100.0, 0.5, 1000.0, 3.0)
"""Bounds on |u| to try, over the a-priori one. 1 comes twice: one sample that breaks down stops qpth for its whole batch."""
_QPTH = {"eps": 1e-13, "verbose": -1, "notImprovedLim": 5, "maxIter": 60}
_PHASE1_WEIGHT = 1e-8  # of ‖u‖² against t²
_PHASE1_GAP = 1e-6  # least violation that the infeasibility certificate must show, in units of the bound on |u|
_PHASE1_REACH = 10.0  # the certificate excludes solutions up to this many times the bound on |u|


class QPSolution(NamedTuple):
    """Solution of a batch of QPs.

    Attributes:
        value: (*B, n) minimiser, unit of u; differentiable.
        dual: (*B, m) multipliers of G u ≤ h, ≥ 0.
        status: (*B,) int64, a `QPStatus`.
        residual: (*B,) relative KKT residual.
        iterations: (*B,) int64; 0 where the unconstrained minimiser was feasible, else: "exact": 1 for a closed form,
            1 + the active-set sizes enumerated, or steps of the ball multiplier search; "active_set" and "pdipm":
            iterations; "qpth": interior-point solves, as qpth does not tell its iterations.
    """

    value: Tensor
    dual: Tensor
    status: Tensor
    residual: Tensor
    iterations: Tensor


def solve_qp(
    Q: Tensor, p: Tensor, G: Tensor, h: Tensor, *, radius: float | None = None, solver: str = "exact"
) -> QPSolution:
    """Minimise ½ uᵀQu + pᵀu subject to G u ≤ h and, for the exact solver, ‖u‖ ≤ radius.

    Args:
        Q: (*B, n, n) symmetric positive definite.
        p: (*B, n).
        G: (*B, m, n), m ≥ 0.
        h: (*B, m), +inf for no constraint.
        radius: radius of the ball, unit of u; None for no ball.
        solver: "exact" (n ≤ 3), "active_set", "pdipm" or "qpth" (any n, no ball).

    Returns:
        The solution; `value` is differentiable in all four tensors, gradients of unbatched inputs are summed.

    Raises:
        ValueError: unknown solver, a radius that is not finite and positive or given to another than the exact
            solver, n > 3 for that one, shapes that do not fit, mixed or unsupported dtypes, mixed devices.
    """
    if solver not in _SOLVERS:
        raise ValueError(f"unknown solver {solver!r}, allowed: {', '.join(_SOLVERS)}")
    if Q.ndim < 2 or Q.shape[-1] != Q.shape[-2]:
        raise ValueError(f"Q must be (*B, n, n), got {tuple(Q.shape)}")
    if p.ndim < 1 or p.shape[-1] != Q.shape[-1]:
        raise ValueError(f"p must be (*B, {Q.shape[-1]}) to fit Q {tuple(Q.shape)}, got {tuple(p.shape)}")
    return _solve(Q, p, G, h, radius, solver)


def project_halfspaces_ball(
    target: Tensor, G: Tensor, h: Tensor, radius: float, *, fixed_sizes: bool = False
) -> QPSolution:
    """Nearest point to `target` with G u ≤ h and ‖u‖ ≤ radius, by the exact solver.

    A target that already satisfies everything comes back bit for bit, with an identity gradient.

    Args:
        target: (*B, n), n ≤ 3, unit of u.
        G: (*B, m, n).
        h: (*B, m), +inf for no constraint.
        radius: radius of the ball, unit of u.
        fixed_sizes: let no size depend on the data, so that a GPU's host never waits: without the enumeration, so that what
            the closed forms do not solve to `KKT_TOL`, problems without solution among them, is INACCURATE. Backward waits.

    Returns:
        The solution, differentiable in target, G and h.

    Raises:
        ValueError: as `solve_qp`; also if radius is None.
    """
    if radius is None:
        raise ValueError("radius must be given")
    if target.ndim < 1:
        raise ValueError(f"target must be (*B, n), got {tuple(target.shape)}")
    return _solve(None, -target, G, h, radius, "exact", fixed_sizes)


def _solve(
    Q: Tensor | None, p: Tensor, G: Tensor, h: Tensor, radius: float | None, solver: str, fixed_sizes: bool = False
) -> QPSolution:
    """Check what both public functions share, flatten the batch, solve, restore the batch shape."""
    n = p.shape[-1]
    if n < 1 or (solver == "exact" and n > 3):
        raise ValueError(f"solver {solver!r} cannot take n = {n}")
    if G.ndim < 2 or G.shape[-1] != n:
        raise ValueError(f"G must be (*B, m, {n}), got {tuple(G.shape)}")
    if h.ndim < 1 or h.shape[-1] != G.shape[-2]:
        raise ValueError(f"h must be (*B, {G.shape[-2]}) to fit G {tuple(G.shape)}, got {tuple(h.shape)}")
    tensors = [x for x in (Q, p, G, h) if x is not None]
    if p.dtype not in KKT_TOL or any(x.dtype != p.dtype or x.device != p.device for x in tensors):
        kinds = ", ".join(f"{x.dtype} on {x.device}" for x in tensors)
        raise ValueError(f"inputs must share one device and one dtype, float32 or float64; got {kinds}")
    if radius is not None:
        if solver != "exact":
            raise ValueError(f"solver {solver!r} takes no radius")
        if not (math.isfinite(radius) and radius > 0):
            raise ValueError(f"radius must be finite and positive, got {radius}")
    shapes = [G.shape[:-2], h.shape[:-1], p.shape[:-1], *([] if Q is None else [Q.shape[:-2]])]
    try:
        batch = torch.broadcast_shapes(*shapes)
    except RuntimeError as error:
        raise ValueError(f"batch shapes {[tuple(s) for s in shapes]} do not broadcast") from error

    def flat(x: Tensor, trailing: int) -> Tensor:
        # Expanding outside the autograd function is what makes gradients of unbatched inputs sums over the batch.
        tail = x.shape[x.ndim - trailing :]
        return x.expand(*batch, *tail).reshape(math.prod(batch), *tail)

    matrix = None if Q is None else flat(Q, 2)
    outputs = _SolveQP.apply(matrix, flat(p, 1), flat(G, 2), flat(h, 1), radius, solver, fixed_sizes)
    return QPSolution(*(x.reshape(batch + x.shape[1:]) for x in outputs))


def _usable(p: Tensor, G: Tensor, h: Tensor) -> Tensor:
    """Samples (B,) with finite p and G, and bounds that are numbers or +inf."""
    return p.isfinite().all(-1) & G.isfinite().all(-1).all(-1) & (h > -torch.inf).all(-1)


def _solve_fixed(p: Tensor, G: Tensor, h: Tensor, radius: float) -> Raw:
    """:func:`_solve_flat` of a projection at fixed sizes; samples with non-finite input take part as harmless ones."""
    tol, (p, G, h) = KKT_TOL[p.dtype], (p.double(), G.double(), h.double())
    good = _usable(p, G, h)
    p, G, h = (
        torch.where(good[:, None], p, 0.0),
        torch.where(good[:, None, None], G, 0.0),
        torch.where(good[:, None], h, 1.0),
    )
    raw = solve_exact(None, p, G, h, radius, tol, fixed_sizes=True)
    status = torch.where(good, raw.status, QPStatus.INACCURATE.value)
    return raw._replace(status=status, residual=torch.where(good, raw.residual, torch.inf))


def _solve_flat(Q: Tensor | None, p: Tensor, G: Tensor, h: Tensor, radius: float | None, solver: str) -> Raw:
    """Solve a flat batch of any floating dtype in float64; samples with non-finite input are set aside."""
    tol = KKT_TOL[p.dtype]
    if Q is not None:
        shared = len(Q) > 1 and Q.stride(0) == 0  # expanded: one matrix to look at
        Q = (Q[:1] if shared else Q).double()
        Q = ((Q + Q.mT) / 2).expand(len(p), -1, -1)
    p, G, h = p.double(), G.double(), h.double()
    index, count = None, len(p)
    # A sum is finite only if all its terms are, and ten times cheaper than asking each.
    sums = [x.sum().isfinite() for x in (Q, p, G) if x is not None]
    if not bool(torch.stack([*sums, (h > -torch.inf).all()]).all()):
        good = _usable(p, G, h)
        if Q is not None:
            good = good & Q.isfinite().all(-1).all(-1)
        index = good.nonzero()[:, 0]
        Q, p, G, h = None if Q is None else Q[index], p[index], G[index], h[index]
    if Q is None or solver == "exact":
        part = solve_exact(Q, p, G, h, radius, tol)
    elif solver == "qpth":
        part = _solve_qpth(Q, p, G, h, tol)
    else:
        part = solve_joint(None if _is_identity(Q) else Q, p, G, h, tol, _JOINT[solver])
    if index is None:
        return part
    raw = Raw.blank(part.u.new_zeros(count, part.u.shape[-1]), part.lam.shape[-1])
    raw.status.fill_(QPStatus.INACCURATE.value)
    raw.residual.fill_(torch.inf)
    raw.put(index, part)
    return raw


def _is_identity(Q: Tensor) -> bool:
    """Whether every matrix of (B, n, n) is the identity."""
    Q = Q[:1] if Q.stride(0) == 0 else Q
    return bool((torch.eye(Q.shape[-1], dtype=Q.dtype, device=Q.device) == Q).all())


class _SolveQP(torch.autograd.Function):
    """Flat batch in, tuple of the fields of QPSolution out; Q None is the identity."""

    @staticmethod
    def forward(
        ctx: Any,
        Q: Tensor | None,
        p: Tensor,
        G: Tensor,
        h: Tensor,
        radius: float | None,
        solver: str,
        fixed_sizes: bool,
    ) -> tuple[Tensor, ...]:
        """Solve and remember the solution in float64."""
        raw = _solve_fixed(p, G, h, radius) if fixed_sizes else _solve_flat(Q, p, G, h, radius, solver)
        value, top = raw.u.to(p.dtype), torch.finfo(p.dtype).max
        lost = ~value.isfinite().all(-1)  # overflow, in float64 or on the way back to float32
        value = torch.where(lost[:, None], 0.0, value)
        status = torch.where(lost, QPStatus.INACCURATE.value, raw.status)
        residual = torch.where(lost, torch.inf, raw.residual).to(p.dtype)
        dual = torch.nan_to_num(raw.lam, 0.0).clamp(0.0, top).to(p.dtype)
        ctx.save_for_backward(Q, p, G, raw.u, raw.lam, raw.mu, status)
        ctx.mark_non_differentiable(dual, status, residual, raw.iterations)
        return value, dual, status, residual, raw.iterations

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients by implicit differentiation, see `differentiate`."""
        Q, p, G, u, lam, mu, status = ctx.saved_tensors
        solved = status == QPStatus.SOLVED.value
        rows_too = ctx.needs_input_grad[2] or ctx.needs_input_grad[3]
        identity = Q is None or _is_identity(Q)
        result = differentiate(Q, p, G, u, lam, mu, solved, grads[0], KKT_TOL[p.dtype], identity, rows_too)
        return *result, None, None, None


def _step_to_boundary(v: Tensor, dv: Tensor) -> Tensor:
    """Longest step with v + step dv ≥ 0, (B, m), (B, m) -> (B,). qpth's own is -inf, and all is NaN, where a dv is 0."""
    return torch.where(dv < 0, -v / dv, 1e6).amin(1)


def _interior_point(Q: Tensor, p: Tensor, G: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Run qpth, mended and quiet: u (B, n), multipliers (B, m), slacks (B, m); 0, 0, 1 where it broke down."""
    parts, none = [], Q.new_empty(0)
    step = max(1, CHUNK_BYTES // (8 * 8 * G.shape[1] ** 2))
    for q, c, rows, b in zip(Q.split(step), p.split(step), G.split(step), h.split(step), strict=True):
        pdipm.factor_kkt_eye = None  # a global that qpth reuses by shape only, whatever the device
        stock, pdipm.get_step = pdipm.get_step, _step_to_boundary
        try:
            x, _, z, s = pdipm.forward(q, c, rows, b, none, none, *pdipm.pre_factor_kkt(q, rows, none), **_QPTH)
        except RuntimeError:  # singular to the last bit; the guard sees a failed sample and tries again
            x = z = s = None
        finally:
            pdipm.get_step = stock
        parts.append((torch.zeros_like(c), torch.zeros_like(b), torch.ones_like(b)) if x is None else (x, z, s))
    x, z, s = (torch.cat(column) for column in zip(*parts, strict=True))
    return torch.nan_to_num(x, 0.0, 0.0, 0.0), torch.nan_to_num(z, 0.0, 0.0, 0.0), torch.nan_to_num(s, 1.0, 1.0, 1.0)


def _prove_infeasible(G: Tensor, h: Tensor) -> Tensor:
    """Whether G w ≤ h has no solution with ‖w‖ ≤ 10 (units: the a-priori bound on |w|), as a Farkas certificate.

    Phase 1, min ½t² + ½·1e-8 ‖w‖² s.t. G w - t ≤ h, supplies weights z ≥ 0. If hᵀz + 10 ‖Gᵀz‖ < 0 no such w exists,
    however well or badly phase 1 was solved.
    """
    B, m, n = G.shape
    Q = torch.eye(n + 1, dtype=G.dtype, device=G.device) * _PHASE1_WEIGHT
    Q[n, n] = 1.0
    rows = torch.cat([G, -G.new_ones(B, m, 1)], -1)
    capped = torch.minimum(h, torch.where(G.any(-1), 1e3 * G.abs().sum(-1), 1.0))
    _, z, _ = _interior_point(Q.expand(B, -1, -1).contiguous(), G.new_zeros(B, n + 1), rows, capped)
    z = torch.where(z > 1e-8 * z.amax(-1, keepdim=True), z, 0.0)  # the noise on slack rows would swamp hᵀz
    total = z.sum(-1).clamp(min=1e-300)
    return ((h * z).sum(-1) + _PHASE1_REACH * norm((G * z[..., None]).sum(1))) / total < -_PHASE1_GAP


def _solve_qpth(Q: Tensor, p: Tensor, G: Tensor, h: Tensor, tol: float) -> Raw:
    """Guarded qpth, float64.

    In the metric of Q (w = Lᵀu, target t) and in units of a bound s on |w|, every number of a well-posed problem is of
    order one except slack bounds, which are capped at 1.5‖G_i‖₁. A wrong s, too small, shows as a KKT residual of the
    uncapped problem, and the sample is solved again with another s (`_BOUND_FACTORS`).

    Args:
        Q: (B, n, n) symmetric.
        p: (B, n).
        G: (B, m, n).
        h: (B, m), +inf allowed; everything else finite.
        tol: KKT tolerance.
    """
    m, n = G.shape[1:]
    G, h, size, impossible = normalise_rows(G, h)
    metric = Metric(Q, G)
    idle = ~G.any(-1)
    t, rows, bound = -metric.down(p), metric.rows, torch.where(idle, 1.0, h / metric.scale)
    excess = ((rows * t[:, None]).sum(-1) - bound).amax(-1)  # ‖w - t‖ ≥ excess, and rarely far more
    reach = 2 * torch.maximum(norm(t), excess)
    reach = torch.where(reach > 0, reach, 1.0)
    raw = Raw.blank(metric.up(t), h.shape[1])
    usable, zero = ~impossible & ~metric.bad, torch.zeros_like(reach)
    # Where no row is violated the unconstrained minimiser is the answer, for Q = I bit for bit.
    free = kkt_residual(Q, p, G, h, raw.u, torch.zeros_like(h), zero, None)
    raw = raw._replace(residual=torch.where(usable & (excess <= 0), free, torch.inf))
    gap = torch.where(impossible, torch.inf, zero)
    eye = torch.eye(n, dtype=Q.dtype, device=Q.device)
    todo = (usable & (raw.residual > tol)).nonzero()[:, 0]
    for attempt, factor in enumerate(_BOUND_FACTORS):
        if not len(todo):
            break
        s = (reach[todo] * factor)[:, None]
        b = torch.where(idle[todo], 1.0, torch.minimum(bound[todo] / s, _CAP * rows[todo].abs().sum(-1)))
        x, z, slack = _interior_point(eye.expand(len(todo), -1, -1).contiguous(), -t[todo] / s, rows[todo], b)
        for w, dual in ((x * s, z * s), polish(t[todo], rows[todo], bound[todo], z > slack, z.clamp(min=1e-12))):
            u, lam = metric.up(w, todo), dual / metric.scale[todo]
            residual = kkt_residual(Q[todo], p[todo], G[todo], h[todo], u, lam, torch.zeros_like(reach[todo]), None)
            better = residual < raw.residual[todo]
            who = todo[better]
            raw.u[who], raw.lam[who], raw.residual[who] = u[better], lam[better], residual[better]
        raw.iterations[todo] = attempt + 1
        todo = todo[raw.residual[todo] > tol]
        if attempt == 0 and len(todo):
            hopeless = _prove_infeasible(rows[todo], bound[todo] / reach[todo, None])
            gap[todo[hopeless]] = torch.inf
            todo = todo[~hopeless]
    raw = raw._replace(lam=(raw.lam / size)[:, :m])
    return settle(raw, gap, raw.u, None, tol)
