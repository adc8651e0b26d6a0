"""The certified filter in random worlds against adversaries: what must never happen, and that it does without the filter.

Every roll-out starts at the edge of the certified set. What is asserted on energies and distances has tolerance zero.
"""

import functools
import math

import pytest
import torch

import safety.programs
from envs import SurveillanceConfig, SurveillanceEnv, keys
from envs.dynamics import limit_speed
from envs.homing import certified_parts, closest_approach, homing_velocity, is_certified, reserve
from envs.transition import transition
from safety import QPSolution, QPStatus, SafetyConfig, SafetyFilter
from tests.worlds import (
    COUNT,
    F64,
    FAMILIES,
    N_AGENTS,
    Adversary,
    draw_worlds,
    edge_states,
    field_at,
    name,
    parts,
    raw_margins,
    roll_out,
)

pytestmark = pytest.mark.xdist_group("certified")  # its fixtures are made once, not by every worker

torch.set_num_threads(1)
WORLDS, DRAWN = draw_worlds(COUNT)
EVERY_WORLD = pytest.mark.parametrize("index", range(COUNT), ids=lambda k: name(WORLDS[k][0]))
SMALL = [k for k, (world, _) in enumerate(WORLDS) if 2 <= world.n_agents <= 5]
LITERAL = {"mode": "paper", "composition": "min", "split": "full", "sampled_data": False}
HALF = {"mode": "paper", "split": "half", "sampled_data": False}


@functools.cache
def recorded(index):
    size = {"worlds": 3, "steps": 18} if WORLDS[index][0].n_agents == 16 else {"worlds": 16, "steps": 24}
    return roll_out(*WORLDS[index], seed=index, **size)


def left_set(record):
    """World-steps that end outside the certified set, under the slots that the filter saw."""
    d = record.data
    return int((~parts(record.env, d["next_position"], d["next_energy"], d["slot"], 0)).sum())


def violations(record):
    """Raw violations: world-steps with a robot below E_min, above E_max, too far from home, two robots too close."""
    return [int((margin < 0).sum()) for margin in raw_margins(record)]


def outputs(world, gains, nominal, position, energy, slot, **fields):
    f = SafetyFilter(SafetyConfig(**{**gains, **fields}), world)
    return dict(zip((key[-1] for key in f.out_keys), f.filter(nominal, position, energy, slot), strict=True))


def start(index, batch=16, seed=5):
    """Nominal actions of the adversary at edge states: what the filter reads."""
    world, gains = WORLDS[index]
    env = SurveillanceEnv(world, batch, seed=seed)
    position, energy, slot = edge_states(env, seed)
    return env, gains, (Adversary(world, seed)(position, env.slots[slot]), position, energy, slot)


# ---- the sample -------------------------------------------------------------------------------------------------------
def test_enough_different_worlds_are_drawn():
    assert COUNT < DRAWN < 3 * COUNT  # some draws are refused, not most
    worlds = [world for world, _ in WORLDS]
    assert {w.n_agents for w in worlds} == set(N_AGENTS)
    assert {(w.reserve, w.dimension) for w in worlds} == {(family, d) for family in FAMILIES for d in (2, 3)}
    assert {w.dtype for w in worlds} == {"float32", "float64"}
    assert {w.dt for w in worlds} == {0.05, 0.1, 0.2, 0.5}
    assert sum(w.slots != 1 for w in worlds) >= 3
    assert sum(w.drain_per_speed > 0 for w in worlds) >= 6


def test_adversaries_press_against_every_limit():
    records = [recorded(index) for index in range(COUNT)]
    levels = sum(torch.bincount(r.data["level"].flatten(), minlength=3) for r in records)
    assert (levels > 30).all()
    assert sum(int((r.data["correction"] > 1e-6 * r.world.max_speed).sum()) for r in records) > 0.3 * levels.sum()
    assert sum(int((r.data["slot"] != r.data["next_slot"]).sum()) for r in records) > 500
    closest = [float(r.data["h_g"].min()) / r.world.safety_distance for r in records if r.world.n_agents > 1]
    assert sum(gap < 0.05 for gap in closest) > 10
    margins = [[float(m.min()) for m in raw_margins(r)] for r in records]
    units = [[r.world.energy_max - r.world.energy_min] * 3 + [50 * r.world.safety_distance] for r in records]
    for kind in range(4):
        assert sum(m[kind] < 0.01 * unit[kind] for m, unit in zip(margins, units, strict=True)) > 5


