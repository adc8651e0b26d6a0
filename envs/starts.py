"""Start states inside the certified set: everybody can drive home from them without running empty or coming close."""

import torch
from torch import Tensor

from envs.config import SurveillanceConfig
from envs.dynamics import length
from envs.homing import HomingGeometry, is_certified, reserve
from envs.reassignment import exchange_slots

DRAWS = 16  # candidates per world


def draw_starts(
    batch: int,
    config: SurveillanceConfig,
    geometry: HomingGeometry,
    slots: Tensor,
    bounds: Tensor,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Uniform positions and energies of ``batch`` worlds: the first certified of several draws, docked where none is.

    Args:
        batch: number of worlds B.
        config: the world; ``reset_reserve`` and ``reset_clearance`` ask for more than the certified set.
        geometry: constants of driving home.
        slots: ``(S, d)``, m.
        bounds: ``(d, 2)``, the arena, m.
        generator: the environment's own.

    Returns:
        Position ``(B, N, d)`` m, energy ``(B, N)``, slot ``(B, N)`` int64.
    """
    n = config.n_agents
    low, high = bounds.unbind(-1)
    factory = {"generator": generator, "dtype": slots.dtype, "device": slots.device}
    position = low + (high - low) * torch.rand(batch, DRAWS, n, config.dimension, **factory)
    share = torch.rand(batch, DRAWS, n, **factory)
    robots = torch.arange(n, device=slots.device)
    slot = robots.expand(batch, DRAWS, n)
    full = torch.full_like(share, config.energy_max)
    for _ in range(n):  # rounds of the exchange, not robots: every round improves all worlds at once
        slot = exchange_slots(position, full, slot, slots, geometry)
    top = config.energy_max - geometry.eps_energy
    span = config.energy_max - config.energy_min
    least = min(config.energy_min + 2 * geometry.eps_energy + config.reset_reserve * span, top)
    need = least + reserve(length(position - slots[slot]), geometry)
    energy = need + (top - need).clamp_min(0) * share
    certified = is_certified(position, energy, slots[slot], geometry, bounds, clearance=config.reset_clearance)
    certified &= (need <= top).all(dim=-1)
    first = certified.to(torch.uint8).argmax(dim=1)
    worlds = torch.arange(batch, device=slots.device)
    found = certified.any(dim=1, keepdim=True)
    docked = robots.expand(batch, n)
    return (
        torch.where(found.unsqueeze(-1), position[worlds, first], slots[docked]),
        torch.where(found, energy[worlds, first], least + (top - least) * share[:, 0]),
        torch.where(found, slot[worlds, first], docked),
    )
