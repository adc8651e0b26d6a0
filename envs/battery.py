"""Batteries: ``E' = -P(u) + K_c w(p) c``, control affine in the accepted charging current ``c``.

``w`` is the charging field, 1 on a flat top around each station and smoothly 0 at ``charge_radius``. The environment
is the Euler map with the field taken at the start of the step.
"""

import torch
from torch import Tensor

from envs.dynamics import length


def charging_field(position: Tensor, stations: Tensor, *, full_radius: float, zero_radius: float) -> Tensor:
    """Charging field ``w(p) = max_s w(||p - S_s||)``: 1 up to ``full_radius``, smoothstep to 0 at ``zero_radius``.

    Args:
        position: ``(*B, N, d)``, m.
        stations: ``(M, d)``, m.
        full_radius: end of the flat top, m.
        zero_radius: where the field vanishes, m, above ``full_radius``.

    Returns:
        ``(*B, N)``, in [0, 1].
    """
    distance = length(position.unsqueeze(-2) - stations).amin(dim=-1)
    t = ((zero_radius - distance) / (zero_radius - full_radius)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def break_even_radius(level: float, full_radius: float, zero_radius: float) -> float:
    """Distance at which the charging field equals ``level`` (drain over charging power), by bisection.

    Args:
        level: ``K_d / K_c``; at 1 or above nothing charges and ``full_radius`` is returned.
        full_radius: end of the flat top, m.
        zero_radius: where the field vanishes, m.

    Returns:
        Distance to the station, m.
    """
    low, high = 0.0, 1.0
    for _ in range(60):
        t = (low + high) / 2
        low, high = (t, high) if t * t * (3 - 2 * t) < level else (low, t)
    return zero_radius - high * (zero_radius - full_radius)


def power(speed: Tensor, *, drain_rate: float, per_speed: float = 0.0, per_speed_squared: float = 0.0) -> Tensor:
    """Power drawn ``P(u) = K_d + k_1 |u| + k_2 |u|^2``.

    Args:
        speed: ``(*B, N)``, m/s.
        drain_rate: ``K_d``, energy/s.
        per_speed: ``k_1``, energy/m.
        per_speed_squared: ``k_2``, energy s/m^2.

    Returns:
        ``(*B, N)``, energy/s.
    """
    return drain_rate + speed * (per_speed + per_speed_squared * speed)


def charge(energy: Tensor, field: Tensor, current: Tensor, drain: Tensor, *, charge_rate: float, dt: float) -> Tensor:
    """One Euler step of the battery, never saturated: ``E+ = E + dt (-P + K_c w c)``.

    Args:
        energy: ``(*B, N)``, energy.
        field: ``(*B, N)``, charging field at the start of the step.
        current: ``(*B, N)``, accepted charging current in [0, 1].
        drain: ``(*B, N)``, energy/s.
        charge_rate: ``K_c``, energy/s.
        dt: s.

    Returns:
        ``(*B, N)``, energy.
    """
    return energy + dt * (charge_rate * field * torch.clamp(current, 0, 1) - drain)
