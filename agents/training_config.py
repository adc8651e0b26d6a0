"""Typed configuration of a training run and its checks."""

import importlib.util
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.adversary_reward import BARRIERS, AdversaryReward
from agents.config import AgentConfig
from agents.maddpg import check_loss
from agents.pipeline import pick_device
from envs import SurveillanceConfig
from envs.config import check_choice, check_range
from safety import SafetyConfig

DEVICES = ("auto", "cpu", "cuda")
MOST_SEEDS = 1000
NOT_HASHED = (
    *(
        "seed",
        "seeds",
        "n_seeds",
        "device",
        "threads",
        "deterministic",
        "resume",
        "debug",
        "checkpoint",
        "log",
        "hydra",
    ),
    *("folder", "video", "format", "samples"),  # of evaluate.py's pictures and report.py
)
"""Settings that do not change what is computed by a run of a given seed."""


@dataclass
class CollectorConfig:
    """Collection of transitions. Frames are world-steps."""

    num_envs: int = 250
    """Worlds stepped in parallel, 1..1e6."""
    steps_per_batch: int = 1
    """Vector steps between updates, 1..1e5."""
    total_frames: int = 1_000_000
    """World-steps of the whole run; a multiple of num_envs * steps_per_batch."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_range("collector.num_envs", self.num_envs, 1, 10**6)
        check_range("collector.steps_per_batch", self.steps_per_batch, 1, 10**5)
        check_range("collector.total_frames", self.total_frames, 1, 10**13)
        if self.total_frames % self.frames_per_batch:
            nearest = max(1, round(self.total_frames / self.frames_per_batch)) * self.frames_per_batch
            raise ValueError(
                f"collector.total_frames={self.total_frames} is not a multiple of num_envs * steps_per_batch = "
                f"{self.frames_per_batch}: the nearest that is, is {nearest}."
            )

    @property
    def frames_per_batch(self) -> int:
        """World-steps per collected batch."""
        return self.num_envs * self.steps_per_batch


@dataclass
class WorkersConfig:
    """Processes that collect beside the learner, on this machine or a Ray cluster."""

    count: int = 0
    """Workers, 0..1000; 0 = the learner collects itself. Each steps its part of the collector.num_envs worlds of every seed,
    with random streams of its own: another number gives other results. One that dies is started anew and repeats the batch."""
    overlap: bool = True
    """Collect the next batch while the learner updates, with the policy of one batch before; false: one after the other."""
    backend: str = "processes"
    """processes: of this machine. ray: actors of a Ray cluster (needs the extra ray)."""
    ray_address: str | None = None
    """Of a running Ray cluster, auto or <host>:<port>; null = start one on this machine."""
    gpus: float = 0.0
    """ray: share of a GPU for each worker, 0..1; 0 = the workers compute on CPUs."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_range("workers.count", self.count, 0, 1000)
        check_choice("workers.backend", self.backend, ("processes", "ray"))
        check_range("workers.gpus", self.gpus, 0, 1)
        if self.backend == "ray" and importlib.util.find_spec("ray") is None:
            raise ValueError(
                "workers.backend=ray needs the package ray, which is not installed: pip install -c constraints-extras.txt -e "
                "'.[ray]', or take workers.backend=processes."
            )
        if self.backend != "ray" and (self.ray_address is not None or self.gpus):
            given = f"workers.gpus={self.gpus:g}" if self.gpus else f"workers.ray_address={self.ray_address}"
            raise ValueError(f"{given} is for workers.backend=ray: add that, or leave it out.")
        if self.ray_address is not None and not re.fullmatch(r"auto|(\[[^]]+\]|[^:/]+):\d+", self.ray_address):
            raise ValueError(
                f"workers.ray_address={self.ray_address} is no address of a Ray cluster: auto or <host>:<port>, such as "
                "10.0.0.1:6379; null starts one on this machine."
            )


