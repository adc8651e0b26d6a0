"""Violation flags on hand-made states (zero tolerance, limits included), charges and episodes."""

import numpy as np
import pytest
import torch

from envs import SurveillanceConfig
from envs.keys import VIOLATION_KINDS
from envs.metrics import Charges, EpisodeTracker, minimum_distance, violations

# every number is a sum of powers of two: "exactly at the limit" is exact in binary
WORLD = SurveillanceConfig(
    n_agents=3,
    dt=0.0625,
    max_speed=0.25,
    energy_min=0.25,
    energy_max=1.0,
    drain_rate=0.0625,
    charge_rate=0.125,
    charge_radius_full=0.125,
    charge_radius=0.25,
    safety_distance=0.125,
    stations=[[-0.75, 0.0], [0.75, 0.0], [0.0, 0.75]],
    dtype="float64",
)
TINY = 2.0**-40
SLOTS = torch.tensor(WORLD.slot_positions, dtype=torch.float64)
APART = [[-0.75, 0.0], [0.75, 0.0], [0.0, 0.75]]


def flags(after, energy=(0.5, 0.5, 0.5), before=None, config=WORLD):
    after = torch.tensor(after, dtype=torch.float64)
    before = after if before is None else torch.tensor(before, dtype=torch.float64)
    slots = torch.tensor(config.slot_positions, dtype=torch.float64)
    got = violations(before, after, torch.tensor(energy, dtype=torch.float64), slots, config)
    assert tuple(got) == VIOLATION_KINDS
    return {kind: flag.tolist() for kind, flag in got.items()}


NONE = dict.fromkeys(VIOLATION_KINDS, [False] * 3)


def test_a_safe_state_has_no_violation():
    assert flags(APART) == NONE


def test_depleted_starts_below_the_limit():
    assert flags(APART, (0.25, 0.25, 0.25)) == NONE
    got = flags(APART, (0.25 - TINY, 0.25, 0.25 + TINY))
    assert got["depleted"] == [True, False, False]
    assert got["overcharged"] == got["collision"] == [False] * 3
    assert flags(APART, (-3.0, 0.5, 0.5))["depleted"] == [True, False, False]


def test_overcharged_starts_above_the_limit():
    assert flags(APART, (1.0, 1.0, 1.0)) == NONE
    assert flags(APART, (1.0, 1.0 + TINY, 9.0)) == NONE | {"overcharged": [False, True, True]}


def test_stranded_follows_its_formula():
    # charging equals the drain in the middle between the radii: R_be = 0.1875 m. Half a metre further out the way home
    # costs 0.0625 * 0.5 / 0.25 = 0.125.
    assert WORLD.break_even_radius == 0.1875
    far = [[-0.0625, 0.0], [0.75, 0.0], [0.0, 0.75]]
    assert flags(far, (0.375, 0.5, 0.5)) == NONE
    assert flags(far, (0.375 - TINY, 0.5, 0.5)) == NONE | {"stranded": [True, False, False]}
    # inside the break-even circle nothing is needed
    near = [[-0.75 + 0.1875, 0.0], [0.75, 0.0], [0.0, 0.75]]
    assert flags(near, (0.25, 0.25, 0.25)) == NONE


def test_stranded_takes_the_nearest_slot_even_of_another_robot():
    # robot 0 has moved beside slot 1 while robot 1 is away at full battery
    got = flags([[0.75, 0.0], [0.0, -0.5], [0.0, 0.75]], (0.25, 1.0, 0.5))
    assert got == NONE


@pytest.mark.parametrize("d", [2, 3])
def test_stranded_agrees_with_loops(d):
    config = SurveillanceConfig(n_agents=4, dimension=d, dtype="float64", drain_per_speed=0.05)
    rng = np.random.default_rng(d)
    position = rng.uniform(-1, 1, (300, 4, d))
    energy = rng.uniform(0.1, 0.4, (300, 4))
    slots = np.array(config.slot_positions)
    got = violations(*[torch.tensor(x) for x in (position, position, energy, slots)], config)["stranded"].numpy()
    for b in range(300):
        for i in range(4):
            way = min(np.linalg.norm(position[b, i] - s) for s in slots)
            least = 0.06 * max(0.0, way - config.break_even_radius) / 0.2
            assert got[b, i] == (energy[b, i] - 0.1 < least)
    assert 0.05 < got.mean() < 0.95


