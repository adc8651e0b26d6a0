"""The speed limit is the identity inside the ball and a projection onto it outside; the integrator is exact."""

from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.dynamics import FULL_SPEED, integrate, limit_speed, other_indices, pair_indices
from safety.speed_faces import BALL

DTYPES = (torch.float32, torch.float64)


def random_velocity(*shape, scale, dtype, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(*shape, generator=generator, dtype=dtype)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES)
def test_speeds_inside_the_ball_stay_bit_for_bit(d, dtype):
    velocity = random_velocity(500, 4, d, scale=0.05, dtype=dtype)
    velocity = velocity[(velocity.norm(dim=-1) < 0.2).all(dim=-1)]
    velocity[0, 0] = 0
    velocity[0, 1] = torch.eye(d, dtype=dtype)[0] * 0.2  # exactly on the sphere
    assert len(velocity) > 100
    assert torch.equal(limit_speed(velocity, 0.2), velocity)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES)
def test_speeds_outside_land_on_the_sphere_in_the_same_direction(d, dtype):
    velocity = random_velocity(500, 4, d, scale=3.0, dtype=dtype)
    reference = velocity.double().numpy()
    speed = np.sqrt((reference**2).sum(-1, keepdims=True))
    expected = np.where(speed > 0.2, 0.2 * reference / speed, reference)
    assert (speed > 0.2).mean() > 0.9
    got = limit_speed(velocity, 0.2)
    assert got.dtype == dtype
    np.testing.assert_allclose(got.double().numpy(), expected, rtol=2e-6, atol=0)  # cut a hair below the limit


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("limit", [0.05, 0.2, 0.37, 1.0, 5.0])
def test_no_speed_is_above_the_limit_whoever_looks_and_no_cut_is_a_correction(d, dtype, limit):
    velocity = random_velocity(100_000, 2, d, scale=1.0, dtype=dtype)
    size = velocity.norm(dim=-1, keepdim=True)
    near = torch.linspace(1 - 2e-6, 1 + 2e-6, len(velocity), dtype=dtype).reshape(-1, 1)
    velocity[:, 1] *= limit * near / size[:, 1]  # at the limit
    velocity[:, 0] *= (limit / size[:, 0]).clamp_min(1) * 1.1  # far beyond it
    got = limit_speed(velocity, limit, FULL_SPEED)
    x, y = got.numpy()[..., 0], got.numpy()[..., 1:]
    for speed in (
        got.norm(dim=-1),
        (got * got).sum(-1).sqrt(),
        (got.flip(-1) ** 2).cumsum(-1)[..., -1].sqrt(),
        torch.from_numpy(np.hypot(x, np.linalg.norm(y, axis=-1))),
    ):
        assert (speed <= torch.tensor(limit, dtype=dtype)).all()
    assert (got.double().norm(dim=-1) <= limit * BALL).all()  # the programs' own limit
    exact = velocity.double() * (limit / velocity.double().norm(dim=-1, keepdim=True)).clamp_max(1)
    assert ((got.double() - exact).norm(dim=-1) <= 1e-6 * limit).all()
    assert torch.equal(limit_speed(got, limit, FULL_SPEED), got)
    changed = (got != velocity).any(-1)
    assert changed[:, 0].all()
    assert changed[:, 1].any()
    assert not changed[:, 1].all()


def test_one_fast_robot_does_not_touch_the_others():
    velocity = torch.tensor([[[0.1, 0.0], [3.0, -4.0], [0.0, -0.2]]])
    got = limit_speed(velocity, 0.2)
    assert torch.equal(got[:, [0, 2]], velocity[:, [0, 2]])
    assert torch.allclose(got[0, 1], torch.tensor([0.12, -0.16]))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dtype", DTYPES)
def test_limit_is_idempotent_bit_for_bit(d, dtype):
    velocity = random_velocity(20_000, 2, d, scale=0.3, dtype=dtype, seed=1)
    once = limit_speed(velocity, 0.2)
    assert not torch.equal(once, velocity)
    assert torch.equal(limit_speed(once, 0.2), once)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3),
    st.floats(1e-3, 100.0),
)
def test_limit_never_exceeds_the_ball(row, max_speed):
    velocity = torch.tensor(row, dtype=torch.float64).reshape(1, 1, 3)
    got = limit_speed(velocity, max_speed)
    assert float(got.norm()) <= max_speed * (1 + 1e-15)
    assert float((got * velocity).sum()) >= 0


def test_not_a_number_is_not_hidden():
    got = limit_speed(torch.tensor([[[float("nan"), 0.0], [1.0, 0.0]]]), 0.2)
    assert got[0, 0].isnan().any()
    assert torch.allclose(got[0, 1], torch.tensor([0.2, 0.0]))


@pytest.mark.parametrize("d", [2, 3])
def test_integrator_is_exact_under_a_held_input(d):
    generator = torch.Generator().manual_seed(2)
    position = torch.rand(5, 3, d, generator=generator, dtype=torch.float64)
    velocity = torch.rand(5, 3, d, generator=generator, dtype=torch.float64) - 0.5
    state = position
    for _ in range(40):
        state = integrate(state, velocity, 0.05)
    np.testing.assert_allclose(state.numpy(), position.numpy() + 2.0 * velocity.numpy(), atol=1e-13)


@pytest.mark.parametrize("n", range(1, 8))
def test_pairs_come_in_the_order_of_combinations(n):
    i, j = pair_indices(n)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == list(combinations(range(n), 2))


def test_constants_made_in_inference_mode_serve_autograd():
    for make in (other_indices, pair_indices):
        with torch.inference_mode():
            index = make(41)  # a number that nobody asked for before
        index = index if isinstance(index, torch.Tensor) else index[0]
        x = torch.ones(41, requires_grad=True)
        (x[index] * 2).sum().backward()
        assert x.grad is not None
