"""Random worlds, start states at the edge of the certified set, adversaries and roll-outs: shared by the certificate's tests.

Nothing here is a test. Everything is seeded: the same worlds and the same roll-outs in every run.
"""

import dataclasses
import functools
import itertools
import math
import random
from unittest import mock

import torch

import safety.filter
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.battery import charging_field
from envs.homing import certified_parts, homing_velocity, reserve
from envs.transition import transition
from safety import SafetyConfig, SafetyFilter
from safety.barriers import accepted_current, overcharge_barrier, sampled_energy_row
from safety.certificate import closest_approach_gradient
from safety.qp import project_halfspaces_ball

N_AGENTS, LAYOUTS, FAMILIES = (1, 2, 3, 5, 8, 16), ("perimeter", "interior", "ring", "wall"), ("linear", "logarithmic")
KINDS = ("random", "away", "chase", "point", "tangential", "broken", "descent", "block", "calm")
COUNT = 24
F64 = torch.float64
STATE = (keys.POSITION, keys.ENERGY, keys.SLOT)


# ---- worlds ---------------------------------------------------------------------------------------------------------
def draw_fields(seed):
    """Fields of a world and shares ``alpha dt`` of its gains; many of them do not fit together."""
    rng = random.Random(seed)
    n, d, layout = N_AGENTS[seed % 6], rng.choice((2, 2, 3)), LAYOUTS[seed // 6 % 4]
    family = rng.choice(FAMILIES)
    dt, gap = rng.choice((0.05, 0.1, 0.2, 0.5)), rng.uniform(0.05, 0.2)
    step = gap * 10 ** rng.uniform(-0.7, 0.2)
    speed, share = step / dt, rng.choice((0.98, 0.98, 0.9, 0.6))
    collision = rng.choice((1, 1, 0.5))
    clearance = 1.02 * math.hypot(gap, 2 * step / collision)
    spacing = 1.04 * clearance
    half = spacing * max(3, n / 6) * rng.uniform(1, 2)
    middle = rng.choice((0.0, 0.0, 3.0))
    arena = [[middle - half, middle + half], [-half, rng.uniform(0.5, 1) * half], [0.0, rng.uniform(0.4, 1) * half]]
    ring = max(2, n) if layout == "ring" else 1
    radius = spacing / (2 * math.sin(math.pi / ring)) * rng.uniform(1, 1.2) if ring > 1 else 0.0
    spots = [[rng.uniform(low, high) for low, high in arena[:d]] for _ in range(40 * n)]
    stations = []
    if layout == "interior":
        for spot in spots:
            if len(stations) < n + 1 and all(math.dist(spot, s) > spacing for s in stations):
                stations.append(spot)
    elif layout == "wall":
        (x0, x1), (y0, y1) = arena[:2]
        stations = [[x0 if k % 2 else x1, y0 + (y1 - y0) * (k // 2) / max(1, (n - 1) // 2)] for k in range(n)]
    elif layout == "ring":
        stations = [[middle, 0.2 * arena[1][0]]]
    drain = 10 ** rng.uniform(-2.5, -0.5)
    per_speed = rng.choice((0.0, rng.uniform(0.1, 1) * drain / speed))
    full = radius + rng.uniform(2.5, 5) * step
    energy_min = rng.choice((0.0, 0.1, 1.0))
    trips = rng.uniform(0.5, 2) * (1 if family == "linear" else 3)
    span = (drain + per_speed * speed) * 2.5 * half / (share * speed) * trips
    fields = {
        **{"n_agents": n, "dimension": d, "dt": dt, "max_speed": speed, "arena": arena[:d], "stations": stations},
        **{"slots": ring, "slot_radius": radius, "safety_distance": gap, "homing_speed": share, "reserve": family},
        **{"energy_min": energy_min, "energy_max": energy_min + span, "drain_rate": drain},
        **{"drain_per_speed": per_speed, "charge_rate": (drain + per_speed * speed) * rng.uniform(1.3, 8)},
        **{"charge_radius_full": full, "charge_radius": full + rng.uniform(0.5, 3) * step},
        **{"reset_reserve": 0.0, "dtype": rng.choice(("float32", "float64")), "density": "uniform", "resolution": 2},
        **({} if collision == 1 else {"homing_clearance": clearance}),
        **{"horizon": 0, "on_violation": "continue"},
    }
    shares = {"alpha_c": (0.02, 0.2, 1), "alpha_o": (0.1, 0.5, 1), "alpha_g": (0.1, 0.5, 1)}
    return fields, {name: rng.choice(values) / dt for name, values in shares.items()} | {"alpha_s": collision / dt}


@functools.cache
def draw_worlds(count):
    """The first ``count`` of the drawn worlds that the configuration accepts, and how many draws that took."""
    found = []
    for seed in itertools.count():
        fields, gains = draw_fields(seed)
        try:
            world = SurveillanceConfig(**fields)
            SafetyFilter(SafetyConfig(**gains), world)
        except ValueError:
            continue
        found.append((world, gains))
        if len(found) == count:
            return found, seed + 1


def name(world):
    """Short description of a world, for test ids."""
    layout = "ring" if world.slots != 1 else "stations"
    return f"N{world.n_agents}-{world.dimension}d-{layout}-{world.reserve[:3]}-{world.dtype[5:]}-dt{world.dt}"


# ---- states -----------------------------------------------------------------------------------------------------------
def parts(env, position, energy, slot, margins):
    """Whether every part of the certified set holds, ``(B,)``."""
    robots, pairs = certified_parts(position, energy, env.slots[slot], env.geometry, env.bounds, margins=margins)
    return robots.all(-1) & pairs.all(-1)


def edge_states(env, seed):
    """Certified start states (two margins) of which two thirds are as far to the edge of the set as bisection gets.

    Robots are driven along random directions until a wall, a pair or a reserve stops their world; then half of the
    robots lose all energy above their reserve.
    """
    td = env.reset()
    position, energy, slot = td[keys.POSITION], td[keys.ENERGY].squeeze(-1), td[keys.SLOT].squeeze(-1)
    gen = torch.Generator().manual_seed(seed)
    batch = len(position)
    to_full = (env.config.energy_max - env.geometry.eps_energy - energy) * torch.rand(batch, 1, generator=gen)
    energy = torch.maximum(energy, energy + to_full.to(energy))
    away = torch.randn(position.shape, generator=gen).to(position)
    away[::2] = (position.mean(1, keepdim=True) - position)[::2]  # towards each other
    low, high = env.bounds.unbind(-1)
    near, far = torch.zeros(batch, 1, 1).to(position), torch.ones(batch, 1, 1).to(position)

    def moved(t):
        return (position + t * away).clamp(low, high)

    for _ in range(40):
        t = (near + far) / 2
        good = parts(env, moved(t), energy, slot, 2)[:, None, None]
        near, far = torch.where(good, t, near), torch.where(good, far, t)
    edge = torch.arange(batch) % 3 > 0
    position = torch.where(edge[:, None, None], moved(near), position)
    way = (position - env.slots[slot]).norm(dim=-1)
    least = env.config.energy_min + 2.1 * env.geometry.eps_energy + reserve(way, env.geometry)
    poor = edge[:, None] & (torch.rand(energy.shape, generator=gen) < 0.5)
    energy = torch.where(poor, torch.minimum(least, energy), energy)
    certified = parts(env, position, energy, slot, 2)
    docked_energy = env.config.energy_min + 2.1 * env.geometry.eps_energy
    docked = torch.arange(slot.shape[1]).expand_as(slot)
    position = torch.where(certified[:, None, None], position, env.slots[docked])
    energy = torch.where(certified[:, None], energy, torch.maximum(energy, energy.new_tensor(docked_energy)))
    return position, energy, torch.where(certified[:, None], slot, docked)


def field_at(world, position, stations):
    """Charging field w(p)."""
    radii = {"full_radius": world.charge_radius_full, "zero_radius": world.charge_radius}
    return charging_field(position, stations, **radii)


def accepted(world, position, energy, stations, alpha_o):
    """Current that the filter accepts, and the least next energy with it: at full drain."""
    field = field_at(world, position, stations)
    rates = {"energy_max": world.energy_max, "drain_rate": world.drain_rate, "charge_rate": world.charge_rate}
    row = overcharge_barrier(energy, field, **rates)
    current, _ = accepted_current(row._replace(value=row.value - world.homing.eps_energy), alpha_o)
    return current, energy + world.dt * (world.charge_rate * field * current - world.max_drain_rate)


def every_robots_rows(position, *args, build=safety.filter.certified_rows, **kwargs):
    """certified_rows of all robots, not only of those that may violate one: ``G (M, N, m, d), h (M, N, m)``."""
    rows = build(position, *args, **{**kwargs, "target": None})
    return rows._replace(G=rows.G.unflatten(0, position.shape[:2]), h=rows.h.unflatten(0, position.shape[:2]))


@functools.cache
def edge_rows(index, batch=48):
    """World ``index``: environment, states at the edge of the set, their slots' places, current and rows."""
    world, gains = draw_worlds(COUNT)[0][index]
    env = SurveillanceEnv(world, batch, seed=index)
    position, energy, slot = edge_states(env, index)
    home, alphas = env.slots[slot], SafetyConfig(**gains).gains(world)
    current, worst = accepted(world, position, energy, env.stations, alphas.overcharge)
    step = {"gain": alphas.energy * world.dt, "step": world.max_speed * world.dt}
    _, normal, bound = sampled_energy_row(position, energy, worst, home, world.homing, **step)
    limits = {"safety_distance": world.safety_distance, "max_speed": world.max_speed}
    rows = every_robots_rows(position, home, normal, bound, env.bounds, world.homing, alphas, **limits)
    return env, position, energy, slot, home, current, rows


# ---- adversaries ------------------------------------------------------------------------------------------------------
class Adversary:
    """Every robot follows one of KINDS, drawn anew now and then; in every second world all robots the same."""

    def __init__(self, world, seed, kinds=KINDS):
        self.world, self.kinds = world, kinds
        self.gen = torch.Generator().manual_seed(seed)
        self.kind = None

    def _uniform(self, *shape):
        return torch.rand(*shape, generator=self.gen, dtype=F64)

    def __call__(self, position, slot_position):
        world, (b, n, d) = self.world, position.shape
        if self.kind is None:
            self.kind = torch.full((b, n), -1)
            self.point = position.mean(1, keepdim=True)
        fresh = (self._uniform(b, n) * len(self.kinds)).long()
        fresh[::2] = fresh[::2, :1]
        renew = self._uniform(b, 1) < 0.1
        self.kind = torch.where(renew | (self.kind < 0), fresh, self.kind)
        noise = (2 * self._uniform(b, n, d) - 1).to(position)
        actions = torch.stack([getattr(self, "_" + kind)(position, slot_position, noise) for kind in self.kinds])
        index = self.kind[None, ..., None].expand(1, b, n, d)
        return world.max_speed * actions.gather(0, index).squeeze(0)

    def _random(self, position, slot_position, noise):
        return 2 * noise

    def _calm(self, position, slot_position, noise):
        return 0.3 * noise

    def _away(self, position, slot_position, noise):
        return _unit(position - slot_position + 1e-4 * noise) * 3

    def _tangential(self, position, slot_position, noise):
        e = _unit(position - slot_position + 1e-4 * noise)
        return _unit(torch.stack([-e[..., 1], e[..., 0], *e.unbind(-1)[2:]], -1) - e * (e[..., 2:] ** 2).sum(-1, True))

    def _point(self, position, slot_position, noise):
        return _unit(self.point - position)

    def _block(self, position, slot_position, noise):
        return (slot_position.roll(1, 1) - position) / (self.world.max_speed * self.world.dt)

    def _chase(self, position, slot_position, noise):
        gap = torch.cdist(position, position) + torch.diag(torch.full(position.shape[1:2], 1e9)).to(position)
        return _unit(position.gather(1, gap.argmin(-1)[..., None].expand_as(position)) - position)

    def _broken(self, position, slot_position, noise):
        bad = torch.tensor([math.nan, math.inf, -math.inf, 1e30, 0.0, 1.0]).to(position)
        return torch.where(self._uniform(*noise.shape) < 0.2, bad[(3 + 2.99 * noise).long()], noise)

    def _descent(self, position, slot_position, noise):
        n = position.shape[1]
        if n == 1:
            return noise
        gap, first, second = closest_approach_gradient(position, slot_position, self.world.homing)
        i, j = torch.triu_indices(n, n, 1)
        slope = torch.zeros_like(position)
        weight = (-40 * (gap - gap.amin(-1, keepdim=True)) / self.world.safety_distance).exp()[..., None]
        return -_unit(slope.index_add(1, i, weight * first).index_add(1, j, weight * second))


def _unit(vector):
    return vector / vector.norm(dim=-1, keepdim=True).clamp_min(1e-30)


# ---- roll-outs --------------------------------------------------------------------------------------------------------
@dataclasses.dataclass
class Record:
    """A roll-out: everything that was read and written, and the programs' rows."""

    world: SurveillanceConfig
    env: SurveillanceEnv
    filter: SafetyFilter
    data: dict
    """Tensors ``(T, B, ..)`` by short name, what the environment made of them as next_..; (T, B, N) where one number a robot."""
    rows: list
    """Rows of all robots in every step (certified only)."""
    pressed: list
    """Which robots the filter solved a program for, in every step (certified only)."""


def roll_out(
    world, gains, *, worlds=16, steps=36, seed=0, kinds=KINDS, keep_rows=True, fixed_sizes=False, **safety_fields
):
    """Run the filter in the world against the adversary, from edge states; ``keep_rows``: with the rows of every robot."""
    env = SurveillanceEnv(world, worlds, seed=seed, fixed_sizes=fixed_sizes)
    safety_filter = SafetyFilter(SafetyConfig(**{**gains, **safety_fields}), world, fixed_sizes=fixed_sizes)
    position, energy, slot = edge_states(env, seed)
    td = env.set_state(position, energy.unsqueeze(-1), slot.unsqueeze(-1))
    adversary, records, rows, pressed = Adversary(world, seed, kinds), [], [], []
    build = safety.filter.certified_rows

    def keep(*args, **kwargs):
        rows.append(every_robots_rows(*args, build=build, **kwargs))
        rows_given = build(*args, **kwargs)
        pressed.append(rows_given.robots)
        return rows_given

    with mock.patch("safety.filter.certified_rows", keep if keep_rows else build):
        for _ in range(steps):
            td = td.select(*STATE)
            td[keys.NOMINAL_ACTION] = adversary(td[keys.POSITION], env.slots[td[keys.SLOT].squeeze(-1)])
            read = (*STATE, keys.NOMINAL_ACTION, *safety_filter.out_keys)
            after = env.step(safety_filter(td))["next"]
            record = {key[-1]: td[key].clone() for key in read}
            record |= {f"next_{key[-1]}": after[key] for key in STATE}
            record |= {kind: after[(*keys.VIOLATION, kind)] for kind in keys.VIOLATION_KINDS}
            records.append(record)
            td = after
    data = {name: torch.stack([record[name] for record in records]) for name in records[0]}
    data = {name: x.squeeze(-1) if x.dim() == 4 and x.shape[-1] == 1 else x for name, x in data.items()}
    return Record(world, env, safety_filter, data, rows, pressed)


def raw_margins(record):
    """Least raw margins of a roll-out, computed apart from envs.metrics: in float64, distances between samples too.

    Returns:
        ``(T, B, N)`` energy above E_min, energy below E_max, energy above the fastest way to the nearest slot; and
        ``(T, B)`` least distance of any two robots over the step minus Delta (inf for one robot).
    """
    world, data = record.world, record.data
    start, end, energy = (data[name].double() for name in ("position", "next_position", "next_energy"))
    way = torch.cdist(end, torch.tensor(world.slot_positions, dtype=F64), compute_mode=_EXACT).amin(-1)
    trip = world.drain_rate * (way - world.break_even_radius).clamp(min=0) / world.max_speed
    least = torch.full(start.shape[:2], math.inf, dtype=F64)
    for i, j in itertools.combinations(range(world.n_agents), 2):
        q = start[..., i, :] - start[..., j, :]
        w = end[..., i, :] - end[..., j, :] - q
        a, b, c = (w * w).sum(-1), (q * w).sum(-1), (q * q).sum(-1)
        inner = c - b * b / a.clamp(min=1e-300)  # the parabola's vertex, where it lies inside the step
        square = torch.where((b < 0) & (-b < a), inner, torch.minimum(c, a + 2 * b + c))
        least = torch.minimum(least, square.clamp(min=0).sqrt())
    return (
        energy - world.energy_min,
        world.energy_max - energy,
        energy - world.energy_min - trip,
        least - world.safety_distance,
    )


_EXACT = "donot_use_mm_for_euclid_dist"


def lone_robots(world, way, geometry, *, chord=1.0, steps=100, batch=128):
    """Robots behind the survivability row alone (no shield), pushed along ``way`` at full speed: energies ``(T, B)``."""
    gen, step = torch.Generator().manual_seed(0), world.max_speed * world.dt
    stations = torch.tensor(world.station_positions, dtype=F64)
    home = stations[:1].expand(batch, 1, -1)
    offset = torch.nn.functional.normalize(torch.randn(batch, 1, 2, generator=gen, dtype=F64), dim=-1)
    position = home + 0.8 * torch.rand(batch, 1, 1, generator=gen, dtype=F64) * offset
    energy = world.energy_min + 2 * geometry.eps_energy + reserve((position - home).norm(dim=-1), geometry)
    spare = 0.3 * torch.rand(batch, 1, generator=gen, dtype=F64)
    energy = energy + torch.where(torch.arange(batch).unsqueeze(-1) % 2 > 0, spare, 0.0)
    energies = []
    for _ in range(steps):
        e = torch.nn.functional.normalize(position - home + 1e-9, dim=-1)
        side = torch.stack([-e[..., 1], e[..., 0]], -1)
        home_speed = homing_velocity(position, home, world.homing)
        nominal = (
            {"away": e, "tangential": side, "home": home_speed / world.max_speed}[way] * world.max_speed * (1 - 1e-6)
        )
        field = field_at(world, position, stations)
        full = torch.ones_like(energy)
        worst = energy + world.dt * (world.charge_rate * field - world.max_drain_rate)
        _, normal, bound = sampled_energy_row(position, energy, worst, home, geometry, gain=0.2, step=step)
        bound = bound + (1 - chord) * step**2
        solved = project_halfspaces_ball(nominal, normal.unsqueeze(-2), bound.unsqueeze(-1), world.max_speed)
        action = torch.where(
            (solved.status == 0).unsqueeze(-1), solved.value, homing_velocity(position, home, geometry)
        )
        position, energy = transition(position, energy, action, full, stations, world)
        energies.append(energy[:, 0])
    return torch.stack(energies)


def segment_distance(start, end):
    """Distance of the origin to the segment from ``start`` to ``end``, ``(..., d), (..., d) -> (...)``."""
    along = end - start
    t = (-(start * along).sum(-1) / along.square().sum(-1).clamp_min(1e-30)).clamp(0, 1)
    return (start + t.unsqueeze(-1) * along).norm(dim=-1)
