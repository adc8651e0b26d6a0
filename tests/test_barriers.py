"""Barrier rows against autograd, the accepted current against brute force, the sampled row against the exact step."""

import math

import pytest
import torch

from envs import SurveillanceConfig
from safety import SafetyConfig, SafetyFilter
from safety.barriers import (
    accepted_current,
    collision_barrier,
    energy_barrier,
    overcharge_barrier,
    sampled_energy_row,
)

torch.set_num_threads(1)
F64 = torch.float64
FAMILIES = pytest.mark.parametrize("family", ["linear", "logarithmic"])
DIMENSIONS = pytest.mark.parametrize("d", [2, 3])
DRAIN, CHARGE, E_MIN, E_MAX = 0.07, 0.4, 0.2, 9.0


def make_world(family="linear", d=2, **fields):
    fields = {"drain_rate": DRAIN, "charge_rate": CHARGE, "energy_min": E_MIN, "energy_max": E_MAX} | fields
    return SurveillanceConfig(reserve=family, dimension=d, dtype="float64", **fields)


def random_state(d, batch=200, n=3, seed=0):
    gen = torch.Generator().manual_seed(seed)
    uniform = {"generator": gen, "dtype": F64}
    position, slot = 2 * torch.rand(batch, n, d, **uniform) - 1, 2 * torch.rand(batch, n, d, **uniform) - 1
    slot[: batch // 4] = position[: batch // 4] + 0.1 * (slot[: batch // 4] - 0.5)  # some are near home
    energy, field = E_MIN + torch.rand(batch, n, **uniform), torch.rand(batch, n, **uniform)
    velocity, current = torch.randn(batch, n, d, **uniform), torch.rand(batch, n, **uniform)
    return position, slot, energy, field, velocity, current


def rate_of_change(value, position, energy, velocity, field, current):
    """h' along p' = u, E' = -K_d + K_c w c, by autograd."""
    energy_rate = -DRAIN + CHARGE * field * current
    return torch.func.jvp(value, (position, energy), (velocity, energy_rate))


@FAMILIES
@DIMENSIONS
def test_energy_row_is_the_derivative_of_its_barrier(family, d):
    geometry = make_world(family, d).homing
    position, slot, energy, field, velocity, current = random_state(d)

    def row(p, e):
        return energy_barrier(p, e, slot, field, geometry, charge_rate=CHARGE)

    value, rate = rate_of_change(lambda p, e: row(p, e).value, position, energy, velocity, field, current)
    r = row(position, energy)
    torch.testing.assert_close(r.value, value)
    got = r.drift + (r.velocity_gain * velocity).sum(-1) + r.current_gain * current
    torch.testing.assert_close(got, rate, rtol=1e-10, atol=1e-12)
    outside = r.velocity_gain.norm(dim=-1) > 0
    assert outside.any()
    assert (~outside).any()


@FAMILIES
def test_energy_barrier_is_energy_above_the_way_home(family):
    geometry = make_world(family).homing
    position, slot, energy, field, *_ = random_state(2, batch=40)
    value = energy_barrier(position, energy, slot, field, geometry, charge_rate=CHARGE).value
    for b in range(40):
        for i in range(3):
            way = math.dist(position[b, i].tolist(), slot[b, i].tolist())
            if family == "linear":
                reserve = DRAIN * max(0.0, way - geometry.charge_radius) / geometry.speed
            else:
                rate = -math.log(1 - geometry.gain * geometry.dt) / geometry.dt
                reserve = DRAIN / rate * max(0.0, math.log(way / geometry.charge_radius))
            assert value[b, i].item() == pytest.approx(energy[b, i].item() - E_MIN - reserve, abs=1e-12)


@DIMENSIONS
def test_overcharge_row_is_the_derivative_of_its_barrier(d):
    position, _, energy, field, velocity, current = random_state(d)

    def row(e):
        return overcharge_barrier(e, field, energy_max=E_MAX, drain_rate=DRAIN, charge_rate=CHARGE)

    value, rate = rate_of_change(lambda p, e: row(e).value, position, energy, velocity, field, current)
    r = row(energy)
    torch.testing.assert_close(value, E_MAX - energy)
    torch.testing.assert_close(r.drift + (r.velocity_gain * velocity).sum(-1) + r.current_gain * current, rate)


@DIMENSIONS
def test_collision_row_is_the_derivative_of_its_barrier(d):
    position, _, energy, field, velocity, current = random_state(d, n=4)

    def value(p, e):
        offset = p.unsqueeze(-2) - p.unsqueeze(-3)
        return offset.square().sum(-1) - 0.3**2

    h, rate = rate_of_change(value, position, energy, velocity, field, current)
    r = collision_barrier(position, safety_distance=0.3)
    mine = (r.velocity_gain * velocity.unsqueeze(-2)).sum(-1)
    other = (r.velocity_gain * velocity.unsqueeze(-3)).sum(-1)
    pairs = ~torch.eye(4, dtype=torch.bool).expand_as(h)
    torch.testing.assert_close(r.value[pairs], h[pairs])
    torch.testing.assert_close((r.drift + mine - other)[pairs], rate[pairs])
    assert torch.isposinf(r.value[~pairs]).all()


def test_accepted_current_is_the_largest_admissible_one():
    gen = torch.Generator().manual_seed(3)
    energy = E_MAX - 1.5 + 1.7 * torch.rand(300, 2, generator=gen, dtype=F64)  # some far above E_max
    field = torch.rand(300, 2, generator=gen, dtype=F64)
    field[:30] = 0
    alpha = 0.6
    row = overcharge_barrier(energy, field, energy_max=E_MAX, drain_rate=DRAIN, charge_rate=CHARGE)
    current, chargeable = accepted_current(row, alpha)
    grid = torch.linspace(0, 1, 20_001, dtype=F64)
    rate = DRAIN - CHARGE * field[..., None] * grid + alpha * (E_MAX - energy)[..., None]
    feasible = rate >= 0
    brute = torch.where(feasible, grid, 0.0).amax(-1)
    assert torch.equal(chargeable, feasible.any(-1))
    assert (~chargeable).any()
    assert ((brute > 0) & (brute < 1)).any()
    assert (current - brute).abs().max() <= 1 / 20_000 + 1e-12
    assert (current[~chargeable] == 0).all()


# ---- the composite h_i = min(h_c, h_o, pairs) -----------------------------------------------------------------------
def composite(world, position, energy, nominal, **gains):
    safety = SafetyConfig(mode="paper", composition="min", split="full", sampled_data=False, **gains)
    slot = torch.arange(world.n_agents).expand(position.shape[:-1])
    return SafetyFilter(safety, world).filter(nominal, position, energy, slot)


def test_tie_of_energy_and_overcharge_goes_to_energy():
    # docked half full: h_c = E - E_min = h_o = E_max - E = 0.5 exactly; only the overcharge row limits the current
    world = make_world(energy_min=0.25, energy_max=1.25)
    position = torch.tensor(world.slot_positions, dtype=F64)[None]
    energy = torch.full((1, 3), 0.75, dtype=F64)
    energy[0, 1] += 1e-9
    _, current, *_ = composite(world, position, energy, torch.zeros_like(position), alpha_o=0.01)
    assert current[0, :, 0].tolist() == [1.0, pytest.approx((DRAIN + 0.01 * 0.5) / CHARGE, rel=1e-6), 1.0]


def test_tie_of_two_pairs_goes_to_the_lower_robot():
    world = make_world(energy_max=1.2)
    position = torch.tensor([[[0.0, 0.0], [0.125, 0.0], [-0.125, 0.0]]], dtype=F64)
    energy = torch.full((1, 3), 1.0, dtype=F64)
    nominal = torch.zeros_like(position)
    for towards, free in ((1, False), (2, True)):
        nominal[0, 0] = 0.15 * position[0, towards] / 0.125
        action, *_ = composite(world, position, energy, nominal)
        assert torch.equal(action[0, 0], nominal[0, 0]) == free
    # robot 0 may approach robot 1 by alpha_s h_s / (2 |q|) at most
    nominal[0, 0] = 0.15 * position[0, 1] / 0.125
    action, *_ = composite(world, position, energy, nominal)
    speed = 0.5 / world.dt * (0.125**2 - world.safety_distance**2) / (2 * 0.125)
    torch.testing.assert_close(action[0, 0], torch.tensor([speed, 0.0], dtype=F64))


# ---- the sampled row ------------------------------------------------------------------------------------------------
def reserve_by_hand(distance, world):
    geometry = world.homing
    if geometry.family == "linear":
        radius = geometry.charge_radius - geometry.speed * world.dt
        return DRAIN / geometry.speed * (distance - radius).clamp(min=0)
    radius = geometry.charge_radius * (1 - geometry.gain * world.dt)
    rate = -math.log(1 - geometry.gain * world.dt) / world.dt
    return DRAIN / rate * (distance / radius).log().clamp(min=0)


def sampled_case(world, d, *, share, seed, gain=0.2):
    """States with h_c = share (0 <= share <= 1): position, energy, next energy, barrier, row."""
    gen = torch.Generator().manual_seed(seed)
    batch = share.shape[0]
    slot = 0.9 * (2 * torch.rand(batch, d, generator=gen, dtype=F64) - 1)
    position = 2 * torch.rand(batch, d, generator=gen, dtype=F64) - 1
    near = torch.arange(batch) % 3 == 0
    position[near] = slot[near] + 0.25 * (torch.rand(int(near.sum()), d, generator=gen, dtype=F64) - 0.5)
    distance = (position - slot).norm(dim=-1)
    floor = world.energy_min + 2 * world.homing.eps_energy
    energy = floor + reserve_by_hand(distance, world) + share
    field = ((world.charge_radius - distance) / (world.charge_radius - world.charge_radius_full)).clamp(0, 1)
    field = field**2 * (3 - 2 * field)
    next_energy = energy + world.dt * (CHARGE * field - DRAIN)  # nowhere near E_max: the battery accepts all
    step = world.max_speed * world.dt
    row = sampled_energy_row(position, energy, next_energy, slot, world.homing, gain=gain, step=step)
    return position, slot, next_energy, distance, floor, row


def speeds(world, batch, count, d, seed):
    """Velocities in the ball, half of them at full speed, where the half-space is tight."""
    gen = torch.Generator().manual_seed(seed)
    u = torch.randn(batch, count, d, generator=gen, dtype=F64)
    length = torch.rand(batch, count, 1, generator=gen, dtype=F64) ** 0.3
    length[:, ::2] = 1
    return world.max_speed * length * u / u.norm(dim=-1, keepdim=True)


@FAMILIES
@DIMENSIONS
@pytest.mark.parametrize("gain", [0.2, 1.0])
def test_sampled_row_keeps_the_barrier_for_every_velocity(family, d, gain):
    world = make_world(family, d)
    share = torch.rand(1500, generator=torch.Generator().manual_seed(1), dtype=F64) ** 4 * 0.3
    share[:300] = 0
    position, slot, next_energy, _, floor, row = sampled_case(world, d, share=share, seed=2, gain=gain)
    value, normal, bound = row
    torch.testing.assert_close(value, share, rtol=0, atol=1e-12)

    u = speeds(world, 1500, 40, d, seed=4)
    admitted = (normal[:, None] * u).sum(-1) <= bound[:, None]
    way = (position[:, None] + world.dt * u - slot[:, None]).norm(dim=-1)
    next_value = next_energy[:, None] - floor - reserve_by_hand(way, world)
    margin = next_value - (1 - gain) * value[:, None]
    assert margin[admitted].min() >= -1e-12
    assert (margin[~admitted] < 0).any()
    assert admitted.double().mean() < 0.95  # the row forbids something
    assert (~admitted).any(-1).double().mean() > 0.2


@FAMILIES
@DIMENSIONS
def test_sampled_row_is_feasible_in_the_safe_set(family, d):
    world = make_world(family, d)
    share = torch.rand(3000, generator=torch.Generator().manual_seed(5), dtype=F64) ** 4 * 0.3
    share[:1000] = 0
    *_, distance, _, (_, _, bound) = sampled_case(world, d, share=share, seed=6)
    fastest = -2 * world.dt * distance * world.max_speed  # least value of the row in the ball: straight home
    assert (bound - fastest).min() >= -1e-12
    assert (bound < 0).any()  # standing still is not always enough


@DIMENSIONS
@pytest.mark.parametrize("gain", [0.2, 1.0])
@pytest.mark.parametrize("family", ["linear", "logarithmic"])
def test_sampled_row_is_feasible_inside_the_rounding_margin(family, d, gain):
    world = make_world(family, d)
    share = -2 * world.homing.eps_energy * torch.rand(2000, generator=torch.Generator().manual_seed(7), dtype=F64)
    position, slot, next_energy, distance, floor, row = sampled_case(world, d, share=share, seed=8, gain=gain)
    value, normal, bound = row
    assert (value <= 0).all()
    assert (bound + 2 * world.dt * distance * world.max_speed).min() >= -1e-12
    # and whatever it admits leads no deeper into the margin
    u = speeds(world, 2000, 40, d, seed=9)
    admitted = (normal[:, None] * u).sum(-1) <= bound[:, None]
    way = (position[:, None] + world.dt * u - slot[:, None]).norm(dim=-1)
    next_value = next_energy[:, None] - floor - reserve_by_hand(way, world)
    assert admitted.any()
    assert (next_value - value[:, None])[admitted].min() >= -1e-12
