"""Limits of the guarantee: inequalities refused with their numbers, and lemmas of docs/safety.md that no other file covers."""

import itertools
import math
import re

import pytest
import torch

from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.battery import charging_field
from envs.homing import is_certified
from envs.inequalities import derived_quantities, least_clearance, reach
from safety import SafetyConfig, SafetyFilter
from tests.worlds import COUNT, draw_worlds, roll_out, segment_distance

torch.set_num_threads(1)
F64 = torch.float64
POWER = {"drain_rate": 0.02, "drain_per_speed": 0.2, "charge_rate": 0.1}  # P(max_speed) = 0.06
LOG = {"reserve": "logarithmic", "drain_rate": 0.02}


def refused(world, **safety):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the callers check the message)
        SafetyConfig(**safety).gains(SurveillanceConfig(**world))
    assert len(str(error.value).splitlines()) <= 8
    return str(error.value)


# ---- every inequality: what fails, with which numbers, and what would do --------------------------------------------
REFUSED = {
    "1 alpha dt <= 1": ({"dt": 0.1}, {"alpha_g": 10.1}, r"safety\.alpha_g=10\.1 .*\(0, 10"),
    "2 K_c > P": ({"charge_rate": 0.06}, {}, r"env\.charge_rate=0\.06: K_c > P\(max_speed\) fails.*0\.06"),
    "2 r_rho >= 2U": ({"dt": 0.5}, {}, r"env\.charge_radius=0\.24: r_rho >= 2 max_speed dt fails.*0\.2 m"),
    "4 least clearance": (
        {"homing_clearance": 0.13},
        {},
        r"env\.homing_clearance=0\.13: Delta_G\^2 >= .* at least 0\.1447 m",
    ),
    "4 clearance of the gain": (
        {},
        {"alpha_s": 2.5},
        r"safety\.alpha_s=2\.5: Delta_G\^2 >= .*0\.1447 < 0\.2004 m.*null \(5\)",
    ),
    "5 fewer slots": ({"n_agents": 2, "stations": [[0, 0]]}, {}, r"1 slots for env\.n_agents=2 robots"),
    "5 slots too close": (
        {"n_agents": 2, "stations": [[0, 0], [0.14, 0]]},
        {},
        r"0\.14 m apart, two docked robots need more than Delta_G \+ eps = 0\.1453 m",
    ),
    "5 slot outside": ({"n_agents": 1, "stations": [[0, 2]]}, {}, r"outside env\.arena"),
    "6 battery of a step": ({"energy_max": 0.11}, {}, r"E_max - E_min > 3 eps_E \+ P dt fails"),
    "6 throttled charging": (POWER, {"alpha_o": 0.04}, r"safety\.alpha_o=0\.04 throttles .*Raise it above"),
    "6 logarithmic battery": (
        {"reserve": "logarithmic"},
        {},
        r"env\.reserve=logarithmic: E_max - E_min > .*env\.drain_rate=",
    ),
    "9 rounding of distances": (
        {"arena": [[0, 1], [1e5, 1e5 + 1]]},
        {},
        r"eps < 3 Delta fails.*env\.dtype=float64",
    ),
    "10 logarithmic in a small arena": (
        {"n_agents": 1, "stations": [[0, 0]], "arena": [[-0.02, 0.02]] * 2, "charge_radius": 1.0, **LOG},
        {},
        r"env\.reserve=logarithmic: diameter >= 2 max_speed dt fails",
    ),
    "11 homing speed": ({"homing_speed": 0.99999}, {}, r"env\.homing_speed=0\.99999"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_world_without_a_guarantee_is_refused_with_its_inequality(name):
    world, safety, message = REFUSED[name]
    assert re.search(message, refused(world, **safety))


def test_nearest_values_that_messages_name_are_accepted():
    for world, safety, pattern, field in (
        ({}, {"alpha_s": 2.5}, r"env\.homing_clearance=([\d.]+)", "homing_clearance"),
        ({"reserve": "logarithmic"}, {}, r"env\.drain_rate=([\d.]+)", "drain_rate"),
        ({"reserve": "logarithmic"}, {}, r"env\.energy_max=([\d.]+)", "energy_max"),
        ({"homing_clearance": 0.13}, {}, r"at least ([\d.]+)", "homing_clearance"),
    ):
        value = float(re.search(pattern, refused(world, **safety)).group(1).rstrip("."))
        value = value * 1.001 if field == "homing_clearance" else value
        SafetyConfig(**safety).gains(SurveillanceConfig(**{**world, field: value}))
    needed = float(re.search(r"above ([\d.]+)", refused(POWER, alpha_o=0.04)).group(1).rstrip("."))
    SafetyConfig(alpha_o=needed * 1.001).gains(SurveillanceConfig(**POWER))
    by = float(re.search(r"by ([\d.e-]+),", refused({"dt": 0.5})).group(1).rstrip("."))
    SurveillanceConfig(dt=0.5, charge_radius=0.24 + by, charge_radius_full=0.12 + by)


def test_derived_quantities_are_the_geometry():
    world = SurveillanceConfig()
    certificate, g = derived_quantities(world), world.homing
    assert certificate["clearance"] == g.clearance == least_clearance(world, g.eps_distance)
    assert certificate["reserve_radius"] == g.reserve_radius == pytest.approx(0.1697, abs=1e-4)
    assert certificate["reach"] == pytest.approx(g.reserve_radius + 0.196 * 0.9 / 0.06, rel=1e-3)
    log = SurveillanceConfig(**LOG)
    rho = log.drain_rate / log.homing.decay * math.log(reach(log) / log.homing.reserve_radius)
    assert rho == pytest.approx(0.9 - 2 * log.homing.eps_energy, rel=1e-6)


# ---- lemmas ---------------------------------------------------------------------------------------------------------
def test_a_charger_carries_the_full_drain_inside_the_slots_charging_radius():
    """Section 1: the radius is measured from the slot, the field from the station."""
    for slots, power in itertools.product((1, 3), ({}, POWER)):
        world = SurveillanceConfig(
            stations=[[0.0, 0.0], [0.7, 0.7], [-0.7, 0.7]], slots=slots, charge_radius=0.35, **power
        )
        stations, places = (torch.tensor(x, dtype=F64) for x in (world.station_positions, world.slot_positions))
        gen = torch.Generator().manual_seed(slots)
        offset = torch.randn(4000, len(places), 2, generator=gen, dtype=F64)
        radius = world.homing.charge_radius * torch.rand(4000, len(places), 1, generator=gen, dtype=F64) ** 0.1
        point = places + radius * offset / offset.norm(dim=-1, keepdim=True)
        radii = {"full_radius": world.charge_radius_full, "zero_radius": world.charge_radius}
        surplus = world.charge_rate * charging_field(point, stations, **radii) - world.max_drain_rate
        assert surplus.min() >= -1e-9
        assert surplus.min() < 0.2 * world.max_drain_rate  # the bound is nearly met


@pytest.mark.parametrize("d", [2, 3])
def test_lemma_6_closest_approach_of_the_logarithmic_family(d):
    gen = torch.Generator().manual_seed(d)
    q, s = torch.randn(2, 20000, d, generator=gen, dtype=F64)
    s = torch.where((q * s).sum(-1, keepdim=True) >= 0, s, -s)
    distance = segment_distance(q, s)
    bound = q.norm(dim=-1) * s.norm(dim=-1) / (q.square().sum(-1) + s.square().sum(-1)).sqrt()
    assert (distance - bound).min() >= -1e-12
    assert (distance / bound).min() < 1.001


def test_lemma_6_the_best_assignment_of_separated_robots_is_certified():
    world = SurveillanceConfig(n_agents=4, dtype="float64", **LOG)
    g, slots, bounds = (
        world.homing,
        torch.tensor(world.slot_positions, dtype=F64),
        torch.tensor(world.bounds, dtype=F64),
    )
    position = 2 * torch.rand(3000, 4, 2, generator=torch.Generator().manual_seed(0), dtype=F64) - 1
    apart = torch.stack([(position[:, i] - position[:, j]).norm(dim=-1) for i in range(4) for j in range(i)]).amin(0)
    position = position[apart > math.sqrt(2) * (g.clearance + g.eps_distance)]
    assert len(position) > 500
    orders = torch.tensor(list(itertools.permutations(range(4))))
    cost = (position.unsqueeze(1) - slots[orders]).square().sum((-1, -2))
    best = orders[cost.argmin(-1)]
    full = torch.full(position.shape[:2], world.energy_max, dtype=F64)
    assert is_certified(position, full, slots[best], g, bounds).all()
    worst = orders[cost.argmax(-1)]
    assert not is_certified(position, full, slots[worst], g, bounds).all()


# ---- between samples, walls, long runs ------------------------------------------------------------------------------
@pytest.mark.parametrize("index", [k for k in range(COUNT) if draw_worlds(COUNT)[0][k][0].n_agents > 1][::4])
def test_distance_between_samples_keeps_the_chord_bound(index):
    """Corollary 2: sqrt(Delta_G^2 - U^2), up to a rounding margin."""
    world, gains = draw_worlds(COUNT)[0][index]
    record = roll_out(world, gains, seed=index, keep_rows=False)
    g, step = world.homing, world.max_speed * world.dt
    before, after = (record.data[key].double() for key in ("position", "next_position"))
    i, j = torch.triu_indices(world.n_agents, world.n_agents, 1)
    least = segment_distance(before[..., i, :] - before[..., j, :], after[..., i, :] - after[..., j, :]).min()
    assert least >= math.sqrt(g.clearance**2 - step**2) - g.eps_distance
    assert least < 1.5 * g.clearance


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_docked_robots_on_a_wall_stay_in_the_set(dtype):
    """Rounding must not carry a robot in its slot on the floor out of the arena for good."""
    world = SurveillanceConfig(dimension=3, dt=0.05, dtype=dtype, resolution=2, density="uniform")
    env, f = SurveillanceEnv(world, 16, seed=0), SafetyFilter(SafetyConfig(), world)
    td = env.reset()
    for _ in range(400):
        offset = env.slots[td[keys.SLOT].squeeze(-1)] - td[keys.POSITION]
        td[keys.NOMINAL_ACTION] = offset / world.dt
        td = f(td)
        assert not td[keys.OUTSIDE].any()
        td = env.step(td)["next"]
    assert (td[keys.POSITION][..., 2] - env.bounds[2, 0] < 0.06).double().mean() > 0.9


@pytest.mark.parametrize("reserve", ["linear", "logarithmic"])
def test_single_precision_does_not_erode_the_set(reserve):
    """Theorem 3: robots driven into each other and to the end of their reserve for a long time never leave C_0."""
    world = SurveillanceConfig(resolution=2, density="uniform", horizon=0, reserve=reserve, drain_rate=0.02)
    record = roll_out(world, {}, worlds=12, steps=600, seed=1, kinds=("away", "chase", "descent"), keep_rows=False)
    assert not record.data["outside"].any()
    assert record.data["h_g"].min() >= -world.homing.eps_distance
    assert record.data["h_g"].min() < 10 * world.homing.eps_distance
