"""Rows for solvers that know no ball: a polytope inscribed in the speed ball, and the joint problem of all robots."""

import math

import torch
from torch import Tensor

from envs.dynamics import constant, pair_indices

BALL = 1 - 2.4e-7
"""The programs' speed limit, share of max_speed: a float32 rounding above every target (:data:`envs.dynamics.FULL_SPEED`), which is
then within it, and one below max_speed, so that no solution is cut afterwards."""
POLYGON_FACES = 16  # 2-D: a regular polygon
POLYHEDRON_FACES = 64  # 3-D: a polyhedron with spiral face normals


def speed_faces(dimension: int, radius: float) -> tuple[list[list[float]], float]:
    """Face normals and offset of a polytope inscribed in the speed ball.

    Args:
        dimension: 2 or 3.
        radius: of the ball, m/s.

    Returns:
        Unit normals and the offset ``b`` of ``normal . u <= b``, m/s.
    """
    if dimension == 2:
        angles = [2 * math.pi * k / POLYGON_FACES for k in range(POLYGON_FACES)]
        return [[math.cos(a), math.sin(a)] for a in angles], radius * math.cos(math.pi / POLYGON_FACES)
    normals, probes = _spiral(POLYHEDRON_FACES), _spiral(40_000)
    # a vertex lies where the nearest normal is farthest; the probes miss it by less than 0.02 rad
    widest = (probes @ normals.T).amax(dim=-1).clamp(-1, 1).acos().amax().item() + 0.02
    return normals.tolist(), radius * math.cos(widest)


@constant
def face_normals(dimension: int, radius: float, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, float]:
    """:func:`speed_faces` of the programs' ball, with the normals as a tensor ``(F, d)``, made once."""
    normals, offset = speed_faces(dimension, radius)
    return torch.tensor(normals, dtype=dtype, device=device), offset * BALL


def _spiral(n: int) -> Tensor:
    """``n`` nearly even directions in 3-D (golden spiral), ``(n, 3)``."""
    k = torch.arange(n, dtype=torch.float64)
    z = 1 - (2 * k + 1) / n
    angle = k * math.pi * (3 - math.sqrt(5))
    return torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], dim=-1)


def joint_rows(
    gain_c: Tensor, bound_c: Tensor, gain_s: Tensor, bound_s: Tensor, max_speed: float
) -> tuple[Tensor, Tensor]:
    """Rows of the joint problem: N survivability, P collision, then the faces of every robot's speed polytope.

    Args:
        gain_c: ``(*B, N, d)`` and
        bound_c: ``(*B, N)``, survivability rows.
        gain_s: ``(*B, N, N, d)`` and
        bound_s: ``(*B, N, N)``, collision rows of robot i against j.
        max_speed: m/s.

    Returns:
        ``G (*B, m, N d)`` and ``h (*B, m)``, ``m = N + N (N - 1) / 2 + N F`` with F faces.
    """
    n, d = gain_c.shape[-2:]
    batch = gain_c.shape[:-2]
    i, j = pair_indices(n, gain_c.device)
    pairs = torch.arange(len(i), device=gain_c.device)
    pair_rows = gain_c.new_zeros(*batch, len(i), n, d)
    pair_rows[..., pairs, i, :] = gain_s[..., i, j, :]
    pair_rows[..., pairs, j, :] = gain_s[..., j, i, :]
    eye = torch.eye(n, dtype=gain_c.dtype, device=gain_c.device)
    own_rows = eye.unsqueeze(-1) * gain_c.unsqueeze(-2)
    faces, offset = face_normals(d, max_speed, gain_c.dtype, gain_c.device)
    face_rows = torch.einsum("ij,fd->ifjd", eye, faces).flatten(0, 1).expand(*batch, -1, n, d)
    # a pair's row is asked for if either robot's composite is that pair
    bound_pair = torch.minimum(bound_s[..., i, j], bound_s[..., j, i])
    G = torch.cat([own_rows, pair_rows, face_rows], dim=-3).flatten(-2)
    return G, torch.cat([bound_c, bound_pair, gain_c.new_full((*batch, face_rows.shape[-3]), offset)], dim=-1)