def test_collision_starts_below_the_distance_and_counts_both():
    limit = [[0.0, 0.0], [0.125, 0.0], [0.0, 0.75]]
    energy = (1.0, 1.0, 1.0)
    assert flags(limit, energy) == NONE
    closer = [[0.0, 0.0], [0.125 - TINY, 0.0], [0.0, 0.75]]
    assert flags(closer, energy) == NONE | {"collision": [True, True, False]}
    assert flags([[0.0, 0.0], [0.0, 0.0], [0.0, 0.75]], energy)["collision"] == [True, True, False]


def test_crossing_between_samples_is_a_collision():
    before = [[-0.25, 0.0], [0.25, 0.0], [0.0, 0.75]]
    after = [[0.25, 0.0], [-0.25, 0.0], [0.0, 0.75]]
    energy = (1.0, 1.0, 1.0)
    assert flags(before, energy) == NONE
    assert flags(after, energy) == NONE
    assert flags(after, energy, before=before)["collision"] == [True, True, False]


def test_passing_at_exactly_the_limit_between_samples_is_none():
    energy = (1.0, 1.0, 1.0)
    before = [[-0.25, 0.125], [0.25, 0.0], [0.0, 0.75]]
    after = [[0.25, 0.125], [-0.25, 0.0], [0.0, 0.75]]
    assert flags(after, energy, before=before) == NONE
    before[0][1] = after[0][1] = 0.125 - TINY
    assert flags(after, energy, before=before)["collision"] == [True, True, False]


def test_collision_at_the_start_or_at_the_end_of_the_step_counts():
    energy = (1.0, 1.0, 1.0)
    close, apart = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.75]], [[0.0, 0.0], [0.3, 0.0], [0.0, 0.75]]
    assert flags(apart, energy, before=close)["collision"] == [True, True, False]
    assert flags(close, energy, before=apart)["collision"] == [True, True, False]
    assert flags(apart, energy, before=apart) == NONE


def test_robots_moving_side_by_side_keep_their_distance():
    before = [[0.0, 0.0], [0.125, 0.0], [0.0, 0.75]]
    after = [[0.0, 0.25], [0.125, 0.25], [0.0, 0.75]]
    assert flags(after, (1.0, 1.0, 1.0), before=before) == NONE


def test_limits_hold_in_single_precision_too():
    config = SurveillanceConfig(n_agents=1)
    place = torch.tensor(config.slot_positions)
    below = np.nextafter(np.float32(0.1), np.float32(0))
    above = np.nextafter(np.float32(1.0), np.float32(2))
    expected = {0.1: (False, False), float(below): (True, False), 1.0: (False, False), float(above): (False, True)}
    for energy, (depleted, overcharged) in expected.items():
        got = violations(place, place, torch.tensor([energy], dtype=torch.float32), place, config)
        assert (bool(got["depleted"]), bool(got["overcharged"])) == (depleted, overcharged)


def test_not_a_number_is_a_violation():
    nan = float("nan")
    got = flags(APART, (nan, 0.5, 0.5))
    assert got["depleted"] == got["stranded"] == got["overcharged"] == [True, False, False]
    assert got["collision"] == [False] * 3
    got = flags([[nan, 0.0], [0.75, 0.0], [0.0, 0.75]])
    assert got["stranded"] == [True, False, False]
    assert got["collision"] == [True, True, True]  # nobody can say how far they are from robot 0
    assert flags(APART, before=[[-0.75, 0.0], [0.75, nan], [0.0, 0.75]])["collision"][1]


def test_one_robot_never_collides():
    config = SurveillanceConfig(n_agents=1)
    place = torch.zeros(5, 1, 2)
    got = violations(place, place, torch.ones(5, 1), torch.tensor(config.slot_positions), config)
    assert not got["collision"].any()
    assert torch.equal(minimum_distance(place, place), torch.full((5,), torch.inf))


@pytest.mark.parametrize("d", [2, 3])
def test_minimum_distance_agrees_with_a_fine_sampling(d):
    rng = np.random.default_rng(d)
    before, after = rng.uniform(-0.5, 0.5, (2, 40, 4, d))
    got = minimum_distance(torch.tensor(before), torch.tensor(after)).numpy()
    time = np.linspace(0, 1, 4001)[:, None, None]
    for b in range(40):
        path = before[b] + time * (after[b] - before[b])
        sampled = min(np.linalg.norm(path[:, i] - path[:, j], axis=-1).min() for i in range(4) for j in range(i))
        assert got[b] <= sampled + 1e-12
        assert got[b] == pytest.approx(sampled, abs=1e-3)


def test_minimum_distance_is_where_the_collision_flag_switches():
    rng = np.random.default_rng(9)
    before, after = (torch.tensor(x) for x in rng.uniform(-0.4, 0.4, (2, 400, 3, 2)))
    collided = violations(before, after, torch.ones(400, 3, dtype=torch.float64), SLOTS, WORLD)["collision"].any(-1)
    assert torch.equal(collided, minimum_distance(before, after) < 0.125)
    assert 0.1 < collided.double().mean() < 0.9


