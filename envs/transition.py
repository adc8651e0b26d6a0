"""One step of the physical state, the same code for the environment and for whoever must know its next state beforehand."""

from torch import Tensor

from envs.battery import charge, charging_field, power
from envs.config import SurveillanceConfig
from envs.dynamics import integrate, length


def transition(
    position: Tensor, energy: Tensor, velocity: Tensor, current: Tensor, stations: Tensor, config: SurveillanceConfig
) -> tuple[Tensor, Tensor]:
    """Raw next position and energy: never saturated by walls or battery.

    Args:
        position: ``(*B, N, d)``, m.
        energy: ``(*B, N)``.
        velocity: ``(*B, N, d)``, m/s.
        current: ``(*B, N)``, accepted charging current in [0, 1].
        stations: ``(M, d)``, m.
        config: the world.

    Returns:
        ``(*B, N, d)`` m and ``(*B, N)``.
    """
    c = config
    field = charging_field(position, stations, full_radius=c.charge_radius_full, zero_radius=c.charge_radius)
    drain = power(
        length(velocity),
        drain_rate=c.drain_rate,
        per_speed=c.drain_per_speed,
        per_speed_squared=c.drain_per_speed_squared,
    )
    next_energy = charge(energy, field, current, drain, charge_rate=c.charge_rate, dt=c.dt)
    return integrate(position, velocity, c.dt), next_energy
