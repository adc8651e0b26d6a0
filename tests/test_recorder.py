"""What training counts, and when it stops itself."""

import pytest
import torch
from tensordict import TensorDict

from agents.maddpg import DivergedError, check_finite
from agents.recorder import Every, TrainingRecorder
from envs import SurveillanceConfig, keys


def test_every_is_due_once_per_interval_and_never_for_zero():
    every = Every(10)
    assert [count for count in range(0, 41, 4) if every(count)] == [12, 20, 32, 40]
    jump = Every(10)
    assert [jump(35), jump(39), jump(40)] == [True, False, True]
    assert not any(Every(0)(count) for count in range(100))


def test_divergence_is_named():
    check_finite({"actor": 1.0}, 5)
    with pytest.raises(DivergedError, match=r"frame 7: value, q_value not finite.*actor_lr"):
        check_finite({"actor": 1.0, "value": float("nan"), "q_value": float("inf")}, 7)


def test_a_robot_that_violates_twice_in_one_step_is_one_violating_robot_step():
    world = SurveillanceConfig(n_agents=2)
    recorder = TrainingRecorder(world, 1, None)
    flags = {kind: torch.zeros(1, 2, 2, 1, dtype=torch.bool) for kind in keys.VIOLATION_KINDS}
    flags["depleted"][0, 1, 0] = flags["stranded"][0, 1, 0] = True  # robot 0 at the second step, twice at once
    flags["collision"][0, 1] = True  # and both robots collide
    zeros = torch.zeros(1, 2, 2)
    batch = TensorDict(
        {
            ("next", *keys.REWARD): torch.full((1, 2, 2, 1), -0.5),
            ("next", "done"): torch.tensor([[[False], [True]]]),
            ("next", keys.COVERAGE_COST): torch.full((1, 2, 1), 0.3),
            **{("next", *keys.VIOLATION, kind): flag for kind, flag in flags.items()},
            **{key: zeros.long() for key in (keys.STATUS, keys.LEVEL)},
            **{key: zeros.unsqueeze(-1) for key in (keys.CORRECTION, keys.RESIDUAL)},
            keys.OUTSIDE: zeros.bool(),
        },
        (1, 2),
    )
    recorder.update(batch)
    assert recorder.violations == {"depleted": 1, "stranded": 1, "overcharged": 0, "collision": 2}
    assert recorder.episodes.finished == {"return": [-1.0], "violations": [2.0]}
    assert recorder.summary()["frames"] == 2
    restored = TrainingRecorder(world, 1, None)
    restored.load_state_dict(recorder.state_dict())
    assert restored.summary() == recorder.summary()
