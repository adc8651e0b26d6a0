"""Speed limit for solvers that know no ball: a polytope inscribed in it."""

import math
from functools import lru_cache

import torch
from torch import Tensor

POLYGON_FACES = 16  # 2-D: a regular polygon
POLYHEDRON_FACES = 64  # 3-D: a polyhedron with spiral face normals


@lru_cache
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


def _spiral(n: int) -> Tensor:
    """``n`` nearly even directions in 3-D (golden spiral), ``(n, 3)``."""
    k = torch.arange(n, dtype=torch.float64)
    z = 1 - (2 * k + 1) / n
    angle = k * math.pi * (3 - math.sqrt(5))
    return torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], dim=-1)
