"""The certified set's mathematics: closest approach and gradient, lemmas 3 to 5, anchors (Theorem 1), rows, the shield."""

import dataclasses
import functools
import math

import pytest
import torch

from envs import SurveillanceConfig, SurveillanceEnv
from envs.homing import certified_parts, closest_approach, closest_moments, closest_pieces, homing_velocity, reserve
from envs.transition import transition
from safety.barriers import sampled_energy_row
from safety.certificate import anchors, closest_approach_gradient, outside, pair_minimum, shield
from tests.worlds import COUNT, F64, FAMILIES, accepted, draw_worlds, edge_rows, lone_robots, name, parts

torch.set_num_threads(1)
GEOMETRIES = pytest.mark.parametrize(("family", "d"), [(family, d) for family in FAMILIES for d in (2, 3)])
EVERY_WORLD = pytest.mark.parametrize("index", range(COUNT), ids=lambda k: name(draw_worlds(COUNT)[0][k][0]))


def make_world(family="linear", **fields):
    drain = {"drain_rate": 0.015} if family == "logarithmic" else {}
    return SurveillanceConfig(**({"reserve": family, "dtype": "float64"} | drain | fields))


def scattered(batch, n, d, seed=0, half=1.0):
    """Positions and slots anywhere; robots in their slot, within their last step and on whole steps among them."""
    gen = torch.Generator().manual_seed(seed)
    position, slot = half * (2 * torch.rand(2, batch, n, d, generator=gen, dtype=F64) - 1)
    step, part = 0.98 * 0.04, torch.arange(batch) % 8
    direction = torch.nn.functional.normalize(torch.randn(batch, d, generator=gen, dtype=F64), dim=-1)
    for case, steps in enumerate((0, 0.4, 3, 3.7)):
        position[part == case, 0] = (slot[:, 0] + steps * step * direction)[part == case]
    return position, slot


def rolled_out(position, slot, g, samples=8):
    """Least distance of robots 0 and 1 on their discrete ways home, at ``samples`` points of every step: by hand."""
    least = torch.full(position.shape[:1], math.inf, dtype=F64)
    for _ in range(80 if g.family == "linear" else 700):
        offset = slot - position
        if g.family == "linear":
            way = offset.square().sum(-1, keepdim=True).sqrt()
            move = torch.where(way <= g.speed * g.dt, offset, g.speed * g.dt * offset / way.clamp(min=1e-30))
        else:
            move = g.gain * g.dt * offset
        for sample in range(samples):
            now = position + sample / samples * move
            least = torch.minimum(least, (now[:, 0] - now[:, 1]).square().sum(-1).sqrt())
        position = position + move
    return least


# ---- closest approach and its gradient --------------------------------------------------------------------------------
@GEOMETRIES
def test_closest_moment_is_the_least_distance_of_a_roll_out(family, d):
    g = make_world(family, dimension=d).homing
    position, slot = scattered(400, 2, d)
    moments = closest_moments(position, slot, g)
    least, got = rolled_out(position, slot, g), moments.distance.amin(0)[:, 0]
    assert (got <= least + 1e-12).all()
    assert (least - got).max() <= 2 * 0.04 / 8 + 1e-9  # no farther than half a sample's relative motion
    torch.testing.assert_close(got, closest_approach(position, slot, g)[:, 0], rtol=0, atol=1e-12)
    assert (got < (position[:, 0] - position[:, 1]).norm(dim=-1) - 1e-3).double().mean() > 0.2  # on the way
    for distance, relative, share in zip(moments.distance, moments.relative, moments.share, strict=True):
        torch.testing.assert_close(relative.norm(dim=0), distance, rtol=0, atol=1e-12)
        places = slot + share[..., 0].T.unsqueeze(-1) * (position - slot)
        torch.testing.assert_close(places[:, 0] - places[:, 1], relative[..., 0].T, rtol=0, atol=1e-9)


def share_to_go(position, slot, g):
    """Share of robots 0's and 1's way home still to go when they are closest, ``(2, B)``."""
    moments = closest_moments(position, slot, g)
    index = moments.distance.argmin(0)[None, None].expand(1, 2, -1, -1)
    return moments.share.gather(0, index)[0, ..., 0]


def difference_quotients(position, slot, g, robot, h=1e-7):
    """Forward and backward difference quotients of G_01 along every axis of a robot, ``(2, B, d)``."""
    here, base = torch.arange(2).unsqueeze(-1) == robot, closest_approach(position, slot, g)
    shifts = [[k * h * here * x for x in torch.eye(position.shape[-1], dtype=F64)] for k in (1, -1)]
    sides = [torch.cat([closest_approach(position + x, slot, g) - base for x in row], -1) for row in shifts]
    return torch.stack([sides[0], -sides[1]]) / h


