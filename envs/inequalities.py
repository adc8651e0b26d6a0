"""What a world must satisfy for the certificate to exist, checked when its configuration is built.

Each function raises a ``ValueError`` that names the inequality, its numbers and the nearest value that would do.
Numbers and proofs: docs/safety.md, "Inequalities". Those on a filter's gains are checked by ``SafetyConfig.gains``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from envs.config import SurveillanceConfig


def least_clearance(world: SurveillanceConfig, eps_distance: float, share: float = 1.0) -> float:
    """Least ``Delta_G`` at which two homing robots satisfy their collision row with gain ``share / dt``, m."""
    return math.hypot(world.safety_distance + eps_distance, 2 * world.max_speed * world.dt / share)


def check_inequalities(world: SurveillanceConfig) -> None:
    """Check charging, reserve, battery, clearance and slots of a world whose fields are in range.

    Raises:
        ValueError: naming the first inequality that fails.
    """
    _check_layout(world)
    _check_charging(world)
    _check_rounding(world)
    _check_spacing(world)
    _check_battery(world)


def _check_layout(world: SurveillanceConfig) -> None:
    slots = world.slot_positions
    if len(slots) < world.n_agents:
        raise ValueError(
            f"env.stations, env.slots: {len(slots)} slots for env.n_agents={world.n_agents} robots, every robot needs its own. "
            "Add stations, raise env.slots, or leave env.stations=[] for one station per robot."
        )
    for slot in slots:
        if any(not low <= x <= high for x, (low, high) in zip(slot, world.bounds, strict=True)):
            raise ValueError(
                f"env.slots: slot {_rounded(slot)} is outside env.arena={world.bounds}. Move its station inwards."
            )


def _check_charging(world: SurveillanceConfig) -> None:
    if world.charge_rate <= world.max_drain_rate:
        raise ValueError(
            f"env.charge_rate={world.charge_rate}: K_c > P(max_speed) fails, it must exceed the drain at full speed, "
            f"{world.max_drain_rate:.4g}: a robot could never charge. Raise env.charge_rate or lower env.drain_rate."
        )
    homing, step = world.homing, world.max_speed * world.dt
    if homing.reserve_radius < 2 * step:
        radius = world.charge_radius + 1.01 * (2 * step - homing.reserve_radius)
        raise ValueError(
            f"env.charge_radius={world.charge_radius}: r_rho >= 2 max_speed dt fails, the reserve must end {2 * step:.4g} m or "
            f"more from the slot (two steps at full speed), it ends at {homing.reserve_radius:.4g} m. Raise env.charge_radius "
            f"and env.charge_radius_full by {radius - world.charge_radius:.3g}, shorten env.dt or lower env.max_speed."
        )


def _check_spacing(world: SurveillanceConfig) -> None:
    slots, homing = world.slot_positions, world.homing
    least = least_clearance(world, homing.eps_distance)
    if homing.clearance < least:
        raise ValueError(
            f"env.homing_clearance={world.homing_clearance}: Delta_G^2 >= (env.safety_distance + eps)^2 + (2 max_speed dt)^2 "
            f"fails, it must be at least {least:.4g} m. 0 chooses that."
        )
    needed = homing.clearance + homing.eps_distance
    for i, a in enumerate(slots):
        for b in slots[:i]:
            if math.dist(a, b) <= needed:
                raise ValueError(
                    f"env.stations, env.slots: slots {_rounded(b)} and {_rounded(a)} overlap: {math.dist(a, b):.4g} m apart, two "
                    f"docked robots need more than Delta_G + eps = {needed:.4g} m. Move stations apart or raise env.slot_radius, "
                    "or lower env.safety_distance, env.dt or env.max_speed."
                )


def _check_battery(world: SurveillanceConfig) -> None:
    homing, span = world.homing, world.energy_max - world.energy_min
    needed = 3 * homing.eps_energy + world.max_drain_rate * world.dt
    if span <= needed:
        raise ValueError(
            f"env.energy_max - env.energy_min = {span:.4g}: E_max - E_min > 3 eps_E + P dt fails, it must exceed {needed:.4g} "
            "(one step's drain and the rounding margins). Enlarge the battery, lower env.drain_rate or shorten env.dt."
        )
    if world.reserve != "logarithmic":
        return
    if world.diameter < 2 * world.max_speed * world.dt:
        raise ValueError(
            f"env.reserve=logarithmic: diameter >= 2 max_speed dt fails with {world.diameter:.4g} < "
            f"{2 * world.max_speed * world.dt:.4g} m for env.arena={world.bounds}. Use env.reserve=linear or shorten env.dt."
        )
    needed = homing.drain_rate / homing.decay * math.log(world.diameter / homing.reserve_radius) + 4 * homing.eps_energy
    if span <= needed:
        raise ValueError(
            f"env.reserve=logarithmic: E_max - E_min > (P / k) ln(diameter / r_rho) + 4 eps_E fails with {span:.4g} <= "
            f"{needed:.4g}: home could not be reached from everywhere. Set env.drain_rate={world.drain_rate * span / needed:.2g} "
            f"or less, env.energy_max={world.energy_min + needed * 1.01:.4g} or more, or env.reserve=linear."
        )


def _check_rounding(world: SurveillanceConfig) -> None:
    """The margins that absorb rounding must themselves be small, and homing must leave more speed than is rounded away."""
    homing = world.homing
    if homing.eps_distance >= 3 * world.safety_distance:
        raise ValueError(
            f"env.safety_distance={world.safety_distance}: eps < 3 Delta fails, the rounding margin in distance is "
            f"{homing.eps_distance:.4g} m ({world.dtype}, env.arena={world.bounds}). Use env.dtype=float64 or a smaller arena."
        )
    spare = (1 - world.homing_speed) * world.max_speed * world.dt
    extent = max(abs(x) for row in world.bounds for x in row)
    # a robot on its last energy has E_min and its way home, in metres
    way = homing.speed / homing.drain_rate * world.energy_min + world.diameter + extent
    rounding = 2 * torch.finfo(world.torch_dtype).eps * way
    if spare <= rounding:
        most = 1 - 1.01 * rounding / (world.max_speed * world.dt)
        remedy = f"Set env.homing_speed={most:.5g} or less, or" if most > 0.1 else "Lower env.energy_min, or set"
        raise ValueError(
            f"env.homing_speed={world.homing_speed}: (1 - homing_speed) max_speed dt = {spare:.3g} m must exceed what "
            f"{world.dtype} rounds away, {rounding:.3g} m. {remedy} env.dtype=float64."
        )


def derived_quantities(world: SurveillanceConfig) -> dict[str, float]:
    """Quantities of the certificate that follow from a world's fields, in m, m/s, energy units and energy/s."""
    homing = world.homing
    return {
        "homing_speed": homing.speed,
        "reserve_drain_rate": homing.drain_rate,
        "break_even_radius": world.break_even_radius,
        "charge_radius_of_slot": homing.charge_radius,
        "reserve_radius": homing.reserve_radius,
        "clearance": homing.clearance,
        "eps_energy": homing.eps_energy,
        "eps_distance": homing.eps_distance,
        "reach": reach(world),
        "diameter": world.diameter,
    }


def reach(world: SurveillanceConfig) -> float:
    """Farthest distance to its slot from which a full robot is certified to get home, m.

    Below the arena's diameter parts of the arena may be out of reach; the guarantee does not depend on it.
    """
    homing = world.homing
    span = world.energy_max - world.energy_min - 2 * homing.eps_energy
    if homing.family == "logarithmic":
        exponent = span * homing.decay / homing.drain_rate
        return homing.reserve_radius * math.exp(min(exponent, 700.0))
    return homing.reserve_radius + homing.speed * span / homing.drain_rate


def _rounded(row: list[float]) -> list[float]:
    return [round(x, 4) for x in row]
