"""What training counts, and when it stops itself."""

import pytest
import torch
from tensordict import TensorDict

from agents.divergence import WATCHED, DivergedError, check_batch, check_finite, check_weights
from agents.recorder import BatchCounter, Every, Seconds, TrainingRecorder
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


def counted_batch():
    """One world, two robots, two steps, of which the last ends the episode; nothing is wrong."""
    zeros, vectors = torch.zeros(1, 2, 2), torch.zeros(1, 2, 2, 2)
    flags = {kind: torch.zeros(1, 2, 2, 1, dtype=torch.bool) for kind in keys.VIOLATION_KINDS}
    return TensorDict(
        {
            **{key: vectors.clone() for key in WATCHED.values()},
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


class Look:
    """Whether a batch is to be looked at, after it is counted."""

    def __init__(self, world, counter):
        self.counter, self.recorder = counter, TrainingRecorder(world, 1, None)

    def __call__(self, batch):
        return self.recorder.update(*self.counter(batch))


def test_a_batch_with_something_wrong_is_to_be_looked_at():
    world = SurveillanceConfig(n_agents=2)
    look = Look(world, BatchCounter(world))
    assert not look(counted_batch())
    for key in [keys.OUTSIDE, *(("next", *keys.VIOLATION, kind) for kind in keys.VIOLATION_KINDS)]:
        batch = counted_batch()
        batch[key][0, 1, 0] = True
        assert look(batch), key
    for key in WATCHED.values():
        for bad in (float("nan"), float("inf"), -float("inf")):
            batch = counted_batch()
            batch[key][0, 0, 1] = bad
            assert look(batch), key
    assert not look(counted_batch())


def test_several_learners_are_counted_as_each_alone():
    world, batches = SurveillanceConfig(n_agents=2), [counted_batch() for _ in range(3)]
    for k, batch in enumerate(batches):
        batch["next", keys.COVERAGE_COST] += k
        batch[keys.OUTSIDE][0, : k % 3, 0] = True
        batch["next", *keys.VIOLATION, "collision"][0, :k] = True
    together = BatchCounter(world, 3)(torch.cat(batches))
    for counted, batch in zip(together, batches, strict=True):
        (alone,) = BatchCounter(world)(batch)
        assert counted.sums == alone.sums
        for name in ("violating", "reward", "done"):
            assert torch.equal(getattr(counted, name), getattr(alone, name))
        assert (counted.batch == batch).all()
    assert [counted.sums["collision"] for counted in together] == [0, 2, 4]


def test_a_robot_that_violates_twice_in_one_step_is_one_violating_robot_step():
    world = SurveillanceConfig(n_agents=2)
    recorder, batch = TrainingRecorder(world, 1, None), counted_batch()
    flags = {kind: batch[("next", *keys.VIOLATION, kind)] for kind in keys.VIOLATION_KINDS}
    flags["depleted"][0, 1, 0] = flags["stranded"][0, 1, 0] = True  # robot 0 at the second step, twice at once
    flags["collision"][0, 1] = True  # and both robots collide
    recorder.update(*BatchCounter(world)(batch))
    assert recorder.violations == {"depleted": 1, "stranded": 1, "overcharged": 0, "collision": 2}
    assert recorder.episodes.finished == {"return": [-1.0], "violations": [2.0]}
    assert recorder.summary()["frames"] == 2
    restored = TrainingRecorder(world, 1, None)
    restored.load_state_dict(recorder.state_dict())
    assert restored.summary() == recorder.summary()
    scalars = restored.scalars()
    assert scalars == recorder.scalars()
    assert scalars["train/violation_rate_depleted"] == 1 / 4  # two steps of two robots
    assert scalars["train/violation_rate_collision"] == 2 / 4
    again = recorder.scalars()  # a new interval
    assert again["train/violation_rate_collision"] == 0
    assert again["train/violations_collision"] == 2


def test_the_best_evaluation_is_known():
    recorder = TrainingRecorder(SurveillanceConfig(), 1, None)
    costs = [0.5, 0.3, None, 0.4, 0.3, 0.2]
    assert [recorder.evaluated({"coverage_cost": cost}) for cost in costs] == [True, True, False, False, False, True]
    assert recorder.evaluation == {"coverage_cost": 0.2}


def batch_of(**changes):
    ones = torch.ones(2, 3, 3, 2)
    batch = {key: ones.clone() for key in WATCHED.values()}
    return TensorDict(batch | {WATCHED[name.replace("_", " ")]: value for name, value in changes.items()}, (2, 3))


def test_numbers_that_are_not_finite_are_named():
    check_batch(batch_of(), 0)
    for name in WATCHED:
        for bad in (float("nan"), float("inf"), -float("inf")):
            value = torch.ones(2, 3, 3, 2)
            value[1, 2, 0, 1] = bad
            with pytest.raises(DivergedError, match=rf"frame 9: {name} not finite\. The last checkpoint is kept"):
                check_batch(batch_of(**{name.replace(" ", "_"): value}), 9)


def test_weights_that_are_not_finite_are_named():
    net = torch.nn.Linear(2, 2)
    check_weights(net, 0)
    with torch.no_grad():
        net.bias[1] = float("nan")
    with pytest.raises(DivergedError, match="frame 3: weights bias not finite"):
        check_weights(net, 3)


def test_time_is_split():
    seconds = Seconds("collect", "update")
    outer, inner = torch.nn.Sequential(torch.nn.Identity()), torch.nn.Identity()
    outer.append(inner)
    seconds.watch("policy", outer)
    seconds.watch("filter", inner)
    outer(torch.zeros(1))
    seconds.spent("collect")
    inner(torch.zeros(1))
    seconds.spent("update")  # calls outside of collection do not count
    assert 0 < seconds.inside["filter"] < seconds.inside["policy"] < seconds.totals["collect"]
    assert seconds.total() == seconds.totals["collect"] + seconds.totals["update"]
    scalars = seconds.scalars(100)
    parts = [scalars[f"time/{name}_s"] for name in ("filter", "inference", "env")]
    assert sum(parts) == pytest.approx(scalars["time/collect_s"])
    assert scalars["time/frames_per_second_filter"] == pytest.approx(100 / parts[0])
    other = Seconds("collect", "update", "checkpoint")
    other.watch("filter", inner)
    other.load_state_dict(seconds.state_dict())
    assert other.totals == seconds.totals | {"checkpoint": 0.0}
    assert other.inside == {"filter": seconds.inside["filter"]}