# ---- what must never happen -------------------------------------------------------------------------------------------
@EVERY_WORLD
def test_no_violation_of_any_kind(index):
    record = recorded(index)
    for margin in raw_margins(record):  # NaN fails, too
        assert margin.min() >= 0
    for kind in keys.VIOLATION_KINDS:
        assert not record.data[kind].any(), kind


@EVERY_WORLD
def test_every_state_stays_certified(index):
    record = recorded(index)
    env, d = record.env, record.data
    assert not d["outside"].any()
    assert left_set(record) == 0
    assert parts(env, d["next_position"], d["next_energy"], d["next_slot"], 0).all()
    # one margin is kept, unless all that failed were driving home already and lost it by a rounding
    states = (d["next_position"], d["next_energy"], env.slots[d["slot"]])
    robots, pairs = certified_parts(*states, env.geometry, env.bounds, margins=1)
    assert (robots | (d["level"] == 2)).all()
    i, j = torch.triu_indices(record.world.n_agents, record.world.n_agents, 1)
    assert (pairs | ((d["level"][..., i] == 2) & (d["level"][..., j] == 2))).all()


@EVERY_WORLD
def test_environment_realises_what_was_checked_bit_for_bit(index):
    record = recorded(index)
    d, env = record.data, record.env
    action = d["action"]
    assert torch.equal(limit_speed(action, record.world.max_speed), action)
    after = transition(d["position"], d["energy"], action, d["charge_current"], env.stations, record.world)
    assert all(torch.equal(x, d[key]) for x, key in zip(after, ("next_position", "next_energy"), strict=True))


@EVERY_WORLD
def test_level_and_status_say_who_decided(index):
    record = recorded(index)
    d, world = record.data, record.world
    level, status, action = d["level"], d["status"], d["action"]
    home = homing_velocity(d["position"], record.env.slots[d["slot"]], record.env.geometry)
    assert ((level >= 0) & (level <= 2)).all()
    assert (action[level == 1] == 0).all()
    assert torch.equal(action[level == 2], home[level == 2])
    assert (status[level == 0] == QPStatus.SOLVED).all()
    broken = ~d["nominal_action"].isfinite().all(-1)
    assert broken.any()
    assert (status[broken] == QPStatus.INACCURATE).all()
    assert (status[~broken] == QPStatus.SOLVED).all()  # the programs are feasible: Theorem 1
    assert ((d["charge_current"] >= 0) & (d["charge_current"] <= 1)).all()
    assert all(d[key].isfinite().all() for key in ("action", "charge_current", "correction", "residual", "h_c", "h_o"))
    moved = (action - limit_speed(d["nominal_action"], world.max_speed)).norm(dim=-1)
    moved[broken] = world.max_speed
    torch.testing.assert_close(d["correction"], moved, rtol=1e-4, atol=1e-6 * world.max_speed)
    geometry = record.env.geometry
    way = (d["position"] - record.env.slots[d["slot"]]).norm(dim=-1)
    spare, fine = d["energy"] - world.energy_min - reserve(way, geometry), 0.2 * geometry.eps_energy
    torch.testing.assert_close(d["h_c"], spare, rtol=1e-5, atol=fine)
    torch.testing.assert_close(d["h_o"], world.energy_max - d["energy"], rtol=0, atol=fine)
    if world.n_agents > 1:
        gap = closest_approach(d["position"], record.env.slots[d["slot"]], geometry)
        least = gap.amin(-1) - geometry.clearance
        torch.testing.assert_close(d["h_g"].amin(-1), least, rtol=0, atol=1e-6 * world.diameter)


