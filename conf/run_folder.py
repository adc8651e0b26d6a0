"""What stands in the folder of a run or of an evaluation: whether it is finished, the certificate's quantities, JSON files."""

import json
from collections.abc import Callable
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict
from tqdm import tqdm

from conf.naming import program_name, run_name, seeds_of
from envs import SurveillanceConfig
from envs.inequalities import derived_quantities


def announce_certificate(folder: Path, world: SurveillanceConfig, *, show: bool = True) -> None:
    """Show the quantities that the certificate of ``world`` derives, once, and keep them in ``certificate.json``."""
    certificate = derived_quantities(world)
    write_json(folder / "certificate.json", certificate)
    if show:
        tqdm.write("certificate: " + ", ".join(f"{name} {value:.4g}" for name, value in certificate.items()))


def run_folders(cfg: DictConfig, seeds: list[int], output: Path) -> dict[int, Path]:
    """The folder of each seed's run: Hydra's run folder, or where there are several those beside it (inside a folder that the
    user named).
    """
    if len(seeds) == 1:
        return {seeds[0]: output}
    if output.name == program_name(cfg):
        return {seed: output.parent / run_name(cfg, seed) for seed in seeds}
    return {seed: output / f"seed{seed}" for seed in seeds}


def unfinished_seeds(cfg: DictConfig, seeds: list[int], output: Path, tell: Callable[[str], None]) -> dict[int, Path]:
    """Make the folders of the runs that are still to be trained, each with a ``.hydra`` as of a run of its own.

    Args:
        cfg: the composed configuration.
        seeds: all seeds.
        output: Hydra's run folder.
        tell: shows a line for each finished run.

    Returns:
        Folders by seed, without those of finished runs.
    """
    folders = {}
    for seed, folder in run_folders(cfg, seeds, output).items():
        if message := finished_run(folder, cfg.resume):
            tell(message)
            continue
        folders[seed] = folder
        if cfg.seeds is not None or cfg.n_seeds != 1:
            _write_hydra_files(cfg, seed, folder, output)
    return folders


def _write_hydra_files(cfg: DictConfig, seed: int, folder: Path, output: Path) -> None:
    own, source, target = cfg.copy(), output / ".hydra", folder / ".hydra"
    with open_dict(own):
        own.pop("hydra", None)
    own.seed, own.seeds, own.n_seeds = seed, None, 1
    hydra = OmegaConf.load(source / "hydra.yaml")
    task = [entry for entry in hydra.hydra.overrides.task if entry.split("=")[0] not in ("seed", "seeds", "n_seeds")]
    hydra.hydra.overrides.task = [*task, f"seed={seed}"]
    target.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(own, target / "config.yaml")
    OmegaConf.save(hydra, target / "hydra.yaml")
    OmegaConf.save(hydra.hydra.overrides.task, target / "overrides.yaml")


def finished_evaluation(path: Path, asked: dict) -> bool:
    """Whether ``path`` is the complete ``eval.json`` of an evaluation of the same length, worlds, seed and policy."""
    if not path.is_file():
        return False
    content = json.loads(path.read_text())
    return all(content.get(name) == value for name, value in asked.items())


def finished_program(cfg: DictConfig) -> str | None:
    """What to tell the user if all runs of a program of train.py are finished and to be left alone; None otherwise."""
    folders = run_folders(cfg, seeds_of(cfg), Path(str(cfg.hydra.run.dir))).values()
    messages = [finished_run(folder, cfg.resume) for folder in folders]
    return "\n".join(filter(None, messages)) if all(messages) else None


def finished_run(folder: Path, resume: str | None) -> str | None:
    """What to tell the user if ``folder`` holds a finished run that is to be left alone; None otherwise."""
    if resume in (None, "never") or not (folder / "summary.json").is_file():
        return None
    if folder.resolve() in (Path(resume).resolve(), *Path(resume).resolve().parents):  # one of its own checkpoints
        return None
    return f"{folder} holds a finished run: nothing to do. resume=never trains it anew."


def write_json(path: Path, content: dict) -> None:
    """Write ``content`` indented, complete or not at all; a NaN or infinity raises ``ValueError``."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    temporary.replace(path)
