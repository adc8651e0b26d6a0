"""Rows of every robot's quadratic program on the certified set, centred on the anchor of :mod:`safety.certificate`."""

from typing import NamedTuple

import torch
from torch import Tensor

from envs.dynamics import dot, length, own_pairs, pair_indices, take
from envs.homing import TINY, ClosestMoments, ClosestPieces, HomingGeometry, closest_pieces, way_to_go
from envs.selection import places
from safety.certificate import anchors, from_slot, own_gradient, pair_gradients
from safety.config import Gains

HAIR = 1e-5
"""Relative margin of the test whether a target may violate a row; the solver looks again, in float64."""


class Rows(NamedTuple):
    """Constraints ``G u <= h`` of K robots' own programs, and the joint action that they are centred on."""

    robots: Tensor
    """Which robots, as places in ``(M N,)``, ``(K,)`` int64: those whose target may violate a row, or all."""
    pressed: Tensor
    """Whether its target may violate a row, ``(K,)`` bool."""
    G: Tensor
    """``(K, m, d)``."""
    h: Tensor
    """``(K, m)``, +inf for no constraint."""
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
    target: Tensor | None = None,
    fixed_sizes: bool = False,
) -> Rows:
    """Rows of the robots' programs: survivability, collision and certificate shared around the anchor, arena.

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
        target: ``(M, N, d)`` in the speed ball, m/s: robots whose target satisfies all their rows get none. All, if None.
        fixed_sizes: every robot gets all its rows, whatever the target (:mod:`envs.selection`).

    Returns:
        ``m <= 1 + (N - 1) (1 + S) + 2 d`` rows per robot, S = 4 pieces (linear family) or 1 (logarithmic): pairs' rows
        that hold for every action in the speed ball are left out.
    """
    n, d = position.shape[1:]
    step, device = max_speed * geometry.dt, position.device
    pieces = closest_pieces(position, slot_position, geometry)
    i, j = pair_indices(n, device)
    gap = position[:, i] - position[:, j]
    now, later = length(gap), pieces.distance
    spare = (later - geometry.clearance - geometry.eps_distance).clamp_min(0)
    # a class-K function that is flat at 0: what the linearisation of G misses near the limit is of second order too
    decrease = gains.certificate * spare.square() / (spare + step)
    collision = gains.collision * (now.square() - safety_distance**2) / (2 * now)
    slack = torch.cat([collision.unsqueeze(0), decrease])  # (K, M, P), m/s: row 0 is the present distance's
    # the collision row is the row of a piece on which nobody has moved yet
    present = (now, gap.movedim(-1, 0), torch.zeros_like(now))
    pieces = ClosestPieces(*(torch.cat([x.unsqueeze(0), y]) for x, y in zip(present, pieces, strict=True)))
    anchor = torch.zeros_like(position)
    critical = (chord_bound < 0).any(dim=-1, keepdim=True)
    if anchored and (fixed_sizes or bool(critical.any())):  # elsewhere all may stand: their slack is not negative
        # no anchor uses up more than twice the limit; beyond six times it what is left holds for every action
        near = critical & (slack.amin(dim=0) < 6 * max_speed)
        world, pair = places(near, fixed_sizes=fixed_sizes)
        members = (world, i[pair], j[pair])
        e, way = from_slot(position, slot_position)
        e = torch.stack([e[world, x].mT for x in members[1:]])  # (2, d, E)
        way = torch.stack([way[world, x] for x in members[1:]])
        time = pieces.time[:, world, pair].unsqueeze(1)
        moments = ClosestMoments(
            pieces.distance[:, world, pair], pieces.relative[:, :, world, pair], *way_to_go(way, time, geometry)
        )
        arguments = (chord_normal, chord_bound, position, slot_position, members, -pair_gradients(moments, e))
        spare = torch.where(near, slack, torch.inf)[:, world, pair]
        anchor, left = anchors(*arguments, spare, geometry, max_speed, fixed_sizes=fixed_sizes)
        slack = torch.where(critical & ~near, slack - 2 * max_speed, slack)
        slack[:, world, pair] = torch.where(near[world, pair], left, slack[:, world, pair])
    room = torch.cat([bounds[:, 1] - position, position - bounds[:, 0]], dim=-1).clamp_min(0) / geometry.dt
    if target is None:
        pressed = torch.ones_like(chord_bound, dtype=torch.bool).flatten()
    else:
        pressed = _pressed(target, anchor, chord_normal, chord_bound, slack, room, max_speed).flatten()
    (robots,) = places(pressed, fixed_sizes=fixed_sizes or target is None)
    arguments = (position, slot_position, anchor, chord_normal, chord_bound, room)
    *own, chord_normal, chord_bound, room = (x.flatten(0, 1)[robots] for x in arguments)
    normals, shares = _own_rows(pieces, slack, n, robots, *own, geometry, max_speed, fixed_sizes=fixed_sizes)
    walls = torch.eye(d, dtype=position.dtype, device=device)
    walls = torch.cat([walls, -walls]).expand(len(robots), 2 * d, d)
    return Rows(
        robots=robots,
        pressed=pressed[robots],
        G=torch.cat([chord_normal.unsqueeze(1), normals, walls], dim=1),
        h=torch.cat([chord_bound.unsqueeze(-1), shares, room], dim=-1),
        anchor=anchor,
        closest=later.amin(dim=0),
        distance=now,
    )


