"""What a robot observes, field by field, and where each field lies.

In this order (lengths in units of half the arena's longest side ``L``, relative vectors as *other minus own*):

========================  ==================  ==============================================================
field                     size                meaning
========================  ==================  ==============================================================
position                  d                   own position relative to the arena's middle, / L
energy                    1                   (E - E_min) / (E_max - E_min)
slot                      d                   vector to the own charging slot, / L
stations                  M d                 vectors to all stations, / L
others' positions         (N - 1) d           vectors to robots i+1, i+2, .. (cyclic), / L
others' energies          N - 1               as energy, same order
density                   n_observed          parameters of a density that varies (centres / L, or coarse ages)
time                      1 if horizon > 0    share of the episode that has passed, at most 1
centroid                  d, only on request  vector to the centroid of the own Voronoi cell, / L
========================  ==================  ==============================================================
"""

import itertools

import torch
from torch import Tensor

from envs.config import SurveillanceConfig
from envs.density import Density
from envs.dynamics import other_indices, take


def observation_fields(config: SurveillanceConfig, density: Density) -> dict[str, slice]:
    """Where each field of an observation lies, by name, in order; absent fields are empty."""
    n, d = config.n_agents, config.dimension
    sizes = {
        "position": d,
        "energy": 1,
        "slot": d,
        "stations": len(config.station_positions) * d,
        "others": (n - 1) * d,
        "others_energy": n - 1,
        "density": density.n_observed,
        "time": int(config.horizon > 0),
        "centroid": d * config.observe_centroid,
    }
    ends = itertools.accumulate(sizes.values())
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def observe(
    position: Tensor,
    energy: Tensor,
    slot_position: Tensor,
    step: Tensor,
    centroid: Tensor | None,
    seen: Tensor,
    stations: Tensor,
    middle: Tensor,
    config: SurveillanceConfig,
) -> Tensor:
    """Observations of all robots, ``(B, N, n_obs)``.

    Args:
        position: ``(B, N, d)``, m.
        energy: ``(B, N)``.
        slot_position: ``(B, N, d)``, of the robots' own slots, m.
        step: ``(B, 1)``, steps of the episode so far.
        centroid: ``(B, N, d)``, m, or None if it is not observed.
        seen: ``(B, n_observed)``, what is observed of the density.
        stations: ``(M, d)``, m.
        middle: ``(d,)``, of the arena, m.
        config: the world.
    """
    length, robots = config.length_scale, energy.shape
    others = other_indices(config.n_agents, position.device)
    share = (energy - config.energy_min) / (config.energy_max - config.energy_min)
    relative = take(position, others, 1) - position.unsqueeze(-2)  # (B, N, N-1, d)
    fields = [
        (position - middle) / length,
        share.unsqueeze(-1),
        (slot_position - position) / length,
        torch.flatten(stations - position.unsqueeze(-2), -2) / length,
        torch.flatten(relative, -2) / length,
        take(share, others),
        seen.unsqueeze(-2).expand(*robots, -1),
    ]
    if config.horizon:
        time = (step.to(share.dtype) / config.horizon).clamp_max(1)
        fields.append(time.unsqueeze(-2).expand(*robots, 1))
    if centroid is not None:
        fields.append((centroid - position) / length)
    return torch.cat(fields, dim=-1)
