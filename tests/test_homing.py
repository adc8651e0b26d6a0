"""Driving home: reserves, closest approach against a roll-out, the lemmas of the certified set, slot exchange."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.battery import charging_field
from envs.homing import (
    closest_approach,
    homing_velocity,
    is_certified,
    reserve,
)
from envs.reassignment import EXCHANGES, best_exchanges, exchange_slots, reassign_slots
from tests.worlds import segment_distance

FAMILIES = ("linear", "logarithmic")


def world(family="linear", **changes):
    """float64 world; the logarithmic reserve needs a longer-lived battery."""
    defaults = {"reserve": family, "dtype": "float64"} | ({"drain_rate": 0.015} if family == "logarithmic" else {})
    return SurveillanceConfig(**(defaults | changes))


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


def draw(rng, batch, n, d):
    """Random positions and slots, with robots at home and whole numbers of steps away among them."""
    position, slot = rng.uniform(-1, 1, (2, batch, n, d))
    position[: batch // 10, 0] = slot[: batch // 10, 0]
    slot[batch // 10 : batch // 5, 0] = position[batch // 10 : batch // 5, 0] + 3 * 0.0392 * np.eye(d)[0]
    return position, slot


def numpy_home(position, slot, g):
    """Independent backup step: straight at speed v, stop in the slot; or exponential."""
    offset = slot - position
    if g.family == "logarithmic":
        return position + g.gain * g.dt * offset
    way = np.sqrt((offset**2).sum(-1, keepdims=True))
    share = np.divide(np.minimum(g.speed * g.dt, way), way, out=np.zeros_like(way), where=way > 0)
    return position + share * offset


def rolled_out(position, slot, g):
    """Least distance of robots 0 and 1 per world: at every sub-sample, and exactly on each step's straight segment."""
    steps = 90 if g.family == "linear" else 2500
    sampled = exact = np.full(len(position), np.inf)
    for _ in range(steps):
        after = numpy_home(position, slot, g)
        start, end = (x[:, 0] - x[:, 1] for x in (position, after))
        for t in np.linspace(0, 1, 11):
            sampled = np.minimum(sampled, np.linalg.norm(start + t * (end - start), axis=-1))
        move = end - start
        square = (move**2).sum(-1)
        t = np.clip(-(start * move).sum(-1) / np.where(square > 0, square, 1), 0, 1)
        exact = np.minimum(exact, np.linalg.norm(start + t[:, None] * move, axis=-1))
        position = after
    return sampled, exact


# ---- reserve ------------------------------------------------------------------------------------------------------------
def test_linear_reserve_has_its_closed_form():
    g = world().homing
    distance = np.linspace(0, 3, 200)
    expected = [0.06 * max(0.0, x - g.reserve_radius) / 0.196 for x in distance]
    np.testing.assert_allclose(reserve(tensor(distance), g).numpy(), expected, atol=1e-15)
    assert g.reserve_radius == pytest.approx(g.charge_radius - 0.196 * 0.2, abs=1e-15)


def test_logarithmic_reserve_has_its_closed_form():
    g = world("logarithmic").homing
    rate = -math.log(1 - g.gain * 0.2) / 0.2
    distance = np.linspace(0, 3, 200)
    expected = [0.015 / rate * math.log(x / g.reserve_radius) if x > g.reserve_radius else 0.0 for x in distance]
    np.testing.assert_allclose(reserve(tensor(distance), g).numpy(), expected, atol=1e-14)
    assert g.gain <= 0.2 / math.hypot(2, 2)  # the speed k D is admissible all over the arena
    assert g.reserve_radius == pytest.approx(g.charge_radius * (1 - g.gain * 0.2), abs=1e-15)


