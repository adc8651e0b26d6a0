"""Rows of every robot's quadratic program on the certified set, centred on the anchor of :mod:`safety.certificate`."""

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from envs.dynamics import dot, other_indices, pair_indices
from envs.homing import TINY, ClosestMoments, HomingGeometry, closest_moments
from safety.certificate import anchors, from_slot, pair_gradients
from safety.config import Gains


class Rows(NamedTuple):
    """Constraints ``G u <= h`` of every robot's own program, and the action they are centred on."""

    G: Tensor
    """``(M, N, m, d)``."""
    h: Tensor
    """``(M, N, m)``, +inf for no constraint."""
    anchor: Tensor
    """Admissible joint action ``(M, N, d)``, m/s."""
    closest: Tensor
    """``G_ij (M, P)``, m."""
    distance: Tensor
    """Present distance of the pairs, ``(M, P)``, m."""


def certified_rows(
    position: Tensor,
    slot_position: Tensor,
    chord_normal: Tensor,
    chord_bound: Tensor,
    bounds: Tensor,
    geometry: HomingGeometry,
    gains: Gains,
    *,
    safety_distance: float,
    max_speed: float,
    anchored: bool = True,
) -> Rows:
    """Rows of every robot's program: survivability, collision and certificate shared around the anchor, arena.

    Collision (exact over the whole step, as ``h_s`` is convex along it): ``h_s + dt 2 q . (u_i - u_j) >= (1 - g_s) h_s``.
    Certificate: one linearised row for the closest approach on each straight piece of the relative way home, as another
    piece may become the nearest within the step: ``grad G . u >= -alpha_g s^2 / (s + U)``, ``s = G - Delta_G - eps >= 0``,
    ``U = max_speed dt``. Robot i takes half of what the anchor leaves of each.

    Args:
        position: ``(M, N, d)``, m.
        slot_position: ``(M, N, d)``, m.
        chord_normal: ``(M, N, d)`` and
        chord_bound: ``(M, N)``, the survivability row (:func:`safety.barriers.sampled_energy_row`).
        bounds: ``(d, 2)``, the arena, m.
        geometry: constants of the backup motion.
        gains: class-K gains.
        safety_distance: ``Delta``, m.
        max_speed: m/s.
        anchored: False centres the rows on standing still, the literature's split by halves (may be infeasible).

    Returns:
        ``m <= 1 + (N - 1) (1 + S) + 2 d`` rows per robot, S = 4 pieces (linear family) or 1 (logarithmic): pairs' rows
        that hold for every action in the speed ball are left out.
    """
    d = position.shape[-1]
    device, step = position.device, max_speed * geometry.dt
    moments = _with_present(closest_moments(position, slot_position, geometry), position)
    now, later = moments.distance[0], moments.distance[1:]
    spare = (later - geometry.clearance - geometry.eps_distance).clamp_min(0)
    # a class-K function that is flat at 0: what the linearisation of G misses near the limit is of second order too
    decrease = gains.certificate * spare.square() / (spare + step)
    collision = gains.collision * (now.square() - safety_distance**2) / (2 * now).clamp_min(TINY)
    slack = torch.cat([collision.unsqueeze(0), decrease]).movedim(0, 1)  # (M, K, P), m/s
    anchor = torch.zeros_like(position)
    critical = (chord_bound < 0).any(dim=-1).nonzero().squeeze(-1)
    if anchored and len(critical):  # elsewhere all may stand: their slack is not negative
        some = ClosestMoments(*(x.movedim(-2, 0)[critical].movedim(0, -2) for x in moments))
        states = (chord_normal[critical], chord_bound[critical], position[critical], slot_position[critical])
        normals = -pair_gradients(some, *states[2:]).permute(3, 0, 1, 4, 2)  # (M, K, 2, P, d)
        anchor[critical], slack[critical] = anchors(*states, normals, slack[critical], geometry, max_speed)
    normals, shares = _own_rows(moments, slack, anchor, position, slot_position, max_speed)
    walls = torch.eye(d, dtype=position.dtype, device=device)
    room = torch.cat([bounds[:, 1] - position, position - bounds[:, 0]], dim=-1).clamp_min(0) / geometry.dt
    return Rows(
        G=torch.cat([chord_normal.unsqueeze(2), normals, torch.cat([walls, -walls]).expand(*room.shape, d)], dim=2),
        h=torch.cat([chord_bound.unsqueeze(-1), shares, room], dim=-1),
        anchor=anchor,
        closest=later.amin(dim=0),
        distance=now,
    )