# ---- charges ----------------------------------------------------------------------------------------------------------
def charges(levels, alive=None):
    """Charges counted along one robot's energies; the threshold is 20 % of 0.75 = 0.15."""
    levels = [torch.tensor([[e]], dtype=torch.float64) for e in levels]
    found = Charges.none(levels[0])
    alive = [True] * (len(levels) - 1) if alive is None else alive
    for a, b, living in zip(levels[:-1], levels[1:], alive, strict=True):
        found = found.after(a, b, torch.tensor([[living]]), WORLD)
    return int(found.count)


def test_a_gain_of_a_fifth_counts_once():
    assert charges([0.25, 0.3125, 0.375, 0.4375, 0.5, 0.5625, 0.625]) == 1
    assert charges([0.25, 0.3125, 0.375]) == 0  # 0.125 gained
    assert charges([0.25, 0.9]) == 1  # in one step
    assert charges([0.5, 0.4, 0.3, 0.25]) == 0


def test_the_gain_is_counted_from_the_lowest_point():
    assert charges([0.9, 0.5, 0.3, 0.375, 0.4375]) == 0
    assert charges([0.9, 0.5, 0.3, 0.375, 0.475]) == 1


@pytest.mark.parametrize("pause", [0.0, -0.0625])
def test_a_pause_ends_the_interval(pause):
    first = [0.25, 0.3125, 0.375]
    second = [0.375 + pause, 0.4375 + pause, 0.5 + pause]
    assert charges(first + second) == 0  # twice 0.125
    assert charges([*first, *second, 0.5625 + pause]) == 1


def test_two_visits_are_two_charges():
    assert charges([0.25, 0.5, 0.75, 0.5, 0.25, 0.5, 0.75, 0.7]) == 2
    assert charges([0.25, 0.5, 0.75, 0.75, 0.95]) == 2  # a pause between two large gains


def test_ended_worlds_do_not_count():
    assert charges([0.25, 0.5, 0.75], alive=[False, False]) == 0
    assert charges([0.25, 0.3, 0.35, 0.9], alive=[True, True, False]) == 0


def test_robots_count_apart():
    before, after = torch.full((2, 2), 0.25), torch.tensor([[0.9, 0.25], [0.3, 0.9]])
    found = Charges.none(before).after(before, after, torch.tensor([[True], [True]]), WORLD)
    assert found.count.tolist() == [[1, 0], [0, 1]]


# ---- episodes ---------------------------------------------------------------------------------------------------------
def test_tracker_sums_between_the_ends_of_episodes():
    tracker = EpisodeTracker(2)
    reward = torch.tensor([[-1.0, -2.0, -3.0, -4.0], [-0.5, -0.5, -0.5, -0.5]])
    count = torch.tensor([[0, 1, 0, 2], [3, 0, 0, 0]])
    done = torch.tensor([[False, True, False, False], [False, False, False, False]])
    tracker.update(reward, count, done)
    assert tracker.episodes == 1
    assert tracker.finished == {"return": [-3.0], "violations": [1]}
    tracker.update(torch.tensor([[-5.0], [-0.5]]), torch.tensor([[0], [1]]), torch.tensor([[True], [True]]))
    assert tracker.episodes == 3
    assert tracker.finished == {"return": [-3.0, -12.0, -2.5], "violations": [1, 2, 4]}


def test_tracker_does_not_depend_on_how_the_steps_are_cut():
    generator = torch.Generator().manual_seed(0)
    reward = torch.randn(5, 60, generator=generator, dtype=torch.float64)
    count = torch.randint(0, 3, (5, 60), generator=generator)
    done = torch.rand(5, 60, generator=generator) < 0.1
    whole, parts = EpisodeTracker(5), EpisodeTracker(5)
    whole.update(reward, count, done)
    for start, stop in ((0, 1), (1, 20), (20, 60)):
        parts.update(reward[:, start:stop], count[:, start:stop], done[:, start:stop])
    assert whole.finished == parts.finished
    expected = []
    for t in range(60):
        for b in range(5):
            if done[b, t]:
                since = 1 + max((s for s in range(t) if done[b, s]), default=-1)
                expected.append((float(reward[b, since : t + 1].sum()), int(count[b, since : t + 1].sum())))
    assert whole.episodes == len(expected) == int(done.sum())
    np.testing.assert_allclose(whole.finished["return"], [r for r, _ in expected], atol=1e-12)
    assert whole.finished["violations"] == [v for _, v in expected]
