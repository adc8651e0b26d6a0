"""What the solvers share: the status and raw result of a solve, row scaling, the KKT residual, independent subsets of rows.

Conventions: flat batch B, float64; rows are normalised to unit norm (`normalise_rows`); a row that can never bind is
g = 0, h = 1.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from envs.dynamics import dot


class QPStatus(IntEnum):
    """What is known about a returned value; only SOLVED values may be executed."""

    SOLVED = 0
    INACCURATE = 1
    INFEASIBLE = 2


SCALE_FLOOR = 1e-3
"""Lengths are compared with max(‖u‖, 1e-3 ‖unconstrained solution‖): a solution at the origin still has a scale."""
TINY = 1e-300


class Raw(NamedTuple):
    """Solution of a flat batch in float64.

    Attributes:
        u: (B, n) solution.
        lam: (B, m) multipliers of the rows as they were given.
        mu: (B,) ball multiplier μ, stationarity being Qu + p + Gᵀλ + μu = 0.
        status: (B,) int64.
        residual: (B,) relative KKT residual.
        iterations: (B,) int64.
    """

    u: Tensor
    lam: Tensor
    mu: Tensor
    status: Tensor
    residual: Tensor
    iterations: Tensor

    @classmethod
    def blank(cls, u: Tensor, m: int) -> Raw:
        """SOLVED at `u` (B, n) with all m multipliers zero."""
        zero = torch.zeros_like(u[:, 0])
        count = torch.zeros_like(zero, dtype=torch.int64)
        return cls(u.clone(), u.new_zeros(u.shape[0], m), zero, count, zero.clone(), count.clone())

    def put(self, index: Tensor, part: Raw) -> None:
        """Write `part` into the samples `index`, in place."""
        for mine, theirs in zip(self, part, strict=True):
            mine[index] = theirs


Parts = TypeVar("Parts", bound=NamedTuple)


def choose(mask: Tensor, yes: Parts, no: Parts) -> Parts:
    """Of two results for the same batch ``(B, ..)``, ``yes`` where ``mask`` ``(B,)`` is true."""
    return yes._make(torch.where(mask.view(-1, *[1] * (x.dim() - 1)), x, y) for x, y in zip(yes, no, strict=True))


def norm(x: Tensor) -> Tensor:
    """Euclidean norm over the last dimension; over two or three components torch's own is slow."""
    return torch.linalg.vector_norm(x, dim=-1) if x.shape[-1] > 3 else dot(x, x).sqrt()


def column_norm(x: Tensor) -> Tensor:
    """Euclidean norm over the first dimension (torch's own reduces a short leading dimension ten times slower)."""
    return (x * x).sum(0).sqrt()


