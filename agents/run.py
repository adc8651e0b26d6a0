"""The run of one seed: its replay buffer, counters, curves and checkpoints; several share a program (:mod:`agents.seeds`)."""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from agents.board import Board
from agents.checkpoint import CheckpointError
from agents.collection import Block, WorkerBlock, seeds_of_streams
from agents.divergence import DivergedError, check_batch, check_finite, check_weights
from agents.evaluation import Evaluation, evaluation_scalars
from agents.incident import ViolationError, check_violations
from agents.learners import Learner
from agents.noise import ExplorationNoise
from agents.pipeline import WaitingSteps
from agents.recorder import Counted, Every, Seconds, TrainingRecorder
from agents.replay import ReplayOfLearner
from agents.training_config import Config
from agents.training_state import TrainingState, check_frames
from envs.rendering import save_training_curve

FAILURES = (CheckpointError, DivergedError, ViolationError, OSError)
"""What ends one seed's run and not the others' of its program."""


class TrainingRun:
    """One seed's run in its folder.

    Args:
        folder: where it writes.
        config: the configuration; the seed is this run's.
        seed: its seed.
        origin: where it comes from, for summary and checkpoints, "config" and "world" aside.
        settings: the hashed configuration, nested.
        learner: its networks and optimisers.
        worlds: its worlds.
        waiting: its steps that wait for n-step transitions.
        noise: its exploration noise.
        buffer: its part of the replay, empty.
        sizes: of the networks, by :func:`agents.checkpoint.world_sizes`.
        device: of the counters.
        seconds: where the program's time goes.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        seed: int,
        origin: dict,
        settings: dict,
        *,
        learner: Learner,
        worlds: Block,
        waiting: WaitingSteps,
        noise: ExplorationNoise,
        buffer: ReplayOfLearner,
        sizes: dict,
        device: torch.device,
        seconds: Seconds,
    ) -> None:
        self.folder, self.config, self.seed, self.origin, self.settings = folder, config, seed, origin, settings
        self.worlds, self.learner, self.noise, self.buffer = worlds, learner, noise, buffer
        self.error: Exception | None = None
        """What ended the run before its time, where it shares its program with others."""
        *_, self.eval_seed = seeds_of_streams(seed)
        self.recorder = TrainingRecorder(config.env, config.collector.num_envs, device)
        self.clocks = {
            "log": Every(max(1, config.collector.total_frames // config.log.points)),
            "evaluate": Every(config.eval.interval_frames),
            "save_frames": Every(config.checkpoint.interval_frames),
            "save_episodes": Every(config.checkpoint.interval_episodes),
        }
        parts = {"actor": learner.actor, "loss": learner.loss, "optimizers": learner.optimizers, "env": worlds}
        parts |= {"noise": noise, "multi_step": waiting, "recorder": self.recorder, "clocks": self.clocks}
        parts |= {"seconds": seconds}
        made_for = {"config": settings, "world": sizes}
        keep, with_buffer = config.checkpoint.keep, config.checkpoint.buffer
        self.state = TrainingState(folder, parts, buffer, origin | made_for, keep=keep, with_buffer=with_buffer)
        self.check = functools.partial(check_violations, world=config.env, safety=config.safety, folder=folder)
        self.learns_from = config.train.warmup_frames
        self.progress = ""
        """What the progress bar shows."""

    def begin(self, tell: Callable[[str], None], latest: int | None) -> None:
        """Go on from a checkpoint if there is one (see :meth:`TrainingState.resume`), and open the curves.

        Args:
            tell: shows a line to the user.
            latest: frames at which the program's runs begin together, -1 for the start; None for a run alone.

        Raises:
            CheckpointError: if it has no checkpoint of just these frames.
        """
        kept_rows = self.state.resume(self.config.resume, tell, latest)
        if latest is not None and self.recorder.frames != max(latest, 0):
            raise CheckpointError(
                f"seed {self.seed}: its checkpoint of {latest} frames is gone. Start the program again."
            )
        check_frames(self.config.resume, self.recorder.frames, self.config.collector.total_frames)
        self.learns_from += 0 if kept_rows else self.recorder.frames
        log, settings = self.config.log, self.settings | {"seed": self.seed}
        self.board = Board(self.folder, self.recorder.frames, settings, figures=log.figures, gif=log.gif)

    def take_evaluation(self, found: Evaluation) -> None:
        """Log what came of the policy's rollout; the best policy so far is kept."""
        self.board.point(evaluation_scalars(found.metrics), self.recorder.frames)
        self.board.world(found.trajectory, self.recorder.frames)
        if self.recorder.evaluated(found.metrics | {"filter": found.statistics}):
            self.state.save_best()

    def take(self, counted: Counted) -> None:
        """Take in what was found in a collected batch, and check it.

        Raises:
            DivergedError: if an observation, action or reward is not finite.
            ViolationError: at a violation behind the certified filter.
        """
        if self.recorder.update(counted):
            self.check(counted.batch)
            check_batch(counted.batch, self.recorder.frames)

    @property
    def learns(self) -> bool:
        """Whether warm-up is over with the batch that is stored, and not yet taken in (and the run has not failed)."""
        frames = self.recorder.frames + self.config.collector.frames_per_batch
        return self.error is None and frames >= self.learns_from and len(self.buffer) > 0

    def log(self, reward: float, losses: dict[str, float], energy: Tensor, seconds: Seconds) -> None:
        """Add a point to the curves.

        Args:
            reward: mean of the batch, of the objective.
            losses: of :func:`agents.maddpg.update_step`.
            energy: of the batch's robots, of any shape.
            seconds: where the program's time went.

        Raises:
            DivergedError: if a loss is not finite.
        """
        frames = self.recorder.frames
        check_finite(losses, frames)
        scalars = self.recorder.scalars() | {"train/noise": self.noise.sigma, "train/reward": reward}
        scalars |= {f"loss/{name}": value for name, value in losses.items()}
        histograms = {"train/energy": energy} if self.config.log.histograms else {}
        self.board.point(scalars | seconds.scalars(frames), frames, histograms)
        self.progress = self.recorder.progress(scalars)

    @property
    def logs(self) -> bool:
        """Whether a point of the curves is due; asking starts the next interval."""
        return self.clocks["log"](self.recorder.frames)

    @property
    def ends(self) -> bool:
        """Whether the last frame is collected."""
        return self.recorder.frames == self.config.collector.total_frames

    @property
    def evaluates(self) -> bool:
        """Whether an evaluation is due, at the interval of ``eval`` and at the end; asking starts the next interval."""
        return self.clocks["evaluate"](self.recorder.frames) | self.ends

    @property
    def saves(self) -> bool:
        """Whether a checkpoint is due; asking starts the next interval."""
        frames, episodes = self.recorder.frames, self.recorder.episodes.episodes
        return self.clocks["save_frames"](frames) | self.clocks["save_episodes"](episodes) | self.ends

    def save(self) -> None:
        """Write a checkpoint.

        Raises:
            DivergedError: if a weight is not finite; the earlier checkpoints are kept.
        """
        check_weights(self.learner.loss, self.recorder.frames)
        self.board.flush()  # what it has logged is on disk before the checkpoint that says so
        self.state.save(ended=self.ends)

    def tidy(self) -> None:
        """Delete the checkpoints that are no longer kept."""
        self.state.tidy()

    def conclude(self) -> None:
        """Draw the training curve and delete the replay files."""
        curves = {name: np.array(values) for name, values in self.recorder.episodes.finished.items()}
        save_training_curve(curves, self.folder / "figures" / "training.png")
        self.state.finish()
        self.board.close()

    def summary(self, seconds: Seconds, n_seeds: int) -> dict:
        """The content of summary.json; the time is that of the program, which trained ``n_seeds`` runs."""
        wall_time, frames = seconds.total(), self.recorder.frames
        speed = {"wall_time_s": wall_time, "frames_per_second": frames / wall_time, "time": seconds.totals}
        speed |= {"n_seeds": n_seeds} if n_seeds > 1 else {}
        speed |= {"workers_lost": self.worlds.lost} if isinstance(self.worlds, WorkerBlock) else {}
        kept = {"checkpoint": {"buffer": self.config.checkpoint.buffer}, "updates": self.learner.n_updates}
        return self.origin | self.recorder.summary() | speed | kept | {"eval": self.recorder.evaluation}