@GEOMETRIES
def test_gradient_is_the_difference_quotient(family, d):
    g = make_world(family, dimension=d).homing
    position, slot = scattered(1500, 2, d, seed=1)
    gap, *sides = closest_approach_gradient(position, slot, g)
    way = (position - slot).norm(dim=-1)
    share = share_to_go(position, slot, g)
    for robot, gradient in enumerate(sides):
        both = difference_quotients(position, slot, g, robot)
        smooth = ((both[0] - both[1]).norm(dim=-1) < 1e-3) & (gap[:, 0] > 1e-2)  # elsewhere: a kink
        assert smooth.double().mean() > 0.85
        assert (gradient[:, 0] - both.mean(0)).norm(dim=-1)[smooth].max() < 1e-4
        # every kind of moment is among them: at once, on the way, in the last step, at home
        last = way[:, robot] < g.speed * g.dt
        for kind in (share[0] == 1, (share[0] > 0) & (share[0] < 1), share[0] == 0, last):
            assert robot > 0 or (smooth & kind).sum() > 10


@GEOMETRIES
def test_gradient_in_the_slot_is_the_limit_from_all_sides(family, d):
    g = make_world(family, dimension=d).homing
    position, slot = scattered(400, 2, d, seed=2)
    position[:, 1] = slot[:, 0] + 2 * (position[:, 1] - slot[:, 0]).clamp(-0.2, 0.2)  # the other one passes by
    position[:, 0] = slot[:, 0]
    slot[:200, 1] = slot[:200, 0] + 0.3 * (slot[:200, 1] - slot[:200, 0])
    gap, there, _ = closest_approach_gradient(position, slot, g)
    apart = gap[:, 0] > 1e-2
    for seed in range(4):
        beside = position.clone()
        beside[:, 0] += 1e-9 * scattered(400, 1, d, seed=seed)[0][:, 0]
        near = closest_approach_gradient(beside, slot, g)[1]
        torch.testing.assert_close(near[apart], there[apart], rtol=0, atol=1e-5)
    share = share_to_go(position, slot, g)[0]
    assert (there[apart][share[apart] == 0] == 0).all()  # home by then: no influence
    assert torch.equal(share == 1, there.norm(dim=-1)[:, 0] > 1 - 1e-9)
    assert min((share == 0).sum(), (share == 1).sum()) > 20


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_mirrored_robots_keep_an_offset_of_exactly_zero(dtype):
    """A rounding in the relative path would tilt the rows of a robot between two others, and pin it."""
    g = make_world(dimension=2).homing
    position, slot = (x[:, :1].to(dtype) for x in scattered(2000, 1, 2, seed=5))
    mirror = torch.tensor([-1.0, 1.0], dtype=dtype)
    pieces = closest_pieces(torch.cat([position, mirror * position], 1), torch.cat([slot, mirror * slot], 1), g)
    assert (pieces.relative[:, 1] == 0).all()
    assert (pieces.relative[:, 0] != 0).any()


# ---- lemmas -------------------------------------------------------------------------------------------------------------
@GEOMETRIES
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_lemma_3_joint_homing_never_lowers_the_closest_approach(family, d, dtype):
    world = make_world(family, dimension=d, dtype=dtype)
    position, slot = (x.to(world.torch_dtype) for x in scattered(400, 5, d, seed=4))
    now, lost = closest_approach(position, slot, world.homing), 0.0
    for _ in range(60):
        position = position + world.dt * homing_velocity(position, slot, world.homing)
        then = closest_approach(position, slot, world.homing)
        lost, now = max(lost, float((now - then).max())), then
    assert lost <= 8 * torch.finfo(world.torch_dtype).eps * math.sqrt(d)
    assert 60 * lost < world.homing.eps_distance


LAYOUTS = {
    "default": {},
    "ring": {"n_agents": 4, "stations": [[0.1, 0.2]], "slots": 4, "slot_radius": 0.13, "charge_radius": 0.36},
    "wide_ring": {"stations": [[0.1, 0.2]], "slots": 3, "slot_radius": 0.2, "charge_radius": 0.5},
    "expensive": {"drain_per_speed": 0.02, "drain_per_speed_squared": 0.1, "energy_max": 2.0},
}