def _with_present(moments: ClosestMoments, position: Tensor) -> ClosestMoments:
    """Prepend the present moment: the collision row is the row of a piece on which nobody has moved yet."""
    i, j = pair_indices(position.shape[-2], position.device)
    gap = (position[..., i, :] - position[..., j, :]).movedim(-1, 0).unsqueeze(0)
    ones = torch.ones_like(moments.share[:1])
    return ClosestMoments(
        torch.cat([gap.square().sum(1).sqrt(), moments.distance]),
        torch.cat([gap, moments.relative]),
        torch.cat([ones, moments.share]),
        torch.cat([ones, moments.slope]),
    )


def _own_rows(
    moments: ClosestMoments, slack: Tensor, anchor: Tensor, position: Tensor, slot_position: Tensor, max_speed: float
) -> tuple[Tensor, Tensor]:
    """Every robot's half of the rows of its pairs, without those that no action in the speed ball can reach.

    Args:
        moments: K pieces of the M worlds' pairs.
        slack: ``(M, K, P)``, m/s, what the anchor leaves.
        anchor: ``(M, N, d)``, m/s.
        position: ``(M, N, d)``, m.
        slot_position: ``(M, N, d)``, m.
        max_speed: m/s.

    Returns:
        Normals ``(M, N, R, d)`` and bounds ``(M, N, R)``, m/s; R is the largest number of rows that a robot needs.
    """
    m, n, d = position.shape
    pair, side = _own_pairs(n, position.device)  # (N, N - 1)
    half = (slack.clamp_min(0) / 2)[:, :, pair].permute(0, 2, 1, 3).flatten(-2)  # (M, N, K (N - 1))
    # the normals are no longer than 1, so such a row holds for every action
    idle = half >= max_speed + dot(anchor, anchor).sqrt().unsqueeze(-1)
    count = int((~idle).sum(-1).max()) if half.numel() else 0
    half, entry = half.topk(count, dim=-1, largest=False)
    robots = torch.arange(n, device=position.device).unsqueeze(-1)
    piece, other = entry // max(n - 1, 1), entry % max(n - 1, 1)
    own, second = pair[robots, other], side[robots, other]  # (M, N, R)
    world = torch.arange(m, device=position.device)[:, None, None]

    def pick(values: Tensor, *index: Tensor) -> Tensor:
        return values[(*index, world, own)]

    distance = pick(moments.distance, piece).clamp_min(TINY).unsqueeze(-1)
    normal = (
        torch.stack([pick(moments.relative, piece, torch.full_like(piece, x)) for x in range(d)], dim=-1) / distance
    )
    share, slope = pick(moments.share, piece, second).unsqueeze(-1), pick(moments.slope, piece, second).unsqueeze(-1)
    e = from_slot(position, slot_position).unsqueeze(2)
    gradient = share * normal + (slope - share) * dot(e, normal).unsqueeze(-1) * e
    normals = torch.where((second == 0).unsqueeze(-1), -gradient, gradient)
    return normals, half + dot(normals, anchor.unsqueeze(2))


@functools.lru_cache(maxsize=64)
def _own_pairs(n: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Robot i's pairs and its side in them (0 in pair (i, j), 1 in pair (j, i)): ``(N, N - 1)`` each."""
    i, j = pair_indices(n, device)
    others = other_indices(n, device)
    robots = torch.arange(n, device=device).unsqueeze(-1)
    number = torch.zeros(n, n, dtype=torch.int64, device=device)
    number[i, j] = number[j, i] = torch.arange(len(i), device=device)
    return number[robots, others], (robots > others).to(torch.int64)