@dataclass
class BufferConfig:
    """Replay buffer."""

    capacity: int = 500_000
    """Transitions kept, >= batch_size."""
    batch_size: int = 256
    """Transitions per minibatch, 1..1e6."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_range("buffer.batch_size", self.batch_size, 1, 10**6)
        check_range("buffer.capacity", self.capacity, self.batch_size, 10**10, hint="It holds at least one minibatch.")


@dataclass
class TrainConfig:
    """Updates."""

    n_updates: int = 4
    """Updates of all robots per collected batch, 0..1e6."""
    warmup_frames: int = 10_000
    """World-steps collected (noisy filtered policy) before the first update, >= 0."""
    violation_penalty: float = 0.0
    """Baseline only: subtracted from a robot's reward for each violation of its own, >= 0."""
    objective: str = "coverage"
    """coverage: the environment's reward. adversary: each robot is paid for small barriers (agents/adversary_reward.py)."""
    attack: list[str] = field(default_factory=lambda: ["survivability", "collision", "certificate"])
    """adversary: the barriers that count, of survivability, overcharge, collision, certificate (the last two for several
    robots, certificate behind the certified filter only)."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_range("train.n_updates", self.n_updates, 0, 10**6)
        check_range("train.warmup_frames", self.warmup_frames, 0, 10**12)
        check_range("train.violation_penalty", self.violation_penalty, 0, 1e9)
        check_choice("train.objective", self.objective, ("coverage", "adversary"))
        for name in self.attack:
            check_choice("train.attack", name, BARRIERS)
        if self.objective == "adversary" and self.violation_penalty:
            raise ValueError(
                f"train.violation_penalty={self.violation_penalty} punishes what train.objective=adversary is after: set one of "
                "them back (0, coverage)."
            )


@dataclass
class EvalConfig:
    """Deterministic evaluation."""

    interval_frames: int = 100_000
    """World-steps between evaluations during training, >= 0 (0 = only at the end)."""
    num_envs: int = 64
    """Worlds of a seed's evaluation, 1..1e6."""
    steps: int = 0
    """Length of an evaluation; 0 = the world's horizon (1000 where it has none)."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_range("eval.interval_frames", self.interval_frames, 0, 10**13)
        check_range("eval.num_envs", self.num_envs, 1, 10**6)
        check_range("eval.steps", self.steps, 0, 10**9)


@dataclass
class CheckpointConfig:
    """Checkpoints."""

    interval_episodes: int = 2_000
    """Episodes between checkpoints, >= 0 (0 = do not count episodes)."""
    interval_frames: int = 250_000
    """World-steps between checkpoints, >= 0 (0 = do not count frames): for worlds whose episodes do not end."""
    keep: int = 3
    """Newest checkpoints kept, >= 0 (0 = all), beside best.pt."""
    buffer: bool = True
    """Save the replay buffer too, so that a run that was killed goes on to the same bits. Each checkpoint writes the rows
    that are new; a finished run deletes them. false: a resumed run refills an empty buffer first."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_range("checkpoint.interval_episodes", self.interval_episodes, 0, 10**12)
        check_range("checkpoint.interval_frames", self.interval_frames, 0, 10**13)
        check_range("checkpoint.keep", self.keep, 0, 10**6)


@dataclass
class LogConfig:
    """What TensorBoard gets; none of it changes the run."""

    points: int = 200
    """Points of each curve over the whole run, 1..1e6."""
    histograms: bool = True
    """Histograms of the energies, with every point."""
    figures: bool = True
    """A figure of one world's paths at every evaluation."""
    gif: bool = True
    """An animation of one world at every evaluation (about 0.6 MB each)."""

    def __post_init__(self) -> None:
        """Check every field."""
        check_range("log.points", self.points, 1, 10**6)


