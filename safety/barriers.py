"""Control barrier functions of the surveillance world and their rows along the control-affine dynamics.

State chi = (p, E), input u~ = (u, c): ``p' = u``, ``E' = -K_d + K_c w(p) c``. A barrier ``h >= 0`` is kept by

    L_F h + L_G h u~ >= -alpha h.

Signs: every function returns ``h`` (safe where >= 0) and the row's parts. The three barriers' rows are the literature's
continuous-time ones, without margins: under a step of finite length they leak. :func:`sampled_energy_row` is the
survivability row on the exact one-step map.
"""

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from envs.config import SurveillanceConfig
from envs.dynamics import length, other_indices
from envs.homing import HomingGeometry, reserve


class BarrierRow(NamedTuple):
    """A barrier and its Lie derivatives: ``h' = drift + velocity_gain . u + current_gain c``."""

    value: Tensor
    """``h``, shape ``(...)``."""
    drift: Tensor
    """``L_F h``, ``(...)``, per second."""
    velocity_gain: Tensor
    """``L_G h`` along the velocity, ``(..., d)``, per metre."""
    current_gain: Tensor
    """``L_G h`` along the accepted current, ``(...)``, per second."""


def energy_barrier(
    position: Tensor,
    energy: Tensor,
    slot_position: Tensor,
    field: Tensor,
    geometry: HomingGeometry,
    *,
    charge_rate: float,
) -> BarrierRow:
    """Survivability ``h_c = E - E_min - rho(||p - sigma||)``: enough energy to drive home.

    The reserve ends at the break-even circle ``r_c`` (no sampled-data margin). Linear:
    ``rho = (K_d / v) max(0, D - r_c)``; logarithmic: ``rho = (K_d / k~) max(0, ln(D / r_c))``.

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        slot_position: ``(*B, N, d)``, m.
        field: ``(*B, N)``, charging field ``w(p)``.
        geometry: constants of driving home.
        charge_rate: ``K_c``, energy/s.

    Returns:
        Row of shape ``(*B, N)``.

    Source: Notomista & Egerstedt, Persistification of Robotic Tasks, arXiv 1903.05810.
    """
    offset = position - slot_position
    distance = length(offset)
    radius = geometry.charge_radius
    outside = distance > radius
    if geometry.family == "linear":
        slope = torch.full_like(distance, geometry.drain_rate / geometry.speed)
    else:
        slope = geometry.drain_rate / geometry.decay / distance.clamp_min(radius)
    slope = torch.where(outside, slope, torch.zeros_like(slope))
    direction = offset / distance.clamp_min(1e-30).unsqueeze(-1)
    return BarrierRow(
        value=energy - geometry.energy_min - reserve(distance, geometry, radius=radius),
        drift=torch.full_like(energy, -geometry.drain_rate),
        velocity_gain=-slope.unsqueeze(-1) * direction,
        current_gain=charge_rate * field,
    )


