"""Filter statistics against a loop over robot-steps."""

import pytest
import torch
from tensordict import TensorDict

from envs import keys
from safety.statistics import FilterStatistics, filter_numbers

torch.set_num_threads(1)
SPEED = 0.2
ZERO = {
    "intervention_rate": 0.0,
    "mean_correction": 0.0,
    "fallback_rate": 0.0,
    "homing_rate": 0.0,
    "infeasible": 0,
    "inaccurate": 0,
    "outside": 0,
    "max_residual": 0.0,
}


def diagnostics(seed, *batch):
    gen = torch.Generator().manual_seed(seed)

    def real(low, high):
        return low + (high - low) * torch.rand(*batch, 3, 1, generator=gen)

    touched = torch.rand(*batch, 3, 1, generator=gen) < 0.3
    return TensorDict(
        {
            keys.CORRECTION: torch.where(touched, real(0, 0.1), 1e-7 * SPEED),  # below the threshold where not touched
            keys.STATUS: torch.randint(0, 3, (*batch, 3), generator=gen),
            keys.LEVEL: torch.randint(0, 3, (*batch, 3), generator=gen),
            keys.RESIDUAL: real(0, 1e-6),
            keys.OUTSIDE: torch.rand(*batch, 3, generator=gen) < 0.4,
        },
        batch,
    )


def by_hand(parts):
    """Loop over (diagnostics, alive) pairs with batch (B,)."""
    steps = moved = fallen = infeasible = inaccurate = outside = homing = 0
    correction, residual = 0.0, 0.0
    for td, alive in parts:
        for b in range(td.shape[0]):
            for i in range(3):
                if not alive[b]:
                    continue
                steps += 1
                amount = td[keys.CORRECTION][b, i, 0].item()
                status = td[keys.STATUS][b, i].item()
                moved += amount > 1e-6 * SPEED
                correction += amount
                fallen += td[keys.LEVEL][b, i].item() > 0
                infeasible += status == 2
                inaccurate += status == 1
                outside += td[keys.OUTSIDE][b, i].item()
                homing += td[keys.LEVEL][b, i].item() == 2
                if status == 0:
                    residual = max(residual, td[keys.RESIDUAL][b, i, 0].item())
    return {
        "intervention_rate": moved / steps,
        "mean_correction": correction / steps,
        "fallback_rate": fallen / steps,
        "homing_rate": homing / steps,
        "infeasible": infeasible,
        "inaccurate": inaccurate,
        "outside": outside,
        "max_residual": residual,
    }


def add(statistics, td, alive=None):
    statistics.add({name: value.item() for name, value in filter_numbers(td, SPEED, alive).items()})


def test_sums_over_several_updates():
    parts = [(diagnostics(seed, 7), torch.ones(7, dtype=torch.bool)) for seed in range(4)]
    statistics = FilterStatistics()
    for td, _ in parts:
        add(statistics, td)
    assert statistics.summary() == pytest.approx(by_hand(parts), rel=1e-6)
    assert statistics.sums["robot_steps"] == 4 * 7 * 3


def test_only_living_worlds_count():
    alive = torch.tensor([True, False, True, False, False, True, True])
    parts = [(diagnostics(seed, 7), alive.roll(seed)) for seed in range(3)]
    statistics = FilterStatistics()
    for td, living in parts:
        add(statistics, td, living[:, None])
    expected = by_hand(parts)
    assert statistics.summary() == pytest.approx(expected, rel=1e-6)
    assert statistics.sums["robot_steps"] == 3 * 4 * 3
    everything = FilterStatistics()
    for td, _ in parts:
        add(everything, td)
    assert everything.summary()["infeasible"] > expected["infeasible"]


def test_batches_of_any_shape_are_the_same():
    td = diagnostics(0, 6, 5)
    whole, parts = FilterStatistics(), FilterStatistics()
    add(whole, td)
    for k in range(5):
        add(parts, td[:, k])
    assert whole.summary() == pytest.approx(parts.summary())


def test_nothing_counted_is_zero():
    assert FilterStatistics().summary() == ZERO
    statistics = FilterStatistics()
    add(statistics, diagnostics(0, 4), torch.zeros(4, 1, dtype=torch.bool))
    assert statistics.summary() == ZERO