def _pressed(
    target: Tensor,
    anchor: Tensor,
    chord_normal: Tensor,
    chord_bound: Tensor,
    slack: Tensor,
    room: Tensor,
    max_speed: float,
) -> Tensor:
    """Robots that may violate a row at their target, ``(M, N)`` bool: none that does is missing, NaN is among them."""
    n = target.shape[1]
    away = target - anchor
    fine = dot(chord_normal, target) + HAIR * length(chord_normal) * max_speed <= chord_bound
    fine = fine & (torch.cat([target, -target], dim=-1) + HAIR * max_speed <= room).all(dim=-1)
    if n > 1:
        least = take(slack.amin(dim=0), own_pairs(n, target.device)[0]).amin(dim=-1)
        # the normals are no longer than 1
        fine = fine & (2 * (1 + HAIR) * length(away) <= least)
    return ~fine


def _own_rows(
    pieces: ClosestPieces,
    slack: Tensor,
    n: int,
    robots: Tensor,
    position: Tensor,
    slot_position: Tensor,
    anchor: Tensor,
    geometry: HomingGeometry,
    max_speed: float,
    *,
    fixed_sizes: bool,
) -> tuple[Tensor, Tensor]:
    """The K robots' halves of the rows of their pairs, without those that no action in the speed ball can reach.

    Args:
        pieces: the present moment and the S pieces of the M worlds' pairs.
        slack: ``(1 + S, M, P)``, m/s, what the anchor leaves.
        n: number of robots in a world.
        robots: ``(K,)``, places in ``(M N,)``.
        position: ``(K, d)``, m.
        slot_position: ``(K, d)``, m.
        anchor: ``(K, d)``, m/s.
        geometry: constants of the backup motion.
        max_speed: m/s.
        fixed_sizes: all R rows for every robot, with bound +inf where it does not need them.

    Returns:
        Normals ``(K, R, d)`` and bounds ``(K, R)``, m/s; R is the largest number of rows that a robot needs.
    """
    world, others = robots // n, max(n - 1, 1)
    pair, side = (x[robots % n] for x in own_pairs(n, robots.device))  # (K, N - 1)
    half = slack[:, world.unsqueeze(-1), pair].clamp_min(0).movedim(0, 1).flatten(1) / 2  # (K, (1 + S) (N - 1))
    # the normals are no longer than 1, so any other row holds for every action
    needed = ~(half >= max_speed + length(anchor).unsqueeze(-1))
    robot, entry = places(needed, fixed_sizes=fixed_sizes)  # (E,)
    if fixed_sizes:
        half = torch.where(needed, half, torch.inf)
        place, count = entry, needed.shape[1]
    else:
        place = needed.cumsum(dim=1)[robot, entry] - 1
        count = int(place.max()) + 1 if len(place) else 0
    piece, other = entry // others, entry % others
    where = (world[robot], pair[robot, other])
    e, way = from_slot(position, slot_position)
    share, slope = way_to_go(way[robot], pieces.time[(piece, *where)], geometry)
    normal = pieces.relative[piece, :, *where].mT / pieces.distance[(piece, *where)].clamp_min(TINY)  # (d, E)
    gradient = own_gradient(share, slope, e[robot].mT, normal, 0).mT
    own = torch.where((side[robot, other] == 0).unsqueeze(-1), -gradient, gradient)
    normals = position.new_zeros(len(robots), count, position.shape[-1])
    bounds = position.new_full((len(robots), count), torch.inf)
    normals[robot, place], bounds[robot, place] = own, half[robot, entry] + dot(own, anchor[robot])
    return normals, bounds
