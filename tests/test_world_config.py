"""Every field out of its range is refused with a message that names field, value and what is allowed."""

import dataclasses
import math
import warnings

import pytest

from envs import SurveillanceConfig

NAN, INF = float("nan"), float("inf")

# field: (lowest, highest, values out of range, values just inside)
RANGES = {
    "n_agents": (1, 64, [0, -3, 65], [1]),
    "dt": (0, 10, [0, -0.1, 10.5, NAN, INF], [1e-3]),
    "max_speed": (0, 100, [0.0, -1.0, 100.1, NAN, INF], [0.01]),
    "slot_radius": (0, 10, [-1e-9, 10.1, NAN], [0, 10]),
    "energy_max": (0, 1e6, [0, -1.0, 1.1e6, INF], [1e6]),
    "energy_min": (0, 1.0, [-0.1, 1.1, NAN], [0]),
    "drain_rate": (0, 1e6, [0, -0.06, 1.1e6, NAN], [1e-5]),
    "drain_per_speed": (0, 1e6, [-0.01, NAN, INF], [0]),
    "drain_per_speed_squared": (0, 1e6, [-0.01, NAN, INF], [0]),
    "charge_rate": (0, 1e6, [0, -1.0, 1.1e6, NAN], [1e6]),
    "charge_radius": (0, 100, [0, -0.2, 100.1, NAN], [100]),
    "charge_radius_full": (0, 0.24, [-0.01, 0.3, NAN], [0]),
    "safety_distance": (0, 10, [0, -0.1, 10.1, NAN], [1e-3]),
    "horizon": (0, 10**9, [-1, 10**9 + 1], [0, 10**9]),
    "density_sigma": (0, 100, [0, -0.1, 100.1, NAN], [100, 1e-3]),
    "density_amplitude": (0, 100, [-0.1, 100.1, NAN], [0, 100]),
    "density_period": (0, 1e6, [0, -1.0, 1.1e6, NAN], [1e6]),
    "sensing_radius": (0, 100, [0, -1.0, 100.1, NAN], [100]),
    "age_limit": (0, 1e6, [0, -1.0, 1.1e6, NAN], [1e6]),
    "resolution": (2, 512, [1, -5, 513], [0, 2, 512]),
    "homing_speed": (0, 1, [0, -0.5, 1.0, 1.5, NAN], [0.9999, 0.5]),
    "homing_clearance": (0, 10, [-0.1, 10.1, NAN], [0, 0.2]),
    "reset_clearance": (0, 10, [-0.1, 10.1, NAN], [0, 10]),
    "reset_reserve": (0, 1, [-0.1, 1.0, 1.5, NAN], [0]),
    "slots": (1, 16, [0, -1, 17], [1]),
}
CHOICES = {
    "density": (["", "gauss", "Uniform", None], ["uniform", "gaussian_mixture", "moving", "age"]),
    "on_violation": (["stop", None], ["terminate", "continue"]),
    "reserve": (["log", ""], ["linear", "logarithmic"]),
    "dtype": (["float16", "double"], ["float32", "float64"]),
}
SWITCHES = {"density_per_world", "reassign_slots", "observe_centroid"}
TABLES = {"arena", "stations", "density_centers"}


def refused(**changes):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the callers check the message)
        SurveillanceConfig(**changes)
    return str(error.value)


def test_every_field_is_covered_by_a_check():
    fields = {f.name for f in dataclasses.fields(SurveillanceConfig)}
    assert fields == set(RANGES) | set(CHOICES) | SWITCHES | TABLES | {"dimension"}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, row in RANGES.items() for v in row[2]])
