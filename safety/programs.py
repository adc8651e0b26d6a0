"""The filter's quadratic programs: one per robot, or one per world over all velocities."""

import torch
from torch import Tensor

from safety.qp import project_halfspaces_ball, solve_qp
from safety.speed_faces import BALL, face_normals, joint_rows


def solve_per_robot(
    target: Tensor, G: Tensor, h: Tensor, max_speed: float, solver: str, *, fixed_sizes: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Nearest velocity of every robot that its rows and the speed limit allow.

    Args:
        target: ``(*B, d)``, m/s.
        G: ``(*B, m, d)``.
        h: ``(*B, m)``.
        max_speed: m/s; for solvers that know no ball, a polytope inscribed in it.
        solver: ``safety.solver``.
        fixed_sizes: as :func:`project_halfspaces_ball`'s.

    Returns:
        Velocity ``(*B, d)``, status and residual ``(*B,)``.
    """
    if solver in ("auto", "exact"):
        solution = project_halfspaces_ball(target, G, h, max_speed * BALL, fixed_sizes=fixed_sizes)
        return solution.value, solution.status, solution.residual
    faces, offset = face_normals(target.shape[-1], max_speed, target.dtype, target.device)
    G = torch.cat([G, faces.expand(*G.shape[:-2], *faces.shape)], dim=-2)
    h = torch.cat([h, h.new_full((*h.shape[:-1], len(faces)), offset)], dim=-1)
    identity = torch.eye(target.shape[-1], dtype=target.dtype, device=target.device)
    solution = solve_qp(identity, -target, G, h, solver=solver)
    return solution.value, solution.status, solution.residual


def joint_solver(solver: str) -> str:
    """What solves the joint program where ``safety.solver`` names this."""
    return "active_set" if solver in ("auto", "exact") else solver


def solve_jointly(
    target: Tensor, gain_c: Tensor, bound_c: Tensor, gain_s: Tensor, bound_s: Tensor, max_speed: float, solver: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Nearest velocities of all robots of a world, ``(*B, N, d)``; status and residual ``(*B, N)`` are the world's.

    Args:
        target: ``(*B, N, d)``, m/s.
        gain_c: and the next three as :func:`joint_rows`'s.
        bound_c: survivability.
        gain_s: collision.
        bound_s: collision.
        max_speed: m/s.
        solver: ``safety.solver``.
    """
    n, d = target.shape[-2:]
    G, h = joint_rows(gain_c, bound_c, gain_s, bound_s, max_speed)
    identity = torch.eye(n * d, dtype=target.dtype, device=target.device)
    if target.requires_grad:
        # robot i's gradient flows through its own nominal action only: N copies, the neighbours' detached
        own = torch.eye(n, dtype=torch.bool, device=target.device).unsqueeze(-1)
        nominal = torch.where(own, target.unsqueeze(-3), target.detach().unsqueeze(-3)).flatten(-2)
        solution = solve_qp(identity, -nominal, G.unsqueeze(-3), h.unsqueeze(-2), solver=joint_solver(solver))
        diagonal = torch.arange(n, device=target.device)
        action = solution.value.unflatten(-1, (n, d))[..., diagonal, diagonal, :]
        return action, solution.status, solution.residual
    solution = solve_qp(identity, -target.flatten(-2), G, h, solver=joint_solver(solver))
    shape = target.shape[:-1]
    action = solution.value.unflatten(-1, (n, d))
    return action, solution.status.unsqueeze(-1).expand(shape), solution.residual.unsqueeze(-1).expand(shape)
