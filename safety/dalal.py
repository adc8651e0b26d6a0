"""The learned safety layer: linear constraint models fitted before training, and a correction in closed form.

Robot i's constraints are the negated barriers of :mod:`safety.barriers`, ``c_k = -h_k <= 0``: survivability, overcharge
and one per other robot (the others are part of the state, as for the paper's filter). With its action
``a = (u / max_speed, c)`` the model is

    c_k(s') ~ c_k(s) + b_k(s) + g_k(s)^T a,

``g`` and ``b`` being one network of the robot's own relative features, shared by all robots and fitted by least squares
to transitions of random actions. The layer solves ``min ||a - a^||^2`` under the most violated constraint alone:

    a* = a^ - lambda_k g_k,   lambda_k = max(0, (g_k^T a^ + c_k + b_k + margin) / g_k^T g_k),   k = argmax lambda_k,

then clamps the current to [0, 1] and cuts the velocity to the speed ball. A baseline without a promise: the model errs,
one constraint is served at a time, the cuts come after, and the others move.

Three additions to the source's model: the margin (``safety.dalal_margin`` steps); the drift ``b`` (a battery drains
whatever its robot does; without ``b``, ``safety.dalal_drift=false``, the fit puts the drain into ``g``); and a floor of
``g^T g``, because a constraint that the action does not reach (overcharge, away from the stations) must not win the
argmax by a division by zero (below the floor the correction falls short of its constraint).

Source: Dalal et al., Safe exploration in continuous action spaces, arXiv 1801.08757.
"""

import dataclasses
import functools
import itertools
import json
import math
from typing import NamedTuple

import torch
from torch import Tensor

from envs.battery import charging_field
from envs.config import SurveillanceConfig
from envs.dynamics import FULL_SPEED, length, limit_speed, other_indices
from envs.starts import draw_starts
from envs.transition import transition
from safety.barriers import BarrierRow, literal_geometry, literature_barriers
from safety.config import SafetyConfig

SAMPLES = 120_000  # robot-steps of random actions that a model is fitted to
ROLL_STEPS = 40  # that a world is rolled, through violations too, so that states near the limits are seen
HOLD_STEPS = 8  # mean number of steps that a robot keeps a random action: it gets somewhere
DOCKED = 1 / 3  # share of the worlds that start docked, with any energy: charging fields are a small part of the arena
HIDDEN = 64  # units of each of the two hidden layers
BATCH = 512
LEARNING_RATE = 5e-3  # of Adam, falling to 0 along a cosine
GAIN_FLOOR = 0.1  # least g^T g that a correction divides by; 1 is an action's full effect, see constraint_units
SEED = 1801


class Samples(NamedTuple):
    """Transitions of ``S`` robots; constraints in the units of :func:`constraint_units`."""

    features: Tensor  # (S, F)
    action: Tensor  # (S, d + 1), (u / max_speed, c)
    constraint: Tensor  # (S, N + 1), c(s)
    change: Tensor  # (S, N + 1), c(s') - c(s)


class Layout(NamedTuple):
    """Slots ``(S, d)`` and stations ``(M, d)``, m, and the network's weights and biases, on one device in one type."""

    slots: Tensor
    stations: Tensor
    weights: tuple[Tensor, ...]


class ConstraintModel(NamedTuple):
    """A fitted network: plain tensors, no module, so that no loss or optimiser takes them for its own."""

    weights: tuple[Tensor, ...]
    """Weight and bias of each layer in turn, float32."""
    r_squared: dict[str, float]
    """Explained share of the variance of ``c(s') - c(s)`` on fresh transitions: energy, overcharge, collision (half of a
    pair's variance is the other robot's random motion)."""


def constraint_units(world: SurveillanceConfig) -> tuple[float, float, float]:
    """Units of survivability, overcharge (energy) and collision (m^2): the most that one step of driving, charging and
    approaching (at contact) changes each, so that the multipliers that the argmax compares are shares of an action.
    """
    dt = world.dt
    return world.max_drain_rate * dt, world.charge_rate * dt, 2 * world.safety_distance * world.max_speed * dt


def constraints(rows: tuple[BarrierRow, BarrierRow, BarrierRow], world: SurveillanceConfig) -> Tensor:
    """``c = -h`` of :func:`safety.barriers.literature_barriers` in its units, ``(*B, N, N + 1)``, others in cyclic order."""
    (h_c, h_o, h_s), (energy, overcharge, pair) = rows, constraint_units(world)
    others = other_indices(world.n_agents, h_s.value.device).expand(*h_s.value.shape[:-1], -1)
    parts = (h_c.value.unsqueeze(-1) / energy, h_o.value.unsqueeze(-1) / overcharge)
    return -torch.cat([*parts, h_s.value.gather(-1, others) / pair], dim=-1)