@pytest.mark.parametrize("layout", LAYOUTS)
@GEOMETRIES
def test_lemma_4_a_homing_step_keeps_the_energy_margin(family, d, layout):
    world = make_world(family, dimension=d, **LAYOUTS[layout])
    env, g = SurveillanceEnv(world, 1), world.homing
    gen = torch.Generator().manual_seed(6)
    slot = env.slots[torch.randint(len(env.slots), (6000, 1), generator=gen)]
    position = env.bounds[:, 0] + 2 * torch.rand(6000, 1, d, generator=gen, dtype=F64)  # the arena's sides are 2 m
    position[::2] = (slot + 0.3 * (2 * torch.rand(slot.shape, generator=gen, dtype=F64) - 1))[::2]
    need = reserve((position - slot).norm(dim=-1), g)
    span = world.energy_max - world.energy_min
    energy = world.energy_min + (need + span * torch.rand(need.shape, generator=gen, dtype=F64) ** 3).clamp(max=span)
    energy[::7] = world.energy_max - 2 * g.eps_energy * torch.rand(energy[::7].shape, generator=gen, dtype=F64)
    before = energy - world.energy_min - need
    current, _ = accepted(world, position, energy, env.stations, 0.5 / world.dt)
    place, after = transition(position, energy, homing_velocity(position, slot, g), current, env.stations, world)
    margin = after - world.energy_min - reserve((place - slot).norm(dim=-1), g)
    assert after.max() <= world.energy_max
    inside = before >= 0
    # a battery nearly full may be throttled below what motion costs: it loses that much, and has it to spare
    throttle = world.dt * (world.max_drain_rate - world.drain_rate) * (1 + 1 / 0.5)
    low_enough = energy <= world.energy_max - g.eps_energy - throttle
    assert (margin - before)[inside & low_enough].min() >= -1e-14
    assert margin[inside].min() >= -1e-14
    assert min((inside & ~low_enough).sum(), (inside & (before < 1e-3)).sum()) > 100


@GEOMETRIES
def test_lemma_5_two_homing_robots_keep_their_collision_row(family, d):
    world = make_world(family, dimension=d)
    g, delta = world.homing, world.safety_distance

    def slack(position, slot):
        q, w = (x[:, 0] - x[:, 1] for x in (position, homing_velocity(position, slot, g)))
        return (q.square().sum(-1) - delta**2) / g.dt + 2 * (q * w).sum(-1)

    position, slot = scattered(200_000, 2, d, seed=7, half=0.35)
    gap = closest_approach(position, slot, g)[:, 0]
    assert slack(position, slot)[gap >= g.clearance].min() >= 0
    assert ((gap < g.clearance + 0.01) & (gap >= g.clearance)).sum() > 200
    if family == "linear":  # and not without the term (2 max_speed dt)^2 in the clearance
        assert slack(position, slot)[gap >= delta + g.eps_distance].min() < 0


# ---- Theorem 1: the anchor is admissible --------------------------------------------------------------------------------
@EVERY_WORLD
def test_anchor_satisfies_every_row(index):
    (env, position, energy, slot, home, _, rows), world = edge_rows(index), draw_worlds(COUNT)[0][index][0]
    assert parts(env, position, energy, slot, 2).all()
    assert rows.anchor.norm(dim=-1).max() <= world.max_speed * (1 + 1e-6)
    excess = (rows.G * rows.anchor.unsqueeze(-2)).sum(-1) - rows.h
    scale = world.max_speed * rows.G.norm(dim=-1) + rows.h.clamp(-1e9, 1e9).abs()
    assert (excess <= 1e-6 * scale).all()
    critical, velocity, fast = (
        rows.h[..., 0] < 0,
        homing_velocity(position, home, world.homing),
        rows.anchor.norm(dim=-1),
    )
    demand = -rows.h[..., 0] / rows.G[..., 0, :].norm(dim=-1).clamp(min=1e-30)
    # critical robots drive straight home, at least as fast as the row demands; nobody moves unless asked to
    assert (fast >= torch.maximum(demand, velocity.norm(dim=-1)) * (1 - 1e-6))[critical].all()
    assert ((rows.anchor * velocity).sum(-1) >= fast * velocity.norm(dim=-1) * (1 - 1e-5)).all()
    assert (fast > 0)[~critical.any(-1)].sum() == 0


def test_edge_states_are_critical_in_every_way():
    count = torch.zeros(4)
    for index in range(COUNT):
        env, position, _, _, home, _, rows = edge_rows(index)
        g, way = env.geometry, (position - home).norm(dim=-1)
        at_wall = (position.unsqueeze(-1) == env.bounds).flatten(-2).any(-1)
        tight = rows.closest < g.clearance + 2 * g.eps_distance
        count += torch.tensor([int(x.sum()) for x in (rows.h[..., 0] < 0, tight, at_wall, way < g.reserve_radius)])
    assert (count > 100).all(), count


