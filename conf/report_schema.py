"""Typed configuration of report.py."""

from dataclasses import dataclass

from envs.config import check_range


@dataclass
class ReportConfig:
    """Everything that report.py needs."""

    sweep: str | None = None
    """Folder that holds the runs, at any depth; required."""
    reference: str | None = "auto"
    """Method that J is divided by: its name in the report, or the part of it that no other has. auto: coverage_cbf where
    there is one (certified first). null: none."""
    against: str | None = None
    """A second method that the probability of improvement is shown against; null = only the reference."""
    incomplete: bool = False
    """Report what there is, and say so in the report, where runs are unfinished or seeds missing."""
    resamples: int = 5000
    """Bootstrap resamples, 100..1e6."""
    confidence: float = 0.95
    """Of the intervals, 0.5..0.999."""
    seed: int = 0
    """Seed of the resampling, 0..2^31."""
    pack: str | None = None
    """After the report, write what it needs of the finished runs to this file (.tar.xz, some kB per run)."""
    unpack: str | None = None
    """Put the runs of such a file below sweep, those left alone that are there already, and make no report."""
    debug: bool = False
    """Show tracebacks."""

    def __post_init__(self) -> None:
        """Check every field."""
        if self.sweep is None:
            raise ValueError("sweep=<folder> is missing: the folder that holds the runs, such as sweep=runs/default.")
        if self.pack is not None and not self.pack.endswith(".tar.xz"):
            raise ValueError(f"pack={self.pack}: the archive's name must end with .tar.xz.")
        if self.unpack is not None and self.pack is not None:
            raise ValueError(f"pack={self.pack} unpack={self.unpack}: unpack makes no report; give one of the two.")
        check_range("resamples", self.resamples, 100, 10**6)
        check_range("confidence", self.confidence, 0.5, 0.999)
        check_range("seed", self.seed, 0, 2**31)
