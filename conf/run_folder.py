"""What stands in the folder of a run or of an evaluation: whether it is finished, the certificate's quantities, JSON files."""

import json
from pathlib import Path

from tqdm import tqdm

from envs import SurveillanceConfig
from envs.inequalities import derived_quantities


def announce_certificate(folder: Path, world: SurveillanceConfig) -> None:
    """Show the quantities that the certificate of ``world`` derives, once, and keep them in ``certificate.json``."""
    certificate = derived_quantities(world)
    write_json(folder / "certificate.json", certificate)
    tqdm.write("certificate: " + ", ".join(f"{name} {value:.4g}" for name, value in certificate.items()))


def finished_evaluation(path: Path, asked: dict) -> bool:
    """Whether ``path`` is the complete ``eval.json`` of an evaluation of the same length, worlds, seed and policy."""
    if not path.is_file():
        return False
    content = json.loads(path.read_text())
    return all(content.get(name) == value for name, value in asked.items())


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