def sampled_energy_row(
    position: Tensor,
    energy: Tensor,
    next_energy: Tensor,
    slot_position: Tensor,
    geometry: HomingGeometry,
    *,
    gain: float,
    step: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Survivability row that holds over a whole step: ``h_c(k+1) >= (1 - gain) h_c(k)`` on the exact one-step map.

    The condition is a ball, ``||p + dt u - sigma|| <= R``. Its best half-space, replacing ``||u||`` by its limit, is the
    chord row ``2 dt (p - sigma) . u <= R^2 - D^2 - U^2``. The reserve ends one backup step inside the charging circle
    and ``E_min`` is raised by two rounding margins. Inside those margins (``h_c < 0``) the gain is lowered so that the
    row stays feasible.

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        next_energy: ``(*B, N)``, after the step with the accepted current.
        slot_position: ``(*B, N, d)``, m.
        geometry: constants of driving home.
        gain: ``g_c = alpha_c dt`` in (0, 1].
        step: ``U = max_speed dt``, m.

    Returns:
        ``h_c (*B, N)``, row normal ``(*B, N, d)`` (s m) and bound ``(*B, N)`` (m^2) of ``normal . u <= bound``.
    """
    offset = position - slot_position
    distance = length(offset)
    floor = geometry.energy_min + 2 * geometry.eps_energy
    value = energy - floor - reserve(distance, geometry)
    if geometry.family == "linear":
        cautious = (
            (step - geometry.speed * geometry.dt) * geometry.drain_rate / (2 * geometry.speed * geometry.eps_energy)
        )
    else:
        # D (1 - k dt) (1 - exp(-k~ g 2 eps / K_d)) <= U - k dt D at the farthest D, the arena's diagonal v / k
        farthest = geometry.speed / geometry.gain * (1 - geometry.gain * geometry.dt)
        spare_step = (step - geometry.speed * geometry.dt) / farthest
        cautious = -geometry.drain_rate / (2 * geometry.decay * geometry.eps_energy) * math.log1p(-spare_step)
    kept = 1 - torch.where(value < 0, min(gain, cautious), gain)
    spare = next_energy - floor - kept * value
    if geometry.family == "linear":
        radius = (geometry.reserve_radius + geometry.speed / geometry.drain_rate * spare).clamp_min(0)
    else:
        # beyond the arena a larger ball changes nothing, and exp must not overflow
        radius = geometry.reserve_radius * (spare * geometry.decay / geometry.drain_rate).clamp_max(50).exp()
    bound = radius.square() - distance.square() - step**2
    return value, 2 * geometry.dt * offset, torch.where(distance <= radius - step, torch.inf, bound)


def overcharge_barrier(
    energy: Tensor, field: Tensor, *, energy_max: float, drain_rate: float, charge_rate: float
) -> BarrierRow:
    """Overcharge ``h_o = E_max - E``, of relative degree one through the accepted current.

    Args:
        energy: ``(*B, N)``.
        field: ``(*B, N)``, charging field ``w(p)``.
        energy_max: ``E_max``.
        drain_rate: the smallest drain ``K_d``, energy/s.
        charge_rate: ``K_c``, energy/s.

    Returns:
        Row of shape ``(*B, N)``; its ``velocity_gain`` is ``(*B, N, 1)`` zeros, broadcastable to any dimension.
    """
    return BarrierRow(
        value=energy_max - energy,
        drift=torch.full_like(energy, drain_rate),
        velocity_gain=torch.zeros_like(energy).unsqueeze(-1),
        current_gain=-charge_rate * field,
    )


def collision_barrier(position: Tensor, *, safety_distance: float) -> BarrierRow:
    """Collision ``h_s,ij = ||p_i - p_j||^2 - Delta^2`` of all ordered pairs, as seen by robot i.

    ``velocity_gain[i, j] = 2 (p_i - p_j)`` multiplies ``u_i`` (and its negative ``u_j``). The diagonal is +inf.

    Args:
        position: ``(*B, N, d)``, m.
        safety_distance: ``Delta``, m.

    Returns:
        Row of shape ``(*B, N, N)``.

    Source: Wang, Ames & Egerstedt, Safety barrier certificates for collisions-free multirobot systems, T-RO 2017.
    """
    offset = position.unsqueeze(-2) - position.unsqueeze(-3)
    itself = torch.eye(position.shape[-2], dtype=torch.bool, device=position.device)
    value = torch.where(itself, torch.inf, offset.square().sum(-1) - safety_distance**2)
    zero = torch.zeros_like(value)
    return BarrierRow(value=value, drift=zero, velocity_gain=2 * offset, current_gain=zero)


def literal_geometry(world: SurveillanceConfig) -> HomingGeometry:
    """The literature's reserve: driving home at full speed, no sampled-data margin."""
    return dataclasses.replace(world.homing, speed=world.max_speed, gain=world.max_speed / world.diameter)


def literature_barriers(
    position: Tensor,
    energy: Tensor,
    slot_position: Tensor,
    field: Tensor,
    geometry: HomingGeometry,
    world: SurveillanceConfig,
) -> tuple[BarrierRow, BarrierRow, BarrierRow]:
    """The three rows ``h_c (*B, N)``, ``h_o (*B, N)`` and ``h_s (*B, N, N)`` of a state of this world.

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        slot_position: ``(*B, N, d)``, m.
        field: ``(*B, N)``, charging field ``w(p)``.
        geometry: of :func:`literal_geometry`.
        world: the world.

    Returns:
        Survivability, overcharge, collision.
    """
    rates = {"charge_rate": world.charge_rate}
    return (
        energy_barrier(position, energy, slot_position, field, geometry, **rates),
        overcharge_barrier(energy, field, energy_max=world.energy_max, drain_rate=world.drain_rate, **rates),
        collision_barrier(position, safety_distance=world.safety_distance),
    )


def accepted_current(row: BarrierRow, alpha: float) -> tuple[Tensor, Tensor]:
    """Largest current in [0, 1] that the overcharge row admits: ``c <= (K_d + alpha h_o) / (K_c w)``.

    The survivability row only gains from more current, so this is the exact minimiser for the nominal current 1.

    Args:
        row: overcharge row, ``(*B, N)``.
        alpha: 1/s.

    Returns:
        Current ``(*B, N)`` and whether a current in [0, 1] satisfies the row, ``(*B, N)`` bool.
    """
    supply = row.drift + alpha * row.value
    demand = -row.current_gain
    current = torch.where(demand > supply, supply / demand.clamp_min(1e-30), torch.ones_like(supply))
    return current.clamp(0, 1), supply >= 0


def without_self(rows: Tensor) -> Tensor:
    """Drop the diagonal of ``(*B, N, N, k)`` rows: ``(*B, N, N - 1, k)``."""
    n = rows.shape[-2]
    others = other_indices(n, rows.device)
    return rows.gather(-2, others.unsqueeze(-1).expand(*rows.shape[:-3], n, n - 1, rows.shape[-1]))
