"""Charging field, break-even radius, power and the Euler step of the battery against closed forms."""

import math

import numpy as np
import pytest
import torch

from envs import SurveillanceConfig
from envs.battery import break_even_radius, charge, charging_field, power

R1, R2 = 0.12, 0.24


def smoothstep_field(distance, full=R1, zero=R2):
    """Scalar reference: 1, then the cubic that is flat at both ends, then 0."""
    if distance <= full:
        return 1.0
    if distance >= zero:
        return 0.0
    x = (distance - full) / (zero - full)
    return 1 - 3 * x**2 + 2 * x**3


def field_at(distance, **radii):
    position = torch.tensor([[distance, 0.0]], dtype=torch.float64)
    radii = {"full_radius": R1, "zero_radius": R2} | radii
    return float(charging_field(position, torch.zeros(1, 2, dtype=torch.float64), **radii))


@pytest.mark.parametrize("d", [2, 3])
def test_field_is_the_largest_over_all_stations(d):
    rng = np.random.default_rng(d)
    stations = rng.uniform(-0.3, 0.3, (4, d))
    position = rng.uniform(-0.5, 0.5, (60, 3, d))
    expected = np.array(
        [[max(smoothstep_field(math.dist(p, s)) for s in stations) for p in robots] for robots in position]
    )
    assert (expected == 0).any()
    assert ((expected > 0) & (expected < 1)).any()
    assert (expected == 1).any()
    got = charging_field(torch.tensor(position), torch.tensor(stations), full_radius=R1, zero_radius=R2)
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-14)


def test_field_at_its_landmarks():
    assert field_at(0.0) == 1
    assert field_at(R1) == 1
    assert field_at(R2) == 0
    assert field_at(5.0) == 0
    assert field_at((R1 + R2) / 2) == pytest.approx(0.5, abs=1e-14)


def test_field_falls_strictly_between_the_radii_without_a_jump():
    values = np.array([field_at(r) for r in np.linspace(R1, R2, 400)])
    assert (np.diff(values) < 0).all()
    assert np.abs(np.diff(values)).max() < 1.5 / 399 * 1.01  # the cubic's steepest slope is 3/2
    assert field_at(R1 + 1e-6) == pytest.approx(1, abs=1e-9)  # flat at both ends
    assert field_at(R2 - 1e-6) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("level", [0.01, 1 / 6, 0.5, 0.77, 0.999])
@pytest.mark.parametrize("radii", [(0.12, 0.24), (0.0, 0.3), (0.06, 0.14)])
def test_break_even_radius_solves_the_cubic(level, radii):
    full, zero = radii
    radius = break_even_radius(level, full, zero)
    roots = np.roots([2, -3, 0, 1 - level])  # 1 - 3 x^2 + 2 x^3 = level
    x = next(r.real for r in roots if abs(r.imag) < 1e-9 and 0 <= r.real <= 1)
    assert radius == pytest.approx(full + x * (zero - full), abs=1e-9)
    assert smoothstep_field(radius, full, zero) == pytest.approx(level, abs=1e-12)


@pytest.mark.parametrize("level", [1.0, 1.7])
def test_drain_at_or_above_the_charger_breaks_even_on_the_flat_top_only(level):
    assert break_even_radius(level, R1, R2) == pytest.approx(R1, abs=1e-8)


@pytest.mark.parametrize("extra", [{}, {"drain_per_speed": 0.1, "drain_per_speed_squared": 0.5}])
def test_world_charges_inside_its_break_even_radius_and_not_outside(extra):
    config = SurveillanceConfig(dtype="float64", **extra)
    drain = 0.06 + (0.1 * 0.2 + 0.5 * 0.04 if extra else 0)
    radius = config.break_even_radius
    assert config.charge_rate * field_at(radius) == pytest.approx(drain, abs=1e-12)
    assert config.charge_rate * field_at(radius - 1e-3) > drain
    assert config.charge_rate * field_at(radius + 1e-3) < drain


def test_power_counts_every_term():
    speed = torch.tensor([0.0, 0.5, 2.0], dtype=torch.float64)
    got = power(speed, drain_rate=0.1, per_speed=0.3, per_speed_squared=0.7)
    np.testing.assert_allclose(got.numpy(), [0.1, 0.1 + 0.15 + 0.175, 0.1 + 0.6 + 2.8], atol=1e-15)
    assert torch.equal(power(speed, drain_rate=0.1), torch.full((3,), 0.1, dtype=torch.float64))


def test_charge_is_one_euler_step():
    rng = np.random.default_rng(3)
    energy, field, current, drain = rng.uniform(0, 1, (4, 50))
    args = [torch.tensor(x) for x in (energy, field, current, drain)]
    got = charge(*args, charge_rate=0.4, dt=0.3).numpy()
    expected = [e + 0.3 * 0.4 * f * c - 0.3 * p for e, f, c, p in zip(energy, field, current, drain, strict=True)]
    np.testing.assert_allclose(got, expected, atol=1e-15)


def test_charge_never_saturates():
    one = torch.ones(1, dtype=torch.float64)
    full = SurveillanceConfig().energy_max * one
    above = charge(full, one, one, 0.06 * one, charge_rate=0.36, dt=0.2)
    assert float(above) == pytest.approx(1.06, abs=1e-14)
    for _ in range(100):
        above = charge(above, one, one, 0.06 * one, charge_rate=0.36, dt=0.2)
    assert float(above) == pytest.approx(7.06, abs=1e-12)
    below = charge(0.01 * one, 0 * one, one, 0.06 * one, charge_rate=0.36, dt=0.5)
    assert float(below) == pytest.approx(-0.02, abs=1e-15)


@pytest.mark.parametrize(("current", "accepted"), [(-0.5, 0.0), (0.25, 0.25), (1.0, 1.0), (7.0, 1.0)])
def test_current_is_cut_to_the_unit_interval(current, accepted):
    one = torch.ones(1, dtype=torch.float64)
    got = charge(0.5 * one, 0.8 * one, current * one, 0.1 * one, charge_rate=0.4, dt=0.5)
    assert float(got) == pytest.approx(0.5 + 0.5 * (0.32 * accepted - 0.1), abs=1e-15)