def normalise_rows(G: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Scale rows to unit norm and replace those that can never bind by g = 0, h = 1.

    Args:
        G: (B, m, n) finite rows.
        h: (B, m) bounds; +inf means no constraint.

    Returns:
        G (B, m', n), h (B, m'), row norms (B, m') and whether a zero row demands 0 ≤ h < 0 (B,). m' = max(m, 1).
    """
    if G.shape[1] == 0:
        G, h = G.new_zeros(G.shape[0], 1, G.shape[2]), h.new_ones(h.shape[0], 1)
    big = G.abs().amax(-1)
    zero = big == 0
    big = torch.where(zero, 1.0, big)  # two steps, or the squares of tiny rows would underflow
    unit = G / big[..., None]
    length = torch.where(zero, 1.0, norm(unit))
    bound = (h / big / length).clamp(max=1e150)
    idle = zero | torch.isposinf(h)
    impossible = (zero & (h < 0)).any(-1)
    unit = torch.where(idle[..., None], 0.0, unit / length[..., None])
    return unit, torch.where(idle, 1.0, bound), big * length, impossible


def kkt_residual(
    Q: Tensor | None, p: Tensor, G: Tensor, h: Tensor, u: Tensor, lam: Tensor, mu: Tensor, radius: float | None
) -> Tensor:
    """Relative KKT residual: the largest of stationarity, row and ball violation, dual sign, complementarity.

    Forces (stationarity, λ, μ·radius) are measured against max(‖p‖, ‖Qu‖), lengths (violations and slacks) against
    max(‖u‖, 1e-3 min(‖Q⁻¹p‖, radius)). Complementarity of a row is min(λ, slack) in these units, which unlike the
    product does not shrink quadratically. Rows must have unit norm, so the number does not depend on row scaling.

    Args:
        Q: (B, n, n) SPD, or None for the identity.
        p: (B, n).
        G: (B, m, n) unit rows.
        h: (B, m).
        u: (B, n).
        lam: (B, m).
        mu: (B,).
        radius: length unit of u, or None.

    Returns:
        (B,) residual; +inf where anything is not finite.
    """
    pull, size = norm(p), norm(u)
    if Q is None:
        Qu, free, force = u, pull, torch.maximum(pull, size)
    else:
        Qu = (Q @ u[..., None])[..., 0]
        free, force = norm(torch.linalg.solve_ex(Q, p[..., None])[0][..., 0]), torch.maximum(pull, norm(Qu))
    free = free if radius is None else free.clamp(max=radius)
    force, scale = force.clamp(min=TINY), torch.maximum(size, SCALE_FLOOR * free).clamp(min=TINY)
    gradient = Qu + p + (lam[:, None] @ G)[:, 0] + mu[:, None] * u
    slack = (h - (G @ u[..., None])[..., 0]) / scale[:, None]
    worst = torch.minimum(lam / force[:, None], slack).abs_().amax(-1)
    worst = torch.maximum(norm(gradient) / force, worst)
    if radius is not None:
        gap = 1 - size / radius
        worst = torch.maximum(worst, torch.minimum(mu * radius / force, gap).abs())
    return torch.where(torch.isfinite(worst), worst, torch.inf)


class Basis(NamedTuple):
    """Orthonormal basis of the span of chosen rows: rows[picks]ᵀ = axesᵀ·R, see `pivoted_basis`."""

    axes: Tensor  # (B, k, n), zero where no independent row was left
    picks: Tensor  # (B, k) row numbers
    R: Tensor  # (B, k, k) upper triangular, unit diagonal where an axis is zero

    def project(self, x: Tensor) -> Tensor:
        """Component of x (B, n) orthogonal to the chosen rows."""
        for _ in range(2):
            x = x - ((self.axes @ x[..., None]) * self.axes).sum(1)
        return x


def pivoted_basis(rows: Tensor, active: Tensor, weight: Tensor | None = None) -> Basis:
    """Pick up to n linearly independent rows among the active ones by pivoted Gram-Schmidt.

    Redundant rows are simply never picked, so nothing downstream is singular.

    Args:
        rows: (B, m, n) unit rows.
        active: (B, m) bool.
        weight: (B, m) preference among the rows, positive; default all alike.
    """
    left = rows * active[..., None]
    axes, picks = [], []
    for _ in range(min(rows.shape[1:])):
        size = norm(left)
        pick = torch.where(size > 1e-10, size if weight is None else size * weight, 0.0).argmax(-1)
        chosen = left[torch.arange(len(left), device=left.device), pick]
        length = norm(chosen)[:, None]
        axis = torch.where(length > 1e-10, chosen / length.clamp(min=TINY), 0.0)
        for _ in range(2):  # twice is enough (Kahan)
            left = left - (left @ axis[..., None]) * axis[:, None]
        axes.append(axis)
        picks.append(pick)
    A, order = torch.stack(axes, 1), torch.stack(picks, 1)
    R = (A @ rows.gather(1, order[..., None].expand_as(A)).mT).triu()
    dead = ~A.any(-1)
    R = torch.where(dead[:, :, None] | dead[:, None, :], 0.0, R) + torch.diag_embed(dead.to(R.dtype))
    return Basis(A, order, R)
