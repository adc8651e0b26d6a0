"""The runs of a program's seeds, which share collector, updates and evaluations."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from agents.evaluation import Evaluator, rollout_steps
from agents.incident import broken_promises
from agents.recorder import Seconds
from agents.replay import Replay
from agents.run import FAILURES, TrainingRun
from agents.training_state import valid_ages
from envs import keys

MOST_AT_ONCE = 16
"""Minibatches that are drawn at a time."""


class SeedsFailedError(RuntimeError):
    """Some seeds of a program failed; the message names them and quotes the first error.

    Args:
        errors: what ended each, by seed.
        others: number of the seeds that did not fail.
    """

    def __init__(self, errors: dict[int, str], others: int) -> None:
        super().__init__(errors, others)  # all arguments: the error of a run in another process is pickled
        self.errors, self.others = errors, others

    def __str__(self) -> str:
        """The message."""
        seeds = ", ".join(map(str, self.errors))
        first, error = next(iter(self.errors.items()))
        return f"{len(self.errors)} of {len(self.errors) + self.others} seeds failed: {seeds}.\nseed {first}: {error}"


def equally_far(
    folders: Mapping[int, Path], resume: str, tell: Callable[[str], None], *, rows: bool
) -> list[tuple[int, dict[int, Path]]]:
    """Seeds that can be trained as one batch, because all have a valid checkpoint of the same frames and updates, or none.

    A program that was killed between its seeds' checkpoints goes on where all of them have one; seeds with another history
    (of single runs, or one that failed) form groups of their own.

    Args:
        folders: the folder of each seed's run.
        resume: ``auto``; anything else does not look for checkpoints.
        tell: shows a line for each damaged checkpoint.
        rows: replay rows are needed too.

    Returns:
        Frames to go on from and folders by seed, the largest group first.
    """
    if len(folders) == 1 or resume != "auto":
        return [(0, dict(folders))]
    ages = {seed: valid_ages(folder / "checkpoints", tell, rows=rows) or {(0, 0)} for seed, folder in folders.items()}
    groups = []
    while ages:
        counts = Counter(age for own in ages.values() for age in own)
        age = max(counts, key=lambda age: (counts[age], age))
        group = [seed for seed, own in ages.items() if age in own]
        groups.append((age[0], {seed: folders[seed] for seed in group}))
        ages = {seed: own for seed, own in ages.items() if seed not in group}
    return groups


def for_each(runs: Sequence[TrainingRun], act: Callable[..., object], *arguments: Sequence) -> None:
    """Call ``act(run, argument, ..)`` for every run that has not failed; one that fails does not end the others.

    Args:
        runs: the program's runs.
        act: what to do.
        arguments: lists with an entry per run.

    Raises:
        Exception: what ``act`` raises, where there is no other run to go on with.
    """
    for run, *own in zip(runs, *arguments, strict=True):
        if run.error is not None:
            continue
        try:
            act(run, *own)
        except FAILURES as error:
            if len(runs) == 1:
                raise
            run.error = error
            run.board.close()
    if all(run.error is not None for run in runs):
        check_seeds(runs)


def evaluate(runs: Sequence[TrainingRun], evaluator: Evaluator, policy: TensorDictSequential) -> None:
    """Measure the policies of all runs as one batch, each from its own start states, the same every time.

    Args:
        runs: the program's runs.
        evaluator: with a block of worlds for each.
        policy: the deployment policy of all learners.
    """
    config = runs[0].config

    def check(td: TensorDictBase, alive: Tensor) -> None:
        if config.safety.mode != "certified":
            return
        flags = broken_promises(td, alive).chunk(len(runs))
        if torch.stack([own.any() for run, own in zip(runs, flags, strict=True) if run.error is None]).any():
            for_each(runs, lambda run, *own: run.check(*own), td.chunk(len(runs)), alive.chunk(len(runs)))

    found = evaluator(
        policy,
        config.eval.steps or rollout_steps(config.env.horizon),
        seeds=[run.eval_seed for run in runs],
        record=runs[0].board.records,
        check=check,
    )
    for_each(runs, TrainingRun.take_evaluation, found)


def log(runs: Sequence[TrainingRun], following: TensorDictBase, losses: Mapping[str, Tensor], seconds: Seconds) -> None:
    """Add a point to the curves of all runs if one is due; their numbers are read at once.

    Args:
        runs: the program's runs.
        following: "next" of the batch's transitions with the rewards of the objective, ``(n_runs * num_envs, T)``.
        losses: of :func:`agents.maddpg.update_step`, of all learners.
        seconds: where the program's time went.
    """
    due = [run.logs for run in runs]
    if not any(due):
        return
    means = torch.stack([own.mean() for own in following[keys.REWARD].chunk(len(runs))])
    values = [value.double().expand(len(runs)) for value in losses.values()]
    reward, *rest = torch.stack([means.double(), *values]).tolist()
    numbers = [dict(zip(losses, own, strict=True)) for own in zip(*rest, strict=True)] or [{} for _ in runs]
    energy = following[keys.ENERGY].cpu().chunk(len(runs))
    for_each(runs, TrainingRun.log, reward, numbers, energy, [seconds] * len(runs))


def stopped_at(runs: Sequence[TrainingRun]) -> str:
    """How far a program is that was asked to stop, and where its checkpoints are, for the message."""
    good = [run for run in runs if run.error is None]
    where = good[0].folder if len(good) == 1 else f"the folders of {len(good)} seeds"
    lost = "".join(f"; seed {run.seed} had failed: {run.error}" for run in runs if run.error is not None)
    return f"at {good[0].recorder.frames} frames, checkpoint written in {where}{lost}"


def minibatches(replay: Replay, count: int, batch_size: int, reads: Sequence[NestedKey]) -> Iterator[TensorDictBase]:
    """Transitions for so many updates: ``(batch_size,)`` each of the only run, ``(K, batch_size)`` of several.

    Many are drawn as one: the same as one after the other, in less time.
    """
    for first in range(0, count, MOST_AT_ONCE):
        some = min(MOST_AT_ONCE, count - first)
        yield from replay.draw(some * batch_size, reads).split(batch_size, dim=-1)


def errors_by_seed(error: Exception, seeds: Iterable[int]) -> dict[int, str]:
    """What ended each seed of a program that ``error`` has ended."""
    return error.errors if isinstance(error, SeedsFailedError) else {seed: str(error) for seed in seeds}


def check_seeds(runs: Sequence[TrainingRun]) -> None:
    """Raise a :class:`SeedsFailedError` if a run failed."""
    if failed := {run.seed: run.error for run in runs if run.error is not None}:
        raise SeedsFailedError({seed: str(error) for seed, error in failed.items()}, len(runs) - len(failed))