@pytest.mark.parametrize("family", FAMILIES)
def test_reserve_is_zero_at_home_and_grows_outside(family):
    g = world(family).homing
    distance = torch.linspace(0, 3, 500, dtype=torch.float64)
    value = reserve(distance, g)
    outside = distance > g.reserve_radius
    assert (value[~outside] == 0).all()
    assert (value[outside].diff() > 0).all()
    assert reserve(tensor([g.reserve_radius]), g).item() == pytest.approx(0, abs=1e-15)
    wider = reserve(distance, g, radius=2 * g.reserve_radius)
    assert (wider[outside] < value[outside]).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_each_backup_step_pays_for_itself(family):
    """One backup step outside the reserve's radius lowers the reserve by exactly the drain of a step."""
    config = world(family)
    g = config.homing
    position = tensor([[[0.9, 0.8]]])
    slot = torch.zeros(1, 1, 2, dtype=torch.float64)
    steps = 0
    while True:
        after = position + g.dt * homing_velocity(position, slot, g)
        if float(after.norm()) <= g.reserve_radius:
            break
        before, now = (float(reserve(x.norm(dim=-1), g)) for x in (position, after))
        assert before - now == pytest.approx(config.drain_rate * g.dt, abs=1e-13)
        position, steps = after, steps + 1
    assert steps >= 20


# ---- backup motion --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("d", [2, 3])
def test_linear_homing_arrives_after_the_announced_steps(d):
    g = world().homing
    rng = np.random.default_rng(d)
    position, slot = (tensor(x) for x in rng.uniform(-1, 1, (2, 100, 3, d)))
    expected = torch.ceil((position - slot).norm(dim=-1) / (0.98 * 0.2 * 0.2)).long()
    arrived = torch.full_like(expected, -1)
    for k in range(int(expected.max()) + 3):
        at_home = (position - slot).norm(dim=-1) < 1e-12
        arrived = torch.where(at_home & (arrived < 0), k, arrived)
        velocity = homing_velocity(position, slot, g)
        assert velocity.norm(dim=-1).max() <= g.speed * (1 + 1e-12)
        position = position + g.dt * velocity
    assert torch.equal(arrived, expected)
    assert (position - slot).norm(dim=-1).max() < 1e-12  # and stays


@pytest.mark.parametrize("d", [2, 3])
def test_logarithmic_homing_decays_and_keeps_the_speed_limit(d):
    config = world("logarithmic", dimension=d)
    g = config.homing
    rng = np.random.default_rng(d)
    position, slot = (tensor(x) for x in rng.uniform(-1, 1, (2, 200, 3, d)))
    way = (position - slot).norm(dim=-1)
    for k in range(1, 60):
        velocity = homing_velocity(position, slot, g)
        assert velocity.norm(dim=-1).max() <= config.max_speed
        position = position + g.dt * velocity
        np.testing.assert_allclose((position - slot).norm(dim=-1), way * math.exp(-g.decay * k * g.dt), rtol=1e-10)
    corners = tensor([[[-1.0] * d, [1.0] * d]])
    assert homing_velocity(corners, corners.flip(1), g).norm(dim=-1).max() <= config.max_speed


@pytest.mark.parametrize("family", FAMILIES)
def test_a_docked_robot_stands_still(family):
    place = torch.rand(4, 2, 2, generator=torch.Generator().manual_seed(0))
    assert torch.equal(homing_velocity(place, place, world(family).homing), torch.zeros(4, 2, 2))


