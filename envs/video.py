"""Moving pictures of one world: a GIF in the look of the figures, and MP4 files, frame by frame from the drawing to the disk.

An MP4 needs imageio-ffmpeg (``pip install -e '.[video]'``), whose wheels bring the encoder; it is imported when a file is
written and at no other time. One frame is in memory, however long the video is.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from PIL import Image

from envs.animation import Painter
from envs.rendering import STYLE, Trajectory, draw_world, survey_charge_survey, world_figure

ZOOM = 2  # of an MP4's frames, 600 pixels high
QUALITY = 7  # of 10; letters stay sharp


def check_mp4() -> None:
    """Refuse to begin what could not be written at the end.

    Raises:
        ValueError: if the library or its encoder is not installed.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise ValueError(
            f"an MP4 needs the package imageio-ffmpeg ({error}): pip install -e '.[video]', or choose video=gif."
        ) from error


def _figures(trajectory: Trajectory, chosen: np.ndarray, dpi: int) -> Iterator[Image.Image]:
    """The chosen samples as figures, each drawn when it is asked for."""
    with rc_context(STYLE):
        figure, ax = world_figure(trajectory, dpi)
    for k in chosen:
        ax.clear()  # drops the column to the right too
        with rc_context(STYLE):  # not while the frame is away
            draw_world(ax, trajectory, int(k))
            figure.canvas.draw()
        yield Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())


def _chosen(trajectory: Trajectory, most: int) -> np.ndarray:
    """Indices of at most ``most`` samples, evenly spread, first and last included."""
    last = len(trajectory.position) - 1
    return np.unique(np.linspace(0, last, max(1, min(last + 1, most))).round().astype(int))


def save_gif(trajectory: Trajectory, path: str | Path, *, max_frames: int = 150, fps: float = 12) -> Path:
    """Writes an animation of at most `max_frames` samples, evenly spread, at `fps` frames/s; returns the path."""
    # One palette from the three phases for all frames: no flicker, and unchanged pixels compress to nothing.
    phases = [np.asarray(image) for image in _figures(trajectory, np.unique(survey_charge_survey(trajectory)), 78)]
    palette = Image.fromarray(np.concatenate(phases)).quantize(160)
    frames = _figures(trajectory, _chosen(trajectory, max_frames), 78)
    stream = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in frames)
    options = {"append_images": stream, "duration": round(1000 / fps), "loop": 0}
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    next(stream).save(path, format="GIF", save_all=True, optimize=False, **options)
    return Path(path)


def save_mp4(trajectory: Trajectory, path: str | Path, *, max_frames: int = 10**6, fps: float = 25) -> Path:
    """Writes an H.264 video of at most `max_frames` samples, evenly spread, at `fps` frames/s; returns the path.

    Worlds in the plane are drawn by :class:`envs.animation.Painter` (about 50 frames a second), aerial ones as figures (about
    5). The file appears when it is complete.

    Raises:
        OSError: if the encoder stopped before the last frame: a full disk, say.
        ImportError: without imageio-ffmpeg.
    """
    import imageio_ffmpeg

    chosen = _chosen(trajectory, max_frames)
    if len(trajectory.arena) == 2:
        painter = Painter(trajectory, zoom=ZOOM)
        frames = (painter.frame(int(k)) for k in chosen)
    else:
        frames = _figures(trajectory, chosen, 110)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".part{path.suffix}")
    first = next(frames)
    size = tuple(side + side % 2 for side in first.size)  # H.264 halves the colours' resolution
    options = {"fps": fps, "quality": QUALITY, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
    encoder, sent = imageio_ffmpeg.write_frames(str(partial), size, **options), 0
    try:
        encoder.send(None)
        for image in itertools.chain([first], frames):
            frame = Image.new("RGB", size, "white")
            frame.paste(image)
            encoder.send(frame.tobytes())
            sent += 1
        encoder.close()  # waits for the encoder, but does not say whether it succeeded
        encoded, _ = imageio_ffmpeg.count_frames_and_secs(str(partial))
        if encoded != sent:
            raise RuntimeError(f"{encoded} can be read back")
        partial.replace(path)
    except (OSError, RuntimeError) as error:
        raise OSError(
            f"{path}: the video could not be written ({sent} of {len(chosen)} frames sent, {str(error).splitlines()[0]}). Is the "
            "disk full?"
        ) from error
    finally:
        encoder.close()
        partial.unlink(missing_ok=True)
    return path