@EVERY_WORLD
def test_slots_stay_one_to_one_and_change_into_certified_states_only(index):
    record = recorded(index)
    d, env = record.data, record.env
    for slots in (d["slot"], d["next_slot"]):
        assert (slots.sort(-1).values.diff(dim=-1) > 0).all()
        assert ((slots >= 0) & (slots < len(env.slots))).all()
    changed = d["slot"] != d["next_slot"]
    assert (changed.sum(-1) <= 2).all()
    worlds = changed.any(-1)
    state = (d["next_position"], d["next_energy"], env.slots[d["next_slot"]], env.geometry, env.bounds)
    assert is_certified(*state)[worlds].all()


@EVERY_WORLD
def test_admissible_nominal_action_passes_bit_for_bit(index):
    """Where all rows are slack the filter is the identity, but where the shield objects (rare)."""
    record = recorded(index)
    d, world = record.data, record.world
    nominal = d["nominal_action"]
    steps = []
    for rows, action in zip(record.rows, nominal, strict=True):  # as many rows as the step's busiest robot needs
        slack = rows.h - (rows.G * action.unsqueeze(-2)).sum(-1)
        steps.append((slack > 1e-5 * world.max_speed * rows.G.norm(dim=-1)).all(-1))
    within = nominal.norm(dim=-1) <= world.max_speed * (1 - 1e-6)  # the programs' ball is a hair smaller than the limit
    admissible = torch.stack(steps) & within
    assert admissible.double().mean() > 0.02
    passed = admissible & (d["level"] == 0)
    assert passed.sum() >= 0.9 * admissible.sum()
    assert torch.equal(d["action"][passed], nominal[passed])
    assert (d["correction"][passed] == 0).all()


@EVERY_WORLD
def test_every_robot_that_violates_a_row_gets_a_program(index):
    record = recorded(index)
    nominal = record.data["nominal_action"]
    finite = nominal.isfinite().all(-1, keepdim=True)
    cut = limit_speed(torch.where(finite, nominal, 0.0), record.world.max_speed)
    some = total = 0
    for rows, pressed, action in zip(record.rows, record.pressed, cut, strict=True):
        violates = ((rows.G * action.unsqueeze(-2)).sum(-1) > rows.h).any(-1).flatten()
        given = torch.zeros_like(violates).index_fill(0, pressed, True)
        assert not (violates & ~given).any()
        some, total = some + len(pressed), total + len(given)
    assert 0 < some < total  # and not simply everybody


@EVERY_WORLD
def test_programs_keep_their_barriers(index):
    """h(k+1) >= (1 - g) h(k) where the program decided, for h_s where the anchor leaves the pair slack."""
    record = recorded(index)
    d, world, g = record.data, record.world, record.env.geometry
    fine = 1e-9 if world.dtype == "float64" else 2e-6
    gains, way = record.filter.gains, (d["position"] - record.env.slots[d["slot"]]).norm(dim=-1)
    floor = world.energy_min + 2 * g.eps_energy
    value = d["energy"] - floor - reserve(way, g)
    kept = (1 - gains.energy * world.dt) * value
    field = field_at(world, d["position"], record.env.stations)
    worst = d["energy"] + world.dt * (world.charge_rate * field * d["charge_current"] - world.max_drain_rate)
    next_way = (d["next_position"] - record.env.slots[d["slot"]]).norm(dim=-1)
    after = d["next_energy"] - floor - reserve(next_way, g)
    # a battery so full that its charging was throttled has nothing to pay back with
    asked = (d["level"] == 0) & (value >= 0) & (worst - floor >= kept)
    assert asked.any()
    assert (after - kept)[asked].min() >= -fine * (world.energy_max + reserve(way, g).max())
    if world.n_agents == 1:
        return
    i, j = torch.triu_indices(world.n_agents, world.n_agents, 1)
    anchor = torch.stack([rows.anchor for rows in record.rows])
    gap, next_gap, drive = (x[..., i, :] - x[..., j, :] for x in (d["position"], d["next_position"], anchor))
    h_s, next_h_s = (x.square().sum(-1) - world.safety_distance**2 for x in (gap, next_gap))
    left = gains.collision * h_s + 2 * (gap * drive).sum(-1) >= 0
    both = (d["level"][..., i] == 0) & (d["level"][..., j] == 0) & left
    tolerance = fine * gap.norm(dim=-1) * (gap.norm(dim=-1) + world.max_speed * world.dt)
    assert (next_h_s - (1 - gains.collision * world.dt) * h_s + tolerance)[both].min() >= 0