def test_numbers_out_of_range_are_refused(name, value):
    message = refused(**{name: value})
    low, high, *_ = RANGES[name]
    assert f"env.{name}={value}" in message
    assert "allowed" in message
    bounds = message.split("allowed")[1].split("]")[0].strip(" ([").split(", ")
    assert float(bounds[0]) == low
    assert float(bounds[1]) == pytest.approx(high, rel=0.011)  # half-open ends are shown as 0.99 and 0.9999
    assert len(message.splitlines()) <= 8


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, row in RANGES.items() for v in row[3]])
def test_numbers_at_the_edge_of_their_range_are_accepted(name, value):
    assert getattr(SurveillanceConfig(**{name: value}), name) == value


@pytest.mark.parametrize("value", ["fast", None, [0.2]])
def test_something_that_is_no_number_is_refused(value):
    assert f"env.max_speed={value}" in refused(max_speed=value)


@pytest.mark.parametrize("name", ["n_agents", "dimension", "horizon", "resolution"])
@pytest.mark.parametrize("value", [2.5, 3.0, NAN, True, "3", None])
def test_counts_are_whole_numbers(name, value):
    message = refused(**{name: value})
    assert f"env.{name}={value!r}" in message
    assert "whole number" in message


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, row in CHOICES.items() for v in row[0]])
def test_unknown_choices_are_refused_with_the_known_ones(name, value):
    message = refused(**{name: value})
    assert f"env.{name}={value!r}" in message
    assert all(choice in message for choice in CHOICES[name][1])


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, row in CHOICES.items() for v in row[1]])
def test_known_choices_are_accepted(name, value):
    slow = {"drain_rate": 0.02} if value == "logarithmic" else {}  # whose reserve the default battery does not cover
    assert getattr(SurveillanceConfig(**{name: value}, **slow), name) == value


@pytest.mark.parametrize("value", [1, 4, 0])
def test_dimension_is_two_or_three(value):
    message = refused(dimension=value)
    assert f"env.dimension={value}" in message
    assert "2" in message.split("choose")[1]
    assert "3" in message.split("choose")[1]


@pytest.mark.parametrize(
    "arena",
    [
        [],
        [[-1.0, 1.0]],
        [[-1.0, 1.0]] * 4,
        [[-1.0, 1.0], [0.0]],
        [[-1.0, 1.0], [0.0, 1.0, 2.0]],
        [[-1.0, 1.0], [1.0, 1.0]],
        [[-1.0, 1.0], [1.0, 0.0]],
        [[-1.0, 1.0], [NAN, 1.0]],
        [[-1.0, INF], [0.0, 1.0]],
        [[-1.0, 1.0], ["a", "b"]],
        [[-1.0, 1.0], 3.0],
        "square",
    ],
)
def test_an_arena_that_is_no_box_is_refused(arena):
    message = refused(arena=arena)
    assert f"env.arena={arena}" in message
    assert "row" in message


@pytest.mark.parametrize("name", ["stations", "slots", "density_centers"])
@pytest.mark.parametrize("rows", [[[0.1]], [[0.1, 0.2, 0.3]], [[0.1, NAN]], [["a", 0.0]], "center", [0.1, 0.2]])
def test_tables_of_positions_are_checked(name, rows):
    message = refused(**{name: rows, "n_agents": 1})
    assert f"env.{name}={rows}" in message
    assert "list of positions" in message


def test_tables_may_be_tuples():
    arena, stations = [[0.0, 3.0], [0.0, 2.0]], [[0.2, 0.2], [2.8, 0.2], [0.2, 1.8]]
    rows = SurveillanceConfig(arena=arena, stations=stations, density="uniform")
    tuples = {"arena": tuple(map(tuple, arena)), "stations": tuple(map(tuple, stations))}
    assert SurveillanceConfig(**tuples, density="uniform") == rows  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("density", ["gaussian_mixture", "moving"])
def test_what_is_worth_watching_beyond_the_arena_is_said(density):
    with pytest.warns(UserWarning, match=r"\[\[-0.45, -0.35\], \[0.5, -0.15\]\] lie outside env.arena"):
        SurveillanceConfig(arena=[[0, 3], [0, 2]], stations=[[0, 0], [3, 0], [0, 2]], density=density)


