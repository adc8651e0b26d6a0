"""What TensorBoard shows of a run: scalars, histograms of energy, pictures and animations of one world, hyperparameters."""

import io
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from tensorboard.compat.proto.summary_pb2 import Summary
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import histogram, hparams

from envs.animation import Painter, write_gif
from envs.path_plot import path_figure
from envs.rendering import Trajectory

GIF_FRAMES = 50


class Board:
    """A run's event file; the x-axis is frames (world-steps).

    Args:
        folder: the run's folder.
        frames: where a resumed run goes on; points that were logged later, by a process that was killed, disappear. 0 = from
            the start.
        config: settings for the HPARAMS tab, nested.
        figures: draw the paths of one world at every evaluation.
        gif: and an animation of it.
    """

    def __init__(self, folder: Path, frames: int, config: Mapping[str, Any], *, figures: bool, gif: bool) -> None:
        self.writer = SummaryWriter(str(folder), purge_step=frames + 1 if frames else None)
        self.figures, self.gif = figures, gif
        if not frames:
            self._hyperparameters(config)

    @property
    def records(self) -> bool:
        """Whether evaluations are to keep a world's history."""
        return self.figures or self.gif

    def point(
        self, values: Mapping[str, float], frames: int, histograms: Mapping[str, Tensor] = MappingProxyType({})
    ) -> None:
        """Log numbers and histograms, of all entries that are finite, by tag.

        All are one event: TensorBoard opens the file anew for each, in a thread that takes the interpreter from the training.
        """
        found = [Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()]
        for tag, tensor in histograms.items():
            numbers = tensor.detach().cpu().numpy()
            numbers = numbers[np.isfinite(numbers)]
            if numbers.size:
                found += histogram(tag, numbers, bins=50).value
        self.writer._get_file_writer().add_summary(Summary(value=found), frames)

    def world(self, trajectory: Trajectory | None, frames: int) -> None:
        """Log the paths and the animation of one world."""
        if trajectory is None:
            return
        if self.figures:
            content = io.BytesIO()
            figure = path_figure(trajectory, dpi=90)
            figure.savefig(content, format="png")
            width, height = figure.canvas.get_width_height()
            self._image("world/paths", content, width, height, frames)
        if self.gif:
            content = io.BytesIO()
            write_gif(trajectory, content, max_frames=GIF_FRAMES)
            width, height = Painter(trajectory).frame(0).size
            self._image("world/animation", content, width, height, frames)

    def flush(self) -> None:
        """Put everything logged so far on disk."""
        self.writer.flush()

    def close(self) -> None:
        """Flush and close the file."""
        self.writer.close()

    def _image(self, tag: str, content: io.BytesIO, width: int, height: int, frames: int) -> None:
        """An encoded picture: the writer's own functions decode and re-encode, which loses animations."""
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=content.getvalue())
        summary = Summary(value=[Summary.Value(tag=tag, image=image)])
        self.writer._get_file_writer().add_summary(summary, frames)

    def _hyperparameters(self, config: Mapping[str, Any]) -> None:
        """In the run's own file: ``add_hparams`` would make a run of its own, without curves.

        Without the description of an experiment, which would fix one run's columns for all: so TensorBoard puts the settings
        that differ between the runs first, and takes every scalar for a metric.
        """
        _, start, _ = hparams(plain(config), {})
        self.writer._get_file_writer().add_summary(start)


def plain(config: Mapping[str, Any], prefix: str = "") -> dict[str, bool | str | float]:
    """Nested settings as the HPARAMS tab takes them: flat names, values that are numbers, strings or truth values."""
    flat: dict[str, bool | str | float] = {}
    for name, value in config.items():
        if isinstance(value, Mapping):
            flat |= plain(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value if isinstance(value, bool | str | int | float) else str(value)
    return flat