# ---- closest approach -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("family", FAMILIES)
def test_closest_approach_equals_a_roll_out(family, d):
    g = world(family, dimension=d).homing
    position, slot = draw(np.random.default_rng(7 + d), 400, 2, d)
    got = closest_approach(tensor(position), tensor(slot), g)[:, 0].numpy()
    sampled, exact = rolled_out(position, slot, g)
    assert (got <= sampled + 1e-9).all()  # between the samples too
    np.testing.assert_allclose(got, exact, atol=1e-9)
    moved = got < np.linalg.norm(position[:, 0] - position[:, 1], axis=-1) - 1e-3
    assert 0.2 < moved.mean() < 1  # the minimum lies on the way for a good share


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.2, 0.3]), st.sampled_from([0.5, 0.98]))
def test_closest_approach_equals_a_roll_out_for_any_step_length(seed, dt, speed):
    g = world(dt=dt, max_speed=0.12, homing_speed=speed, n_agents=1).homing
    position, slot = np.random.default_rng(seed).uniform(-0.5, 0.5, (2, 3, 2, 2))
    got = closest_approach(tensor(position), tensor(slot), g)[:, 0].numpy()
    least = np.full(3, np.inf)
    for _ in range(math.ceil(1.5 / (g.speed * dt))):
        after = numpy_home(position, slot, g)
        start, end = (tensor(x[:, 0] - x[:, 1]) for x in (position, after))
        least = np.minimum(least, segment_distance(start, end).numpy())
        position = after
    np.testing.assert_allclose(got, least, atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_segment_distance_is_the_least_of_many_points(d):
    rng = np.random.default_rng(d)
    start, end = rng.uniform(-1, 1, (2, 200, d))
    end[:5] = start[:5]  # degenerate segments
    points = start + np.linspace(0, 1, 20001)[:, None, None] * (end - start)
    least = np.linalg.norm(points, axis=-1).min(0)
    got = segment_distance(tensor(start), tensor(end)).numpy()
    assert (got <= least + 1e-12).all()
    np.testing.assert_allclose(got, least, atol=1e-4)


@pytest.mark.parametrize("family", FAMILIES)
def test_closest_approach_never_exceeds_the_distances_now_and_at_home(family):
    g = world(family).homing
    position, slot = (tensor(x) for x in draw(np.random.default_rng(1), 2000, 3, 2))
    got = closest_approach(position, slot, g)
    assert (got <= torch.stack([torch.pdist(p) for p in position]) + 1e-15).all()
    assert (got <= torch.stack([torch.pdist(s) for s in slot]) + 1e-15).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_closest_approach_of_hand_made_pairs(family):
    g = world(family).homing
    head_on = closest_approach(tensor([[[-0.5, 0.0], [0.5, 0.0]]]), tensor([[[0.5, 0.0], [-0.5, 0.0]]]), g)
    assert head_on.item() == pytest.approx(0, abs=1e-12)
    docked = tensor([[[-0.5, 0.0], [0.5, 0.25]]])
    assert closest_approach(docked, docked, g).item() == pytest.approx(math.hypot(1, 0.25), abs=1e-12)
    side_by_side = closest_approach(tensor([[[0.0, 0.0], [0.0, 0.3]]]), tensor([[[1.0, 0.0], [1.0, 0.3]]]), g)
    assert side_by_side.item() == pytest.approx(0.3, abs=1e-12)
    # a pedestrian at home beside the other's straight way
    passing = closest_approach(tensor([[[-0.6, 0.0], [0.1, 0.2]]]), tensor([[[0.7, 0.0], [0.1, 0.2]]]), g)
    assert passing.item() == pytest.approx(0.2, abs=1e-12)


def test_closest_approach_lists_pairs_in_order():
    g = world().homing
    places = tensor([[[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [7.0, 0.0]]])
    assert closest_approach(places, places, g).tolist() == [[1.0, 3.0, 7.0, 2.0, 6.0, 4.0]]


@pytest.mark.parametrize("family", FAMILIES)
def test_single_precision_stays_within_the_distance_margin(family):
    config = world(family, dtype="float32")
    position, slot = (tensor(x) for x in draw(np.random.default_rng(5), 2000, 3, 2))
    single = closest_approach(position.float(), slot.float(), config.homing)
    double = closest_approach(position.float().double(), slot.float().double(), config.homing)
    assert (single.double() - double).abs().max() < config.homing.eps_distance


# ---- lemmas -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("family", FAMILIES)
def test_lemma_3_joint_homing_never_lowers_the_closest_approach(family, d):
    g = world(family, dimension=d).homing
    position, slot = (tensor(x) for x in draw(np.random.default_rng(11), 500, 4, d))
    now, raised = closest_approach(position, slot, g), 0
    for _ in range(90):
        position = position + g.dt * homing_velocity(position, slot, g)
        then = closest_approach(position, slot, g)
        assert (then - now).min() >= -4e-15
        raised += int((then > now + 1e-6).sum())
        now = then
    assert raised > 1000


def bounded_current(env, position, energy, drain, gain=0.5):
    """SAFETY.md inequality (3): no more current than keeps E under E_max - eps."""
    c, g = env.config, env.geometry
    field = charging_field(position, env.stations, full_radius=c.charge_radius_full, zero_radius=c.charge_radius)
    room = (c.energy_max - g.eps_energy - energy).clamp_min(0)
    return torch.where(field > 0, (drain + gain * room / c.dt) / (c.charge_rate * field.clamp_min(1e-9)), 1).clamp(0, 1)


LAYOUTS = {
    "default": {},
    "ring": {"n_agents": 4, "stations": [[0.1, 0.2], [-0.5, -0.4]], "slots": 2},
    "aerial": {"dimension": 3, "arena": [[-1.0, 1.0], [-1.0, 1.0], [0.0, 1.0]]},
    "speedy_drain": {"drain_per_speed": 0.02, "drain_per_speed_squared": 0.1},
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("family", FAMILIES)
def test_lemma_4_a_backup_step_never_lowers_the_energy_margin(family, layout):
    config = world(family, **LAYOUTS[layout])
    env, g = SurveillanceEnv(config, num_envs=1), config.homing
    rng = np.random.default_rng(2)
    slot = env.slots[torch.tensor(rng.integers(0, len(env.slots), (4000, config.n_agents)))]
    low, high = env.bounds.T.numpy()
    anywhere = tensor(rng.uniform(low, high, (4000, *slot.shape[1:])))
    near = slot + tensor(rng.uniform(-0.25, 0.25, slot.shape))
    position = torch.where(tensor(rng.uniform(size=(4000, 1, 1))) < 0.5, anywhere, near)
    way = (position - slot).norm(dim=-1)
    energy = config.energy_min + reserve(way, g) + tensor(rng.uniform(0, 0.4, way.shape)) ** 2
    top = config.energy_max - g.eps_energy
    if layout == "speedy_drain":  # close to full the bound throttles the current below the drain at full speed
        top -= 2 * config.dt * (config.max_drain_rate - config.drain_rate)
    keep = energy <= top
    assert keep.double().mean() > 0.3
    assert (keep & (way < g.charge_radius)).sum() > 100
    velocity = homing_velocity(position, slot, g)
    for current in (bounded_current(env, position, energy, config.drain_rate), torch.ones_like(energy)):
        next_position, next_energy = env.transition(position, energy, velocity, current)
        before = energy - reserve(way, g)
        after = next_energy - reserve((next_position - slot).norm(dim=-1), g)
        assert (after - before)[keep].min() >= -1e-15
        assert (next_energy[keep] >= config.energy_min - 1e-15).all()
    bounded = env.transition(position, energy, velocity, bounded_current(env, position, energy, config.drain_rate))[1]
    assert (bounded[keep] <= config.energy_max - g.eps_energy + 1e-15).all()


# the paper-like layouts of the invariance runs: (fields, worlds)
RUNS = {
    "one": {"n_agents": 1},
    "three": {},
    "three_float64": {"dtype": "float64"},
    "eight": {"n_agents": 8},
    "ring": {"n_agents": 4, "stations": [[0.0, 0.0]], "slots": 4, "slot_radius": 0.13, "charge_radius": 0.36},
    "spare_slots": {"n_agents": 3, "stations": [[-0.6, 0.0], [0.6, 0.0]], "slots": 2},
    "aerial": {"n_agents": 5, "dimension": 3, "arena": [[-1.0, 1.0], [-1.0, 1.0], [0.0, 1.0]]},
    "logarithmic": {"reserve": "logarithmic", "drain_rate": 0.015},
    "fixed_slots": {"n_agents": 5, "reassign_slots": False},
    "speedy_drain": {"drain_per_speed": 0.02, "drain_per_speed_squared": 0.1},
}


@pytest.mark.parametrize("name", RUNS)
def test_joint_homing_from_every_start_is_safe_for_ever(name):
    config = SurveillanceConfig(**({"horizon": 0, "on_violation": "continue", "density": "uniform"} | RUNS[name]))
    env = SurveillanceEnv(config, num_envs=24, seed=5)
    td = env.reset()
    g = config.homing
    away = (td[keys.POSITION] - env.slots[td[keys.SLOT].squeeze(-1)]).norm(dim=-1)
    assert (away > g.charge_radius).any()
    least_gap = math.inf
    for _ in range(300):
        position, energy = td[keys.POSITION], td[keys.ENERGY].squeeze(-1)
        td[keys.ACTION] = homing_velocity(position, env.slots[td[keys.SLOT].squeeze(-1)], g)
        td[keys.CHARGE_CURRENT] = bounded_current(env, position, energy, config.drain_rate).unsqueeze(-1)
        td = env.step(td)["next"]
        for kind in keys.VIOLATION_KINDS:
            assert not td[(*keys.VIOLATION, kind)].any(), kind
        assert config.energy_min <= td[keys.ENERGY].min()
        assert td[keys.ENERGY].max() <= config.energy_max
        if config.n_agents > 1:
            least_gap = min(least_gap, min(float(torch.pdist(p).min()) for p in td[keys.POSITION]))
    assert least_gap >= g.clearance - g.eps_distance
    way = (td[keys.POSITION] - env.slots[td[keys.SLOT].squeeze(-1)]).norm(dim=-1)
    assert way.max() < (1e-5 if g.family == "linear" else 0.1)


# ---- certificate ------------------------------------------------------------------------------------------------------
def certify(position, energy, slot, config=None, **changes):
    config = config or world(n_agents=2, stations=[[-0.5, 0.0], [0.5, 0.0]])
    bounds = tensor(config.bounds)
    got = is_certified(tensor([position]), tensor([energy]), tensor([slot]), config.homing, bounds, **changes)
    return bool(got)


HOME = [[-0.5, 0.0], [0.5, 0.0]]


def test_docked_robots_are_certified_down_to_the_entry_margin():
    g = world().homing
    least = 0.1 + 2 * g.eps_energy
    assert certify(HOME, [1.0, 0.5], HOME)
    assert certify(HOME, [least + 1e-12, 0.5], HOME)
    assert not certify(HOME, [least - 1e-9, 0.5], HOME)
    assert not certify(HOME, [0.5, 1.0 + 1e-9], HOME)
    assert not certify(HOME, [0.5, float("nan")], HOME)
    assert not certify([[float("nan"), 0.0], HOME[1]], [0.5, 0.5], HOME)


def test_energy_must_cover_the_way_home():
    g = world().homing
    away = [[-0.5, 0.7], [0.5, 0.0]]
    least = 0.1 + 2 * g.eps_energy + 0.06 * (0.7 - g.reserve_radius) / 0.196
    assert certify(away, [least + 1e-9, 0.5], HOME)
    assert not certify(away, [least - 1e-9, 0.5], HOME)


@pytest.mark.parametrize("place", [[-0.5, 1.001], [-0.5, -1.001], [-1.001, 0.0], [1.001, 0.7]])
def test_robots_outside_the_arena_are_not_certified(place):
    inside = [max(-1.0, min(1.0, x)) for x in place]
    assert certify([inside, HOME[1]], [0.99, 0.99], HOME)
    assert not certify([place, HOME[1]], [0.99, 0.99], HOME)


def test_crossing_ways_are_not_certified_but_swapped_slots_are():
    crossing = [[0.3, 0.0], [-0.3, 0.0]]
    assert not certify(crossing, [0.9, 0.9], HOME)
    assert certify(crossing, [0.9, 0.9], HOME[::-1])


def test_clearance_decides_at_its_limit():
    config = world(n_agents=2, stations=[[-0.5, 0.0], [0.5, 0.0]])
    gap = config.homing.clearance + config.homing.eps_distance
    assert config.homing.clearance == pytest.approx(math.hypot(0.12 + config.homing.eps_distance, 0.08), abs=1e-12)
    for extra in (0.0, 0.05):
        for shift, expected in ((1e-9, True), (-1e-9, False)):
            robots = [[0.5 - gap - extra - shift, 0.0], HOME[1]]  # on the way to its own slot, away from the other
            assert certify(robots, [0.9, 0.9], HOME, clearance=extra) is expected


# ---- exchange of slots ------------------------------------------------------------------------------------------------
def total_way(position, slot, slots):
    return (position - slots[slot]).square().sum((-1, -2))


def random_assignment(rng, batch, n, n_slots):
    return torch.tensor(np.stack([rng.permutation(n_slots)[:n] for _ in range(batch)]))


def best_single_exchange(position, energy, slot, slots, g):
    """Least total squared way home after at most one affordable exchange or move, by loops."""

    def way(i, s):
        return math.dist(position[i], slots[s])

    def affordable(i, s):
        rho = g.drain_rate / g.speed * max(0.0, way(i, s) - g.reserve_radius)
        return energy[i] - g.energy_min - 2 * g.eps_energy >= rho

    best = current = sum(way(i, s) ** 2 for i, s in enumerate(slot))
    for i, own in enumerate(slot):
        for s in range(len(slots)):
            if s == own or not affordable(i, s):
                continue
            after = list(slot)
            after[i] = s
            if s in slot:
                j = slot.index(s)
                if not affordable(j, own):
                    continue
                after[j] = own
            best = min(best, sum(way(k, t) ** 2 for k, t in enumerate(after)))
    return best if best < current - 1e-5 * g.charge_radius**2 else current


@pytest.mark.parametrize(("n", "n_slots"), [(1, 3), (4, 4), (4, 6), (8, 8)])
def test_exchange_is_the_best_affordable_one(n, n_slots):
    g = world().homing
    rng = np.random.default_rng(n_slots)
    slots = tensor(rng.uniform(-1, 1, (n_slots, 2)))
    position, energy = tensor(rng.uniform(-1, 1, (60, n, 2))), tensor(rng.uniform(0.1, 1.0, (60, n)))
    slot = random_assignment(rng, 60, n, n_slots)
    got = exchange_slots(position, energy, slot, slots, g)
    changed = 0
    for b in range(60):
        assert len(set(got[b].tolist())) == n
        assert int((got[b] != slot[b]).sum()) <= 2
        best = best_single_exchange(position[b].tolist(), energy[b].tolist(), slot[b].tolist(), slots.tolist(), g)
        assert float(total_way(position[b], got[b], slots)) == pytest.approx(best, abs=1e-12)
        changed += int((got[b] != slot[b]).any())
    assert changed > 20


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 6), st.integers(0, 3), st.integers(0, 10**6))
def test_repeated_exchange_ends_injective_and_never_longer(n, spare, seed):
    g = world(n_agents=1).homing
    rng = np.random.default_rng(seed)
    slots, position = tensor(rng.uniform(-1, 1, (n + spare, 2))), tensor(rng.uniform(-1, 1, (3, n, 2)))
    slot = random_assignment(rng, 3, n, n + spare)
    energy = torch.ones(3, n, dtype=torch.float64)
    for _ in range(n * (n + spare) + 5):
        new = exchange_slots(position, energy, slot, slots, g)
        assert (total_way(position, new, slots) <= total_way(position, slot, slots)).all()
        assert new.sort(-1).values.diff(dim=-1).gt(0).all()
        assert (new < n + spare).all()
        if torch.equal(new, slot):
            break
        slot = new
    assert torch.equal(exchange_slots(position, energy, slot, slots, g), slot)


def test_an_obviously_crossed_pair_swaps_and_a_straight_one_does_not():
    g, slots = world().homing, tensor(HOME)
    near, full = tensor([[[-0.4, 0.1], [0.4, 0.1]]]), tensor([[0.9, 0.9]])
    assert exchange_slots(near, full, torch.tensor([[1, 0]]), slots, g).tolist() == [[0, 1]]
    assert exchange_slots(near, full, torch.tensor([[0, 1]]), slots, g).tolist() == [[0, 1]]


def test_a_nearer_free_slot_is_taken_and_an_unaffordable_one_is_not():
    g, slots = world().homing, tensor([*HOME, [0.0, 0.9]])
    robots, slot = tensor([[[0.0, 0.7], [0.5, 0.0]]]), torch.tensor([[0, 1]])
    assert exchange_slots(robots, tensor([[0.9, 0.9]]), slot, slots, g).tolist() == [[2, 1]]
    assert exchange_slots(robots, tensor([[0.05, 0.9]]), slot, slots, g).tolist() == [[0, 1]]


def test_equal_ways_do_not_trade():
    g, slots = world().homing, tensor(HOME)
    middle = tensor([[[0.0, 0.3], [0.0, -0.3]]])
    for slot in ([[0, 1]], [[1, 0]]):
        slot = torch.tensor(slot)
        assert torch.equal(exchange_slots(middle, tensor([[0.9, 0.9]]), slot, slots, g), slot)


@pytest.mark.parametrize("n_slots", [4, 6])
def test_reassignment_is_adopted_exactly_where_certified(n_slots):
    config = world(n_agents=4)
    g, bounds = config.homing, tensor(config.bounds)
    rng = np.random.default_rng(3)
    angle = 2 * math.pi * np.arange(n_slots) / n_slots
    slots = tensor(0.85 * np.stack([np.cos(angle), np.sin(angle)], -1))
    position, energy = tensor(rng.uniform(-1, 1, (400, 4, 2))), tensor(rng.uniform(0.4, 1.0, (400, 4)))
    slot = random_assignment(rng, 400, 4, n_slots)
    got = reassign_slots(position, energy, slot, slots, g, bounds)
    wishes = best_exchanges(position, energy, slot, slots, g, 4 * n_slots).unbind(1)  # all there are, best first
    expected, open_ = slot.clone(), torch.ones(400, dtype=torch.bool)
    for wish in wishes[:EXCHANGES]:
        adopt = open_ & (wish != slot).any(-1) & is_certified(position, energy, slots[wish], g, bounds)
        expected, open_ = torch.where(adopt.unsqueeze(-1), wish, expected), open_ & ~adopt
    changed = (got != slot).any(-1)
    assert torch.equal(got, expected)
    assert changed.sum() > 10
    assert (~changed & (wishes[0] != slot).any(-1)).sum() > 10
    assert is_certified(position[changed], energy[changed], slots[got[changed]], g, bounds).all()
    assert got.sort(-1).values.diff(dim=-1).gt(0).all()


@pytest.mark.parametrize("n_slots", [4, 6])
def test_best_exchanges_are_different_ones(n_slots):
    g, rng = world(n_agents=4).homing, np.random.default_rng(5)
    slots, slot = tensor(rng.uniform(-1, 1, (n_slots, 2))), random_assignment(rng, 200, 4, n_slots)
    position, energy = tensor(rng.uniform(-1, 1, (200, 4, 2))), torch.full((200, 4), 1.0, dtype=torch.float64)
    several = best_exchanges(position, energy, slot, slots, g, EXCHANGES)
    way = (position.unsqueeze(1) - slots[several]).square().sum((-1, -2))
    assert (way.diff(dim=-1) >= -1e-12).all()  # best first
    for i in range(EXCHANGES):
        for j in range(i):
            same = (several[:, i] == several[:, j]).all(-1)
            assert (several[:, i][same] == slot[same]).all()  # only "no change" comes more than once


def test_geometry_is_frozen_and_derived():
    g = world().homing
    assert g.speed == pytest.approx(0.196)
    assert g.charge_radius == pytest.approx(world().break_even_radius)  # one slot per station: no offset
    ring = world(slots=3, n_agents=3).homing
    assert ring.charge_radius == pytest.approx(world().break_even_radius - 0.085)
    with pytest.raises(dataclasses.FrozenInstanceError):
        g.speed = 1.0