def features(position: Tensor, energy: Tensor, slot: Tensor, layout: Layout, world: SurveillanceConfig) -> Tensor:
    """What robot i's gains depend on, ``(*B, N, F)``: way to the own slot (vector, length, direction), nearest station,
    energy, vectors to the others; ``position (*B, N, d)`` m, ``energy`` and ``slot (*B, N)``.
    """
    scale, offset = world.length_scale, position - layout.slots[slot]
    distance = length(offset).unsqueeze(-1)
    station = length(position.unsqueeze(-2) - layout.stations).amin(dim=-1, keepdim=True)
    share = (energy.unsqueeze(-1) - world.energy_min) / (world.energy_max - world.energy_min)
    others = position[..., other_indices(world.n_agents, position.device), :] - position.unsqueeze(-2)
    direction = offset / distance.clamp_min(0.2 * world.charge_radius)
    parts = (offset / scale, distance / scale, direction, (station / world.charge_radius).clamp_max(2), share)
    return torch.cat([*parts, others.flatten(-2) / scale], dim=-1)


def network(inputs: Tensor, weights: tuple[Tensor, ...], world: SurveillanceConfig) -> tuple[Tensor, Tensor]:
    """Gains ``g (*B, N + 1, d + 1)`` and drift ``b (*B, N + 1)`` at features ``(*B, F)``."""
    for weight, bias in zip(weights[:-2:2], weights[1:-2:2], strict=True):
        inputs = (inputs @ weight + bias).relu()
    out = (inputs @ weights[-2] + weights[-1]).unflatten(-1, (world.n_agents + 1, world.dimension + 2))
    return out[..., :-1], out[..., -1]


def closed_form(action: Tensor, gain: Tensor, value: Tensor) -> Tensor:
    """What to subtract from the action so that the constraint with the largest multiplier holds; 0 if none is violated.

    Args:
        action: ``(*B, D)``.
        gain: ``(*B, K, D)``.
        value: ``(*B, K)``; constraint k is ``gain_k . action + value_k <= 0``.

    Returns:
        ``(*B, D)``.
    """
    excess = (gain * action.unsqueeze(-2)).sum(-1) + value
    multiplier = (excess / gain.square().sum(-1).clamp_min(GAIN_FLOOR)).clamp_min(0)
    largest, k = multiplier.max(dim=-1, keepdim=True)
    chosen = gain.gather(-2, k.unsqueeze(-1).expand(*k.shape, gain.shape[-1])).squeeze(-2)
    return largest * chosen


def sample_transitions(world: SurveillanceConfig, samples: int, generator: torch.Generator) -> Samples:
    """At least ``samples`` robot-steps of random actions from certified start states, float32."""
    layout, geometry, bounds = _layout(world), literal_geometry(world), torch.tensor(world.bounds, dtype=torch.float32)
    radii = {"full_radius": world.charge_radius_full, "zero_radius": world.charge_radius}

    def values(position: Tensor, energy: Tensor) -> Tensor:
        field = charging_field(position, layout.stations, **radii)
        return constraints(literature_barriers(position, energy, layout.slots[slot], field, geometry, world), world)

    worlds = math.ceil(samples / (ROLL_STEPS * world.n_agents))
    position, energy, slot = draw_starts(worlds, world, world.homing, layout.slots, bounds, generator)
    docked = torch.arange(worlds) < DOCKED * worlds
    position[docked] = layout.slots[slot[docked]]
    energy[docked] = torch.empty_like(energy[docked]).uniform_(world.energy_min, world.energy_max, generator=generator)
    velocity, current, rows, now = torch.zeros_like(position), torch.zeros_like(energy), [], values(position, energy)
    for step in range(ROLL_STEPS):
        fresh = torch.rand(energy.shape, generator=generator) < (1 / HOLD_STEPS if step else 1)
        direction = torch.nn.functional.normalize(torch.randn(position.shape, generator=generator), dim=-1)
        radius = torch.rand(energy.shape, generator=generator) ** (1 / world.dimension)
        velocity = torch.where(fresh.unsqueeze(-1), direction * radius.unsqueeze(-1), velocity)
        current = torch.where(fresh, torch.rand(energy.shape, generator=generator), current)
        seen = features(position, energy, slot, layout, world)
        action = torch.cat([velocity, current.unsqueeze(-1)], dim=-1)
        position, energy = transition(position, energy, velocity * world.max_speed, current, layout.stations, world)
        before, now = now, values(position, energy)
        rows.append((seen, action, before, now - before))
    return Samples(*(torch.stack(column).flatten(0, 2) for column in zip(*rows, strict=True)))


def fit(world: SurveillanceConfig, steps: int, *, drift: bool = True) -> ConstraintModel:
    """The model of a world, fitted once per process: ``steps`` steps of Adam, about 10 s for 3000 on one core.

    Least squares weighted by ``1 / (1 + |c_k|)``: the gains matter near the limits, and a pair's grows with its distance.
    The same result on the same machine with the same number of threads; the global random stream is not touched.
    """
    return _fit(json.dumps(dataclasses.asdict(world)), steps, drift)