def test_pairs_without_slack_drive_home_together():
    """A convoy: the last is critical, the one ahead too close to stand, the third far enough away to do so."""
    world = make_world(n_agents=3, stations=[[0.95, 0.0], [0.7, 0.0], [-0.9, 0.0]])
    home, g = torch.tensor([world.slot_positions], dtype=F64), world.homing
    position = torch.tensor([[[-0.1, 0.0], [-0.1 - 1.001 * g.clearance, 0.0], [-0.8, 0.5]]], dtype=F64)
    need = world.energy_min + 2 * g.eps_energy + reserve((position - home).norm(dim=-1), g)
    energy = need + torch.tensor([[0.3, 0.0, 0.3]], dtype=F64)
    drained = energy - world.dt * world.drain_rate
    _, normal, bound = sampled_energy_row(position, energy, drained, home, g, gain=0.2, step=0.04)
    q = position[:, [0, 0, 1]] - position[:, [1, 2, 2]]
    normals = torch.stack([-2 * q[0].T, 2 * q[0].T]).unsqueeze(0)
    slack = (q[0].square().sum(-1) - world.safety_distance**2)[None] / world.dt
    members = (torch.zeros(3, dtype=torch.int64), *torch.triu_indices(3, 3, 1))
    chosen, left = anchors(normal, bound, position, home, members, normals, slack, g, world.max_speed)
    assert (bound < 0).tolist() == [[False, True, False]]
    speed = homing_velocity(position, home, g)
    assert torch.equal(chosen[0, ::2], torch.stack([speed[0, 0], torch.zeros(2, dtype=F64)]))
    assert chosen[0, 1, 0] >= speed[0, 1, 0]
    by_hand = slack[0] + 2 * (q[0] * (chosen[0, [0, 0, 1]] - chosen[0, [1, 2, 2]])).sum(-1)
    torch.testing.assert_close(left[0], by_hand)
    assert slack[0, 0] < 2 * q[0, 0, 0] * speed[0, 1, 0]  # negative had the one ahead stood still


# ---- the shield ---------------------------------------------------------------------------------------------------------
def by_hand(step, position, energy, home, action, current, level, g, bounds):
    """The rule of the shield for one world, with loops."""
    n, velocity = len(level), homing_velocity(position, home, g)
    for rounds in range(1, 2 * n + 2):
        chosen = torch.stack([(action[i], torch.zeros_like(action[i]), velocity[i])[level[i]] for i in range(n)])
        robots, pairs = certified_parts(*step(position, energy, chosen, current), home, g, bounds, margins=1)
        raised = {i for i in range(n) if not robots[i]}
        for good, (i, j) in zip(pairs, torch.triu_indices(n, n, 1).T.tolist(), strict=True):
            raised |= set() if good else {k for k in (i, j) if level[k] == min(level[i], level[j])}
        if all(level[k] == 2 for k in raised):
            return chosen, level, rounds
        level = [min(2, x + (k in raised)) for k, x in enumerate(level)]
    raise AssertionError("the levels never settled")


def run_shield(index, kind, seed=0, worlds=slice(None)):
    """Shield of actions such as a broken solver might return, some robots at level 1 from the start."""
    env, position, energy, _, home, current, rows = edge_rows(index)
    gen = torch.Generator().manual_seed(seed)
    world, noise = env.config, torch.randn(position.shape, generator=gen, dtype=F64)
    size = {"full speed": world.max_speed * (1 - 1e-6), "huge": 10 * world.diameter / world.dt, "nan": math.nan}[kind]
    size = torch.where(torch.rand(energy.shape, generator=gen) < 0.8, size, 0.0).unsqueeze(-1)
    action = (size * torch.nn.functional.normalize(noise, dim=-1)).to(position)
    level = (torch.rand(energy.shape, generator=gen) < 0.1).long()
    step = functools.partial(transition, stations=env.stations, config=world)
    inputs = [x[worlds] for x in (position, energy, home, action, current, level)]
    given = (rows.closest[worlds], env.geometry, env.bounds)
    return env, step, inputs, shield(step, *inputs, *given, max_speed=world.max_speed)


