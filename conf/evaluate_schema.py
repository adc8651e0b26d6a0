"""Typed configuration of evaluate.py."""

from dataclasses import dataclass, field
from pathlib import Path

from agents.controllers import CONTROLLERS
from agents.training_config import check_common, computing
from envs import SurveillanceConfig
from envs.config import check_choice, check_range
from envs.video import check_mp4
from safety import SafetyConfig


@dataclass
class EvaluateConfig:
    """Everything that evaluate.py needs: either a run or a controller."""

    run: str | None = None
    """Folder of a training run (its world and filter are used, with env.* and safety.* overrides applied to them)."""
    controller: str | None = None
    """Tasks: lloyd | charge_when_low | coverage_cbf | coverage_cbf_literal | patrol. Adversaries: random | ou | flee | gather |
    swap | chatter | block | tangential | chase | certificate_descent | mixture | nan | learned."""
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
    """Write pictures and a video of the first world, not only eval.json."""
    format: str = "png"
    """png | pdf | svg: format of the pictures; the last two are vector graphics, for papers."""
    video: str = "gif"
    """gif (60 frames) | mp4 (every sample, 25 a second; needs pip install -e '.[video]') | both | none."""
    samples: int = 2000
    """Samples of the first world that pictures and videos show, evenly spread over the rollout, 1..1e6. A rollout of fewer
    steps shows every step."""
    restart: bool = False
    """Draw a world anew after a violation and go on counting in it; otherwise it counts until its first one."""
    compile: bool = False
    """As train.py's: run pure tensor functions of step and shield through torch.compile."""
    fixed_sizes: bool = False
    """As train.py's: let no size of a step depend on the data, for a GPU."""
    cuda_graphs: bool = False
    """As train.py's: record what filter and step launch on a GPU, and launch it as one. It comes with fixed_sizes."""
    resume: str = "never"
    """auto: an evaluation that has its eval.json is left alone, so that a killed sweep goes on. never: evaluate anew."""
    debug: bool = False
    """Show tracebacks."""
    env: SurveillanceConfig = field(default_factory=SurveillanceConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)

    def __post_init__(self) -> None:
        """Check every field."""
        check_common(self.seed, self.device, self.threads)
        check_range("steps", self.steps, 0, 10**9)
        check_range("num_envs", self.num_envs, 1, 10**6)
        check_choice("resume", self.resume, ("auto", "never"))
        check_choice("format", self.format, ("png", "pdf", "svg"))
        check_choice("video", self.video, ("gif", "mp4", "both", "none"))
        check_range("samples", self.samples, 1, 10**6)
        if self.video in ("mp4", "both"):
            if not self.pictures:
                raise ValueError(f"video={self.video} is one of the pictures: it needs pictures=true.")
            check_mp4()
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
                raise ValueError(_not_a_run(name, Path(folder)))
        self.safety.gains(self.env)

    @property
    def computing(self) -> dict[str, bool]:
        """How worlds and filter compute, as :attr:`agents.training_config.Config.computing`."""
        return computing(self.compile, fixed_sizes=self.fixed_sizes, cuda_graphs=self.cuda_graphs)


def _not_a_run(name: str, path: Path) -> str:
    """What is wrong with ``path``, and the run's folder where it lies in one, such as a checkpoint does."""
    run = next((folder for folder in path.parents if (folder / ".hydra" / "config.yaml").is_file()), None)
    if run is None:
        return f"{name}={path} is not the folder of a run: {path}/.hydra/config.yaml does not exist."
    named = f" checkpoint={path.name}" if name == "run" and path.suffix == ".pt" else ""
    return f"{name}={path} is inside the folder of a run; {name}= takes the folder itself: use {name}={run}{named}."