@dataclass
class Config:
    """Everything that train.py needs."""

    seed: int = 0
    """Seed of every random stream, 0..2^31."""
    n_seeds: int = 1
    """Train the seeds seed, seed + 1, .. in one program, 1..1000: as many independent learners stepped and updated as one
    batch. Each has the folder, files and results of a run of its own (on a CPU to the bit, but for one robot, float64 and
    layers of odd sizes: to rounding); those that are finished are left out."""
    seeds: list[int] | None = None
    """The same with these seeds, such as 'seeds=[0,3,7]'; null = n_seeds of them."""
    device: str = "auto"
    """auto | cpu | cuda."""
    threads: int = 1
    """CPU threads, 0..1024; 0 = PyTorch's choice. One is fastest for tensors of this size, by a factor of 4 on 2 cores."""
    resume: str = "auto"
    """auto: a finished run is left alone, an unfinished one goes on from its newest valid checkpoint. never: start anew in
    the same folder; what an earlier run left there is moved to replaced_<k>. A path: go on from that checkpoint, or the newest
    of that run's folder. The seed must be the same, and of the settings in the configuration's hash only
    collector.total_frames, train, eval, compile, fixed_sizes and cuda_graphs may differ from its own (device, threads, log,
    checkpoint and the like are not in it). A finished run has deleted its replay rows: from its checkpoint a run goes on with
    an empty replay buffer."""
    deterministic: bool = False
    """Refuse operations of PyTorch that may differ between runs of the same seed (CUDA has some; slower there)."""
    compile: bool = False
    """Run pure tensor functions of step and shield through torch.compile (a minute at the start), with fixed_sizes all of step
    and filter; same results to rounding. Where there is no C++ compiler: a warning, and as false."""
    fixed_sizes: bool = False
    """Compute step and filter for all robots instead of those that need it, so that no size depends on the data: the host of
    a GPU then does not wait within a step. Slower on a CPU. Where no closed form solves a program the robot holds, and where
    the shield would act all robots of that world drive home."""
    cuda_graphs: bool = False
    """Record what networks, filter, step, counting and update launch on a GPU once, and launch it as one from then on: several
    times as fast. It comes with fixed_sizes. The same results to rounding. On a CPU nothing is recorded (the optimiser is the
    fused one, other roundings); with safety.in_loss the update is not."""
    debug: bool = False
    """Show tracebacks."""
    env: SurveillanceConfig = field(default_factory=SurveillanceConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    workers: WorkersConfig = field(default_factory=WorkersConfig)
    buffer: BufferConfig = field(default_factory=BufferConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    log: LogConfig = field(default_factory=LogConfig)

    def __post_init__(self) -> None:
        """Check the combinations that no group can check alone."""
        check_common(self.seed, self.device, self.threads)
        self._check_seeds()
        if self.resume not in ("auto", "never") and not Path(self.resume).exists():
            raise ValueError(
                f"resume={self.resume} is neither auto nor never, and no such file or folder exists: give a checkpoint "
                "(<run folder>/checkpoints/frames_*.pt) or a run's folder."
            )
        if self.workers.count and self.collector.num_envs % self.workers.count:
            raise ValueError(
                f"collector.num_envs={self.collector.num_envs} is not a multiple of workers.count={self.workers.count}: each "
                "worker steps as many worlds as the others."
            )
        self.safety.gains(self.env)
        self.safety.check_sizes(fixed_sizes=self.computing["fixed_sizes"])
        check_loss(self.agent, self.safety)
        steps = self.collector.total_frames // self.collector.num_envs
        if steps < self.agent.n_steps:
            raise ValueError(
                f"agent.n_steps={self.agent.n_steps} is longer than the run, which would learn nothing: "
                f"collector.total_frames={self.collector.total_frames} with collector.num_envs={self.collector.num_envs} are "
                f"{steps} steps of every world."
            )
        self.adversary_reward()

    @property
    def computing(self) -> dict[str, bool]:
        """How worlds and filter compute: arguments of :class:`envs.SurveillanceEnv` and ``make_policies``."""
        return computing(self.compile, fixed_sizes=self.fixed_sizes, cuda_graphs=self.cuda_graphs)

    @property
    def batch_size(self) -> int:
        """Transitions of an update: a minibatch, or one per agent."""
        return self.buffer.batch_size * (self.env.n_agents if self.agent.minibatch == "per_agent" else 1)

    @property
    def all_seeds(self) -> list[int]:
        """The seeds that this program trains."""
        return seeds_of(self)

    def _check_seeds(self) -> None:
        check_range("n_seeds", self.n_seeds, 1, MOST_SEEDS)
        if self.seeds is not None:
            shown = str(self.seeds).replace(" ", "")
            if self.n_seeds != 1:
                raise ValueError(f"seeds={shown} and n_seeds={self.n_seeds} exclude each other: give one of them.")
            check_range("the number of seeds", len(self.seeds), 1, MOST_SEEDS, hint="Such as 'seeds=[0,1,2]'.")
            if twice := sorted({seed for seed in self.seeds if self.seeds.count(seed) > 1}):
                raise ValueError(
                    f"seeds={shown} names {', '.join(map(str, twice))} more than once: each seed is one run."
                )
        for seed in self.all_seeds:
            check_range("seeds", seed, 0, 2**31)
        if len(self.all_seeds) > 1 and self.resume not in ("auto", "never"):
            raise ValueError(
                f"resume={self.resume} is one run's checkpoint, and several seeds are asked for: use resume=auto or never, or "
                "train this seed alone."
            )

    def adversary_reward(self) -> AdversaryReward | None:
        """What the objective puts in the place of the environment's reward; None for coverage."""
        if self.train.objective == "coverage":
            return None
        return AdversaryReward(self.env, self.safety, self.train.attack)


def seeds_of(config: Any) -> list[int]:
    """Seeds of a configuration, composed (perhaps not yet checked) or :class:`Config`."""
    if config.seeds:
        return list(config.seeds)
    return [config.seed + k for k in range(max(1, config.n_seeds))]


def computing(compile_functions: bool, *, fixed_sizes: bool, cuda_graphs: bool) -> dict[str, bool]:
    """How worlds and filter compute, for a program's settings: graphs come with fixed sizes."""
    sizes = {"fixed_sizes": fixed_sizes or cuda_graphs, "cuda_graphs": cuda_graphs}
    return {"compile_functions": compile_functions} | sizes


def check_common(seed: int, device: str, threads: int) -> None:
    """Check what all programs' configurations have in common.

    Raises:
        ValueError: naming the value and what is allowed.
    """
    check_range("seed", seed, 0, 2**31)
    check_choice("device", device, DEVICES)
    check_range("threads", threads, 0, 1024)
    pick_device(device)  # refuses cuda where there is none, before a folder exists