# ---- special nominal actions and states -------------------------------------------------------------------------------
@pytest.mark.parametrize("index", SMALL[:6])
def test_driving_home_is_accepted(index):
    env, gains, (_, position, energy, slot) = start(index)
    home = homing_velocity(position, env.slots[slot], env.geometry)
    out = outputs(env.config, gains, home, position, energy, slot)
    assert ((out["action"] - home).norm(dim=-1) <= 1e-4 * env.config.max_speed).double().mean() > 0.5
    after = transition(position, energy, out["action"], out["charge_current"].squeeze(-1), env.stations, env.config)
    assert parts(env, *after, slot, 1).all()


@pytest.mark.parametrize("solver", ["auto", "qpth"])
def test_calm_robots_in_the_middle_of_the_set_are_left_alone(solver):
    world = SurveillanceConfig(dtype="float64")
    position = 0.7 * torch.tensor(world.slot_positions, dtype=F64).expand(4, -1, -1)
    nominal = 0.05 * torch.randn(position.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    inputs = (nominal, position, torch.full((4, 3), 0.9, dtype=F64), torch.arange(3).expand(4, 3))
    out = outputs(world, {}, *inputs, solver=solver)
    assert torch.equal(out["action"], nominal)
    assert not (out["level"] + out["correction"].squeeze(-1)).any()


@pytest.mark.parametrize("case", ["empty", "overfull", "close", "beyond", "crossing"])
@pytest.mark.parametrize("family", FAMILIES)
def test_state_outside_the_set_is_flagged_and_drives_home(family, case):
    stations = [[0.8, 0.0], [-0.8, 0.0], [0.0, 0.8]]
    world = SurveillanceConfig(n_agents=3, reserve=family, drain_rate=0.015, stations=stations)
    env = SurveillanceEnv(world, 1)
    position, energy = 0.7 * env.slots[None], torch.full((1, 3, 1), 0.8)
    energy[0, 0] = {"empty": 0.09, "overfull": 1.01}.get(case, 0.8)
    bad = [True, case in ("close", "crossing"), False]
    if case == "beyond":
        position[0, 0, 0] = 1 + 2 * env.geometry.eps_distance  # one step inwards and the set is reached again
    elif case == "close":
        position[0, 1] = position[0, 0] - 0.05
    elif case == "crossing":
        position[0, :2] = position[0, [1, 0]] * 0.5
    td = env.set_state(position, energy, torch.arange(3).view(1, 3, 1))
    f = SafetyFilter(SafetyConfig(), world)
    for nominal in (0.1, -0.1, math.nan):
        out = f(td.clone().set(keys.NOMINAL_ACTION, torch.full_like(position, nominal)))
        assert out[keys.OUTSIDE][0].tolist() == bad
        assert (out[keys.LEVEL][out[keys.OUTSIDE]] == 2).all()
        assert out[keys.ACTION].isfinite().all()
        home = homing_velocity(position, env.slots, env.geometry)
        assert torch.equal(out[keys.ACTION][out[keys.OUTSIDE]], home[out[keys.OUTSIDE]])


# ---- a function of its inputs -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("index", SMALL[:8])
def test_filter_is_a_pure_function_of_each_world_in_any_order(index):
    env, gains, inputs = start(index)
    before = [x.clone() for x in inputs]
    whole, again = (outputs(env.config, gains, *inputs) for _ in range(2))
    assert all(torch.equal(value, again[key]) for key, value in whole.items())
    assert all(torch.equal(a, b) for a, b in zip(inputs[1:], before[1:], strict=True))
    fine = 1e-7 if env.config.dtype == "float64" else 1e-5
    order = torch.randperm(env.config.n_agents, generator=torch.Generator().manual_seed(index))
    for world in range(len(inputs[0])):
        alone = outputs(env.config, gains, *(x[world] for x in inputs))
        shuffled = outputs(env.config, gains, *(x[world, order] for x in inputs))
        for key, value in whole.items():
            close = {"rtol": fine, "atol": fine * env.config.max_speed}
            torch.testing.assert_close(alone[key], value[world], **close)
            torch.testing.assert_close(shuffled[key], value[world, order], **close)


# ---- the shield is what it rests on -----------------------------------------------------------------------------------
def test_realised_state_is_one_that_the_shield_has_stepped(monkeypatch):
    stepped = []

    def spy(*args, **kwargs):
        stepped.append(transition(*args, **kwargs))
        return stepped[-1]

    monkeypatch.setattr(safety.filter, "transition", spy)
    for index in SMALL[:6]:
        stepped.clear()
        d = roll_out(*WORLDS[index], seed=index, worlds=12, steps=1).data
        for k, real in enumerate((d["next_position"][0], d["next_energy"][0])):
            seen = torch.cat([step[k].flatten(1) for step in stepped])
            assert (seen == real.flatten(1).unsqueeze(1)).all(-1).any(1).all()


def without_shield(step, position, energy, slot_position, action, current, level, *args, **kwargs):
    return torch.where((level > 0).unsqueeze(-1), 0.0, action), level, torch.ones_like(level[:, 0])


def test_without_the_shield_the_set_is_left_and_robots_run_empty(monkeypatch):
    monkeypatch.setattr(safety.filter, "shield", without_shield)
    records = [roll_out(*WORLDS[index], seed=index) for index in SMALL[::3]]
    assert sum(left_set(record) > 0 for record in records) >= 0.5 * len(records)
    assert sum(violations(record)[0] for record in records) > 0


@pytest.mark.parametrize("solution", ["no rows", "garbage", "too fast"])
def test_shield_alone_keeps_every_promise(solution, monkeypatch):
    """Neither the rows nor the solver are needed for safety: any action will do that is called solved."""
    gen = torch.Generator().manual_seed(0)

    def careless(target, G, h, radius, **kwargs):
        if solution != "no rows":
            noise = torch.randn(target.shape, generator=gen).to(target)
            target = (3 if solution == "too fast" else 1) * radius * noise / noise.norm(dim=-1, keepdim=True)
        status = torch.full(target.shape[:-1], int(QPStatus.SOLVED))
        zero = torch.zeros(target.shape[:-1]).to(target)
        return QPSolution(target * (1 - 1e-6), torch.zeros_like(h), status, zero, status)

    monkeypatch.setattr(safety.programs, "project_halfspaces_ball", careless)
    for index in SMALL[::2]:
        record = roll_out(*WORLDS[index], seed=index, steps=24)
        assert [*violations(record), left_set(record)] == [0] * 5


@pytest.mark.parametrize("fields", [{"split": "half"}, {"solver": "qpth"}], ids=str)
def test_other_splits_and_solvers_are_as_safe(fields):
    for index in SMALL[1:6:2]:
        record = roll_out(*WORLDS[index], seed=index, worlds=4, steps=8, **fields)
        assert [*violations(record), left_set(record)] == [0] * 5
        assert torch.equal(limit_speed(record.data["action"], record.world.max_speed), record.data["action"])


# ---- and the test is not vacuous --------------------------------------------------------------------------------------
@pytest.mark.parametrize("fields", [{"mode": "none"}, LITERAL, HALF], ids=["none", "literal", "half"])
def test_other_filters_do_violate_in_the_same_roll_outs(fields):
    broken = (0, 2, 3) if fields is HALF else (0, 1, 2, 3)  # all but overcharged
    total = torch.zeros(4)
    for index in SMALL[::2]:
        record = roll_out(WORLDS[index][0], {}, seed=index, worlds=8, **fields)
        total += torch.tensor(violations(record))
    assert (total[list(broken)] > 0).all(), total
