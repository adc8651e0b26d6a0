"""Typed root configuration of train.py and evaluate.py, its checks, and the registration of all schemas with Hydra."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf, open_dict

from agents import AgentConfig, make_controller
from agents.adversary_reward import BARRIERS, AdversaryReward
from agents.checkpoint import check_world, find_checkpoint, load_checkpoint, world_sizes
from agents.controllers import CONTROLLERS
from agents.maddpg import check_loss
from agents.pipeline import pick_device
from agents.training_state import MAY_DIFFER, check_origin, named_checkpoint
from conf.launching import register_resolvers
from conf.manual import check_names, manual
from conf.naming import config_hash, evaluation_folder, hashed_config
from conf.report_schema import ReportConfig
from envs import SurveillanceConfig, SurveillanceEnv
from envs.config import check_choice, check_range
from safety import SafetyConfig

DEVICES = ("auto", "cpu", "cuda")


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
    """Worlds of an evaluation, 1..1e6."""
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
    device: str = "auto"
    """auto | cpu | cuda."""
    threads: int = 1
    """CPU threads, 0..1024; 0 = PyTorch's choice. One is fastest for tensors of this size, by a factor of 4 on 2 cores."""
    resume: str = "auto"
    """auto: a finished run is left alone, an unfinished one goes on from its newest valid checkpoint. never: start anew in
    the same folder; what an earlier run left there is moved to replaced_<k>. A path: go on from that checkpoint, or the newest
    of that run's folder; only collector.total_frames, train, eval and compile may differ from its settings."""
    deterministic: bool = False
    """Refuse operations of PyTorch that may differ between runs of the same seed (CUDA has some; slower there)."""
    compile: bool = False
    """Run the pure tensor functions of step and shield through torch.compile (a minute at the start); same results to
    rounding. Where there is no C++ compiler: a warning, and as false."""
    debug: bool = False
    """Show tracebacks."""
    env: SurveillanceConfig = field(default_factory=SurveillanceConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    collector: CollectorConfig = field(default_factory=CollectorConfig)
    buffer: BufferConfig = field(default_factory=BufferConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    log: LogConfig = field(default_factory=LogConfig)

    def __post_init__(self) -> None:
        """Check the combinations that no group can check alone."""
        _check_common(self)
        if self.resume not in ("auto", "never") and not Path(self.resume).exists():
            raise ValueError(
                f"resume={self.resume} is neither auto nor never, and no such file or folder exists: give a checkpoint "
                "(<run folder>/checkpoints/frames_*.pt) or a run's folder."
            )
        self.safety.gains(self.env)
        check_loss(self.agent, self.safety)
        steps = self.collector.total_frames // self.collector.num_envs
        if steps < self.agent.n_steps:
            raise ValueError(
                f"agent.n_steps={self.agent.n_steps} is longer than the run, which would learn nothing: "
                f"collector.total_frames={self.collector.total_frames} with collector.num_envs={self.collector.num_envs} are "
                f"{steps} steps of every world."
            )
        self.adversary_reward()

    def adversary_reward(self) -> AdversaryReward | None:
        """What the objective puts in the place of the environment's reward; None for coverage."""
        if self.train.objective == "coverage":
            return None
        return AdversaryReward(self.env, self.safety, self.train.attack)


@dataclass
class EvaluateConfig:
    """Everything that evaluate.py needs: either a run or a controller."""

    run: str | None = None
    """Folder of a training run (its world and filter are used, with env.* and safety.* overrides applied to them)."""
    controller: str | None = None
    """Name of a controller."""
    adversary: str | None = None
    """controller=learned: folder of the run that trained it (newest checkpoint); null = the one shipped, for the default world."""
    checkpoint: str | None = None
    """File in the run's checkpoints folder, such as frames_000000100000.pt; null = the newest."""
    folder: str = "runs/controllers"
    """controller: where the folders of its evaluations go (a run's are in the run's own folder)."""
    steps: int = 0
    """Length of the rollout; 0 = the world's horizon (1000 where it has none)."""
    num_envs: int = 64
    """Worlds, 1..1e6."""
    seed: int = 0
    """Seed of the start states and of the controller, 0..2^31."""
    device: str = "auto"
    """auto | cpu | cuda."""
    threads: int = 1
    """CPU threads, 0..1024; 0 = PyTorch's choice. One is fastest for tensors of this size, by a factor of 4 on 2 cores."""
    pictures: bool = True
    """Write pictures and the GIF of the first world, not only eval.json."""
    restart: bool = False
    """Draw a world anew after a violation and go on counting in it; otherwise it counts until its first one."""
    compile: bool = False
    """As train.py's: run the pure tensor functions of step and shield through torch.compile."""
    resume: str = "never"
    """auto: an evaluation that has its eval.json is left alone, so that a killed sweep goes on. never: evaluate anew."""
    debug: bool = False
    """Show tracebacks."""
    env: SurveillanceConfig = field(default_factory=SurveillanceConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)

    def __post_init__(self) -> None:
        """Check every field."""
        _check_common(self)
        check_range("steps", self.steps, 0, 10**9)
        check_range("num_envs", self.num_envs, 1, 10**6)
        check_choice("resume", self.resume, ("auto", "never"))
        if (self.run is None) == (self.controller is None):
            raise ValueError(
                f"run={self.run} controller={self.controller}: give one of run=<folder> and controller=<name>."
            )
        if self.controller is not None:
            check_choice("controller", self.controller, tuple(CONTROLLERS))
        if self.adversary is not None and self.controller != "learned":
            raise ValueError(f"adversary={self.adversary} goes with controller=learned, not with {self.controller}.")
        for name in ("run", "adversary"):
            folder = getattr(self, name)
            if folder is not None and not (Path(folder) / ".hydra" / "config.yaml").is_file():
                raise ValueError(
                    f"{name}={folder} is not the folder of a run: {folder}/.hydra/config.yaml does not exist."
                )
        self.safety.gains(self.env)


def _check_common(config: Any) -> None:
    check_range("seed", config.seed, 0, 2**31)
    check_choice("device", config.device, DEVICES)
    check_range("threads", config.threads, 0, 1024)
    pick_device(config.device)  # refuses cuda where there is none, before a folder exists


def register() -> None:
    """Tell Hydra the schemas and the resolvers that name the run folders."""
    store = ConfigStore.instance()
    store.store(name="train_schema", node=Config)
    store.store(name="evaluate_schema", node=EvaluateConfig)
    store.store(name="report_schema", node=ReportConfig)
    OmegaConf.register_new_resolver("config_hash", lambda *, _root_: config_hash(_root_), replace=True)
    register_resolvers()
    schemas = {"train": Config, "evaluate": EvaluateConfig, "report": ReportConfig}
    OmegaConf.register_new_resolver("manual", lambda program: manual(schemas[program]), replace=True)
    OmegaConf.register_new_resolver("evaluation_folder", lambda *, _root_: evaluation_folder(_root_), replace=True)


def to_config(cfg: DictConfig) -> Any:
    """The validated dataclass of a composed configuration.

    Raises:
        ValueError: naming the value, what is allowed and the remedy.
    """
    own = cfg.copy()
    with open_dict(own):
        own.pop("hydra", None)
    check_names(own)
    if "run" in own and own.run is not None:  # world and filter are the run's: run_config applies the overrides to them
        own.env, own.safety = OmegaConf.structured(SurveillanceConfig), OmegaConf.structured(SafetyConfig)
    return OmegaConf.to_object(own)


def run_config(cfg: DictConfig, overrides: list[str]) -> Config:
    """Configuration of the run ``cfg.run`` with the command line's env and safety overrides applied to it."""
    given = OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.load(Path(cfg.run) / ".hydra" / "config.yaml"))
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if key.split(".")[0] in ("env", "safety"):
            OmegaConf.update(given, key, OmegaConf.select(cfg, key), merge=False)
    given.device = cfg.device  # the run may have been trained elsewhere
    return to_config(given)


def check_training(cfg: DictConfig) -> None:
    """Raise what is wrong with a training run before anything is written: values, and the checkpoint that resume names."""
    config: Config = to_config(cfg)
    if config.resume not in ("auto", "never"):
        path, content = named_checkpoint(Path(config.resume), tell=lambda line: None)
        own = path.parent.parent.resolve() == Path(str(cfg.hydra.run.dir)).resolve()
        here = {"config": hashed_config(cfg), "seed": config.seed}
        check_origin(path, content, here, may_differ=() if own else MAY_DIFFER)


def check_evaluation(cfg: DictConfig) -> None:
    """Raise what is wrong with an evaluation before anything is written: values, run folder, checkpoint, its world."""
    config = to_config(cfg)
    if config.adversary is not None:
        trained = OmegaConf.load(Path(config.adversary) / ".hydra" / "config.yaml")
        objective = OmegaConf.select(trained, "train.objective")
        if objective != "adversary":
            raise ValueError(
                f"adversary={config.adversary} is a run with train.objective={objective or 'coverage'}, not an adversary's: "
                "evaluate it with run=<folder>, or train one with python train.py experiment=adversary."
            )
    if config.controller == "learned":
        make_controller("learned", config.env, adversary=config.adversary)  # its checkpoint and the world's sizes
    if config.run is not None:
        world = run_config(cfg, list(cfg.hydra.overrides.task)).env
        path = find_checkpoint(Path(config.run), config.checkpoint)
        check_world(path, load_checkpoint(path)["world"], world_sizes(SurveillanceEnv(world)))