@pytest.mark.parametrize("changes", [{"density": "uniform"}, {"density": "age"}, {"density_per_world": True}])
def test_centres_that_nobody_reads_may_be_anywhere(changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SurveillanceConfig(arena=[[0, 3], [0, 2]], stations=[[0, 0], [3, 0], [0, 2]], **changes)


def test_a_density_needs_a_centre():
    assert "env.density_centers=[]" in refused(density_centers=[])


@pytest.mark.parametrize(
    "changes",
    [
        {"n_agents": 3, "stations": [[-0.5, 0.0], [0.5, 0.0]]},
        {"n_agents": 5, "stations": [[-0.5, 0.0], [0.5, 0.0]], "slots": 2},
        {"n_agents": 3, "slots": [[-0.9, 0.0], [0.9, 0.0]]},
    ],
)
def test_fewer_slots_than_robots_are_refused(changes):
    message = refused(**changes)
    have = 4 if changes.get("slots") == 2 else 2
    assert f"{have} slots" in message
    assert f"env.n_agents={changes['n_agents']}" in message


def test_overlapping_slots_are_refused_at_the_needed_distance():
    g = SurveillanceConfig().homing
    needed = g.clearance + g.eps_distance
    row = {"n_agents": 2, "stations": [[0.0, 0.0], [0.0, 0.0]]}
    row["stations"][1][0] = needed - 1e-6
    message = refused(**row)
    assert "env.slots" in message
    assert "overlap" in message
    assert f"{needed:.4g}" in message
    row["stations"][1][0] = needed + 1e-6
    assert len(SurveillanceConfig(**row).slot_positions) == 2


def test_a_crowded_ring_is_refused():
    """n slots on a ring of radius r are 2 r sin(pi / n) apart."""
    g = SurveillanceConfig().homing
    needed = g.clearance + g.eps_distance
    for n in (2, 3, 4, 5):
        least = needed / (2 * math.sin(math.pi / n))
        changes = {"n_agents": n, "stations": [[0.0, 0.0]], "slots": n, "charge_radius": 0.5}
        assert "overlap" in refused(slot_radius=least - 1e-4, **changes)
        slots = SurveillanceConfig(slot_radius=least + 1e-4, **changes).slot_positions
        assert [math.hypot(*slot) for slot in slots] == pytest.approx([least + 1e-4] * n)


@pytest.mark.parametrize("slot", [[-1.01, 0.0], [0.0, 1.5]])
def test_slots_outside_the_arena_are_refused(slot):
    for name in ("stations", "slots"):
        message = refused(**{name: [slot, [0.5, 0.5]], "n_agents": 2})
        assert "outside env.arena" in message
        assert str(slot[0]) in message


def test_a_charger_weaker_than_the_drain_is_refused():
    assert "env.charge_rate=0.06" in refused(charge_rate=0.06)
    message = refused(charge_rate=0.07, drain_per_speed=0.05)  # 0.06 at rest, 0.07 at 0.2 m/s
    assert "env.charge_rate=0.07" in message
    assert "0.07" in message.split("drain")[1]
    assert "env.charge_rate" in refused(charge_rate=0.1, drain_per_speed_squared=1.0)  # exactly the drain at full speed


def test_a_reserve_that_ends_within_two_steps_of_the_slot_is_refused():
    # K_c w = K_d at R_be; the reserve ends 0.98 U inside and needs 2 U: R_be >= 2.98 U
    radius = SurveillanceConfig().break_even_radius
    for factor, fine in ((0.999, True), (1.001, False)):
        dt = factor * radius / (2.98 * 0.2)
        if fine:
            assert SurveillanceConfig(dt=dt).homing.reserve_radius >= 2 * 0.2 * dt
        else:
            message = refused(dt=dt)
            assert "env.charge_radius=0.24" in message
            assert f"{2 * 0.2 * dt:.4g}" in message
    assert "env.charge_radius" in refused(slots=[[0.3, 0.0]], stations=[[0.0, 0.0]], n_agents=1)  # slot off the charger


@pytest.mark.parametrize(("low", "high"), [(1.0, 1.0), (0.5, 0.4), (2.0, 1.0)])
def test_energy_limits_must_be_in_order(low, high):
    message = refused(energy_min=low, energy_max=high)
    assert f"env.energy_min={low}" in message
    assert str(high) in message


def test_a_battery_of_one_step_is_refused():
    message = refused(energy_min=0.1, energy_max=0.11)  # one step drains 0.012
    assert "env.energy_max - env.energy_min" in message


def test_charging_radii_must_be_in_order():
    assert "env.charge_radius_full=0.24" in refused(charge_radius_full=0.24)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("n", range(1, 17))
def test_the_default_world_suits_one_to_sixteen_robots(n, d):
    config = SurveillanceConfig(n_agents=n, dimension=d)
    slots = config.slot_positions
    assert len(slots) == len(config.station_positions) == n
    assert all(len(slot) == d for slot in slots)
    for slot in slots:
        walls = [min(x - low, high - x) for x, (low, high) in zip(slot[:2], config.bounds[:2], strict=True)]
        assert min(walls) == pytest.approx(0.1)  # 5 % of the shorter side from the nearest wall
        assert slot[2:] == ([-1.0] if d == 3 else [])  # on the floor
    assert all(math.dist(a, b) > config.homing.clearance for i, a in enumerate(slots) for b in slots[:i])


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_perimeter_stations_are_evenly_spaced_along_the_walls(n):
    stations = SurveillanceConfig(n_agents=n, arena=[[0.0, 4.0], [0.0, 2.0]]).station_positions
    width, height = 3.8, 1.8  # inset by 5 % of 2 m on each side

    def along(x, y):
        x, y = x - 0.1, y - 0.1
        if abs(y) < 1e-9:
            return x
        if abs(x - width) < 1e-9:
            return width + y
        if abs(y - height) < 1e-9:
            return 2 * width + height - x
        return 2 * (width + height) - y

    length = 2 * (width + height)
    expected = [(width / 2 + k * length / n) % length for k in range(n)]
    assert [along(*s) for s in stations] == pytest.approx(expected, abs=1e-9)


def test_missing_coordinates_are_filled_in():
    config = SurveillanceConfig(
        n_agents=2,
        dimension=3,
        arena=[[-1.0, 1.0], [-1.0, 1.0], [0.5, 2.0]],
        stations=[[0.5, 0.5], [-0.5, -0.5, 1.0]],
        density_centers=[[0.1, 0.2]],
    )
    assert config.station_positions == [[0.5, 0.5, 0.5], [-0.5, -0.5, 1.0]]
    assert config.density_center_positions == [[0.1, 0.2, 1.25]]
    assert SurveillanceConfig(dimension=3, arena=[[-1.0, 1.0], [-2.0, 2.0]]).bounds[2] == [-2.0, 2.0]


def test_derived_figures_of_the_default_world():
    config = SurveillanceConfig()
    assert config.diameter == pytest.approx(math.sqrt(8))
    assert config.length_scale == 1.0
    assert (config.quadrature_resolution, SurveillanceConfig(dimension=3).quadrature_resolution) == (20, 10)
    assert SurveillanceConfig(resolution=7).quadrature_resolution == 7
    lifetime = (config.energy_max - config.energy_min) / (config.drain_rate * config.dt)
    assert 60 <= lifetime <= 90  # charging is necessary within an episode of 100 steps
    g = config.homing
    steps = math.ceil(math.sqrt(8) / (0.196 * 0.2))
    scale = 1.0 + 0.06 * (math.sqrt(8) + 1.0) / 0.196
    assert g.eps_energy >= 4 * steps * 2**-24 * scale  # SAFETY.md section 3
    assert g.eps_distance >= 8 * steps * 2**-24
    assert g.clearance**2 >= (0.12 + g.eps_distance) ** 2 + 0.08**2 - 1e-12  # inequality 4