@pytest.mark.parametrize("kind", ["full speed", "huge", "nan"])
@EVERY_WORLD
def test_shield_ends_in_a_certified_state_whatever_the_actions(index, kind):
    env, step, (position, energy, home, action, current, level), (chosen, raised, rounds) = run_shield(index, kind)
    after = step(position, energy, chosen, current)
    assert all(part.all() for part in certified_parts(*after, home, env.geometry, env.bounds, margins=1))
    assert (rounds <= 2 * env.config.n_agents + 1).all()
    assert ((raised >= level) & (raised <= 2)).all()
    actions = torch.stack([action, torch.zeros_like(action), homing_velocity(position, home, env.geometry)])
    assert torch.equal(chosen, actions.gather(0, raised[None, ..., None].expand(1, *action.shape))[0])


@pytest.mark.parametrize("index", [1, 3, 8, 10, 13, 17, 23])
def test_shield_raises_exactly_who_fails(index):
    for seed in (1, 2):
        env, step, inputs, (chosen, level, rounds) = run_shield(index, "full speed", seed=seed)
        for world in range(0, 48, 3):
            want = by_hand(step, *(x[world] for x in inputs[:5]), inputs[5][world].tolist(), env.geometry, env.bounds)
            assert level[world].tolist() == want[1]
            assert int(rounds[world]) == want[2]
            torch.testing.assert_close(chosen[world], want[0], rtol=0, atol=1e-7 * env.config.max_speed)
        assert 0 < (level > 0).double().mean() < 1


@pytest.mark.parametrize("index", [3, 13, 20])
def test_worlds_do_not_see_each_other(index):
    _, _, _, whole = run_shield(index, "full speed", seed=2)
    for world in range(0, 48, 6):
        _, _, _, alone = run_shield(index, "full speed", seed=2, worlds=slice(world, world + 1))
        for a, b in zip(alone, whole, strict=True):
            assert torch.equal(a[0], b[world])


def test_outside_marks_robots_and_both_of_a_pair():
    world = make_world(n_agents=4, stations=[[0.8, 0.0], [-0.8, 0.0], [0.0, 0.8], [0.0, -0.8]])
    g, bounds = world.homing, torch.tensor(world.bounds, dtype=F64)
    home = torch.tensor([world.slot_positions], dtype=F64)

    def marked(position, energy):
        return outside(position, energy, home, closest_approach(position, home, g), g, bounds)[0].tolist()

    full, close, off = torch.full((1, 4), 0.9, dtype=F64), home.clone(), home.clone()
    assert marked(home, full) == [False] * 4
    assert marked(home, torch.tensor([[0.9, 0.0999, 1.001, math.nan]], dtype=F64)) == [False, True, True, True]
    close[0, 2] = close[0, 0] + torch.tensor([-g.clearance + 2 * g.eps_distance, 0.0], dtype=F64)
    assert marked(close, full) == [True, False, True, False]
    off[0, 3, 1] = -1 - 2 * g.eps_distance
    assert marked(off, full) == [False, False, False, True]


@pytest.mark.parametrize("n", [1, 2, 5])
def test_pair_minimum_is_the_least_over_the_own_pairs(n):
    values = torch.rand(7, n * (n - 1) // 2, generator=torch.Generator().manual_seed(0))
    pairs = torch.triu_indices(n, n, 1).T.tolist()
    for row, own in zip(pair_minimum(values, n).tolist(), values.tolist(), strict=True):
        for i in range(n):
            assert row[i] == min((x for x, pair in zip(own, pairs, strict=True) if i in pair), default=math.inf)


# ---- the survivability row: every ingredient is needed -----------------------------------------------------------------
@pytest.mark.parametrize("missing", ["nothing", "one step", "chord", "floor"])
def test_every_ingredient_of_the_survivability_row_is_needed(missing):
    lowest = math.inf
    for dt, way in ((0.2, "away"), (0.5, "tangential"), (0.2, "home")):
        radii = {"charge_radius": 0.33, "charge_radius_full": 0.32}
        world = make_world(n_agents=1, stations=[[0.0, 0.0]], energy_max=10.0, dt=dt, **radii)
        g = world.homing
        changes = {"one step": {"reserve_radius": g.charge_radius}, "floor": {"eps_energy": 1e-9}}
        g = dataclasses.replace(g, **changes.get(missing, {}))
        energy = lone_robots(world, way, g, chord=float(missing != "chord"))
        lowest = min(lowest, float((energy.min() - world.energy_min) / world.homing.eps_energy))
    # without the floor the shield objects, and rounding alone decides about a violation
    least, most = {"nothing": (2 - 1e-6, math.inf), "floor": (0, 1)}.get(missing, (-math.inf, 0))
    assert least <= lowest < most
