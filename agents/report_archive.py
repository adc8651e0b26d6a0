"""Results that outlive a machine: what a report needs of a sweep's finished runs, in one small archive.

Paths are below the sweep. Of every run: ``.hydra/`` (of hydra.yaml the choices and overrides only: the rest is about the
machine), ``summary.json`` or ``eval.json``, evaluations inside the run's folder, and an event file of the points that the
curves are made of. A report on the unpacked runs has the bytes of one on the originals, and the programs take them for
finished. Policies and checkpoints are not kept.
"""

import io
import lzma
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from omegaconf import OmegaConf
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from agents.report_runs import Events, ReportError, Run, run_folders


def pack_runs(runs: list[Run], events: Mapping[str, Events], path: Path) -> str:
    """Write the archive of finished runs; the same runs give the same bytes.

    Args:
        runs: finished runs.
        events: what the learned ones logged, by the run's name.
        path: file to write, replaced if it exists.

    Returns:
        What to tell the user.

    Raises:
        ReportError: the sweep's folder is itself a run.
    """
    if any(run.name == "." for run in runs):
        raise ReportError(f"pack={path}: {runs[0].folder} is one run, not a folder of runs: give its parent as sweep.")
    members = {}
    for run in runs:
        for name, content in _members(run, events.get(run.name, Events())):
            members[f"{run.name}/{name}"] = content
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with tarfile.open(temporary, "w:xz", preset=9) as tar:
        for name in sorted(members):
            entry = tarfile.TarInfo(name)  # no owner, no time
            entry.size = len(members[name])
            tar.addfile(entry, io.BytesIO(members[name]))
    temporary.replace(path)
    return f"{path}: {len(runs)} runs, {path.stat().st_size / 1e3:.0f} kB"


def _members(run: Run, events: Events) -> Iterator[tuple[str, bytes]]:
    """Names below the run's folder and contents of what is kept of it."""
    inner = [f"{other[len(run.name) + 1 :]}/eval.json" for other in run.others]
    overrides = [".hydra/overrides.yaml"] if (run.folder / ".hydra" / "overrides.yaml").is_file() else []
    for name in (".hydra/config.yaml", *overrides, "summary.json" if run.learned else "eval.json", *inner):
        yield name, (run.folder / name).read_bytes()
    hydra = OmegaConf.load(run.folder / ".hydra" / "hydra.yaml").hydra
    kept = {"overrides": hydra.overrides, "runtime": {"choices": hydra.runtime.choices}}
    yield ".hydra/hydra.yaml", OmegaConf.to_yaml({"hydra": kept}).encode()
    if events.points:
        yield f"events.out.tfevents.{int(events.start)}.packed", _event_file(events)


def _event_file(events: Events) -> bytes:
    """The points as a TensorBoard event file, tag by tag."""
    content = io.BytesIO()
    writer = RecordWriter(content)
    written = [Event(wall_time=events.start, file_version="brain.Event:2")]
    for tag in sorted(events.points):
        for frames, wall_time, value in events.points[tag].tolist():
            summary = Summary(value=[Summary.Value(tag=tag, simple_value=value)])
            written.append(Event(step=int(frames), wall_time=wall_time, summary=summary))
    for event in written:
        writer.write(event.SerializeToString(deterministic=True))
    return content.getvalue()


def unpack_runs(path: Path, sweep: Path) -> str:
    """Put an archive's runs below ``sweep``: each complete or not at all, none where a folder of its name exists.

    Args:
        path: from :func:`pack_runs`.
        sweep: made if it does not exist.

    Returns:
        What to tell the user.

    Raises:
        ReportError: the archive cannot be read, is damaged, holds no runs, or a member that leaves the folder or is no
            plain file; nothing is written.
    """
    try:
        with lzma.open(path) as content:  # checksums, to the end
            while content.read(1 << 20):
                pass
        with tarfile.open(path, "r:xz") as tar:
            members = [_plain(tarfile.data_filter(member, str(sweep))) for member in tar]
    except FileNotFoundError:
        raise ReportError(f"unpack={path}: no such file.") from None
    except (lzma.LZMAError, EOFError, tarfile.TarError) as error:
        raise ReportError(
            f"unpack={path} is damaged or no archive of report.py pack=<file> ({type(error).__name__}: {error}). "
            "Nothing was unpacked: get the file again, or make the archive again."
        ) from error
    if not any(member.name.endswith("/.hydra/config.yaml") for member in members):
        raise ReportError(f"unpack={path} holds no runs: it is no archive of report.py pack=<file>.")
    sweep.mkdir(parents=True, exist_ok=True)
    unpacked = left = 0
    with tempfile.TemporaryDirectory(prefix=".unpack_", dir=sweep) as temporary:
        with tarfile.open(path, "r:xz") as tar:
            tar.extractall(temporary, filter="data")
        for folder in sorted(run_folders(Path(temporary))):
            target = sweep / folder.relative_to(temporary)
            if target.exists():
                left += 1
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            folder.replace(target)
            unpacked += 1
    return f"{sweep}: {unpacked} runs of {path} unpacked, {left} were there already and are left alone"


def _plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
    """The member, if it is a file or a folder."""
    if not (member.isreg() or member.isdir()):
        raise tarfile.SpecialFileError(member)
    return member