@functools.lru_cache(maxsize=16)
def _fit(description: str, steps: int, drift: bool) -> ConstraintModel:
    world = SurveillanceConfig(**json.loads(description))
    generator = torch.Generator().manual_seed(SEED)
    with torch.inference_mode(False), torch.enable_grad():
        data = sample_transitions(world, SAMPLES, generator)
        sizes = (data.features.shape[-1], HIDDEN, HIDDEN, (world.n_agents + 1) * (world.dimension + 2))
        start = []
        for inputs, outputs in itertools.pairwise(sizes):
            uniform = 2 * torch.rand(inputs, outputs, generator=generator) - 1
            start += [uniform * math.sqrt(6 / (inputs + outputs)), torch.zeros(outputs)]
        weights = tuple(weight.requires_grad_() for weight in start)
        optimizer = torch.optim.Adam(weights, lr=LEARNING_RATE)
        for step in range(steps):
            optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1 + math.cos(math.pi * step / steps)) / 2
            chosen = torch.randint(len(data.features), (BATCH,), generator=generator)
            batch = Samples(*(x[chosen] for x in data))
            error = _predict(batch, weights, world, drift) - batch.change
            loss = (error.square() / (1 + batch.constraint.abs())).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    weights = tuple(weight.detach() for weight in weights)
    return ConstraintModel(weights, _r_squared(weights, world, drift, generator))


def _predict(data: Samples, weights: tuple[Tensor, ...], world: SurveillanceConfig, drift: bool) -> Tensor:
    gain, offset = network(data.features, weights, world)
    return (gain * data.action.unsqueeze(-2)).sum(-1) + drift * offset


@torch.no_grad()
def _r_squared(weights: tuple[Tensor, ...], world: SurveillanceConfig, drift: bool, generator: torch.Generator) -> dict:
    data = sample_transitions(world, SAMPLES // 6, generator)
    error = _predict(data, weights, world, drift) - data.change
    explained = 1 - error.square().mean(0) / data.change.var(0, correction=0)
    kinds = (("energy", explained[:1]), ("overcharge", explained[1:2]), ("collision", explained[2:]))
    return {name: float(share.mean()) for name, share in kinds if len(share)}


def _layout(world: SurveillanceConfig, weights: tuple[Tensor, ...] = (), like: Tensor | None = None) -> Layout:
    factory = {"dtype": torch.float32} if like is None else {"dtype": like.dtype, "device": like.device}
    places = (torch.tensor(x, **factory) for x in (world.slot_positions, world.station_positions))
    return Layout(*places, tuple(weight.to(**factory) for weight in weights))


class DalalLayer:
    """The fitted layer of a world; called like the filter's quadratic program. Not a module: its weights are frozen."""

    def __init__(self, safety: SafetyConfig, world: SurveillanceConfig) -> None:
        self.safety, self.world = safety, world
        self.model = fit(world, safety.dalal_steps, drift=safety.dalal_drift)
        self._layouts: dict[tuple[torch.device, torch.dtype], Layout] = {}

    def __call__(
        self, target: Tensor, position: Tensor, energy: Tensor, slot: Tensor, *rows: BarrierRow
    ) -> tuple[Tensor, ...]:
        """Action ``(*B, N, d)``, current, status (always SOLVED) and residual (0) ``(*B, N)`` at a speed-limited target."""
        gain, value = self.linear_model(position, energy, slot, *rows)
        nominal = torch.cat([target / self.world.max_speed, torch.ones_like(energy).unsqueeze(-1)], dim=-1)
        correction = closed_form(nominal, gain, value)
        # in m/s: a target without correction stays as it is to the last bit
        action = limit_speed(target - self.world.max_speed * correction[..., :-1], self.world.max_speed, FULL_SPEED)
        return action, (1 - correction[..., -1]).clamp(0, 1), torch.zeros_like(slot), torch.zeros_like(energy)

    def linear_model(self, position: Tensor, energy: Tensor, slot: Tensor, *rows: BarrierRow) -> tuple[Tensor, Tensor]:
        """Gains ``g (*B, N, N + 1, d + 1)`` and values ``c + b + margin (*B, N, N + 1)``."""
        key = (position.device, position.dtype)
        if key not in self._layouts:
            self._layouts[key] = _layout(self.world, self.model.weights, position)
        layout = self._layouts[key]
        gain, drift = network(features(position, energy, slot, layout, self.world), layout.weights, self.world)
        value = constraints(rows, self.world) + self.safety.dalal_drift * drift
        energy_unit, overcharge_unit, _ = constraint_units(self.world)
        margin = value.new_full(value.shape[-1:], self.safety.dalal_margin)
        margin[1] *= energy_unit / overcharge_unit  # both energies keep the same distance from their limit
        return gain, value + margin
