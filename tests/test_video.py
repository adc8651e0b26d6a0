"""MP4 files hold every frame, are streamed, and are complete or not there."""

import dataclasses
import sys
import types

import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.colors import to_rgb

import evaluate
from envs import video
from envs.rendering import COLOURS
from envs.video import save_mp4
from tests.test_animation import near, pixel
from tests.test_rendering import make


def decode(path):
    """Size, frames per second and all frames of a file."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]
    return meta["fps"], frames


@pytest.mark.parametrize(("frames", "count"), [(6, 6), (100, 12)])
def test_what_was_drawn_can_be_decoded(tmp_path, frames, count):
    world = make(2, steps=12)
    path = save_mp4(world, tmp_path / "new" / "world.mp4", max_frames=frames, fps=10)
    fps, decoded = decode(path)
    assert fps == 10
    assert len(decoded) == count
    painter = video.Painter(world, zoom=video.ZOOM)
    for shown, k in ((decoded[0], 0), (decoded[-1], 11)):
        drawn = np.asarray(painter.frame(k)).astype(int)
        assert shown.shape == drawn.shape
        assert np.abs(shown - drawn).mean() < 2  # the encoder's loss; another sample differs by more
        for i in range(2):
            image = video.Image.fromarray(shown)
            assert near(image, np.array(pixel(painter, world.position[k, i])), COLOURS[i], radius=14), to_rgb(
                COLOURS[i]
            )
    assert [file.name for file in path.parent.iterdir()] == ["world.mp4"]


def test_three_dimensions_and_odd_sizes(tmp_path, monkeypatch):
    _, decoded = decode(save_mp4(make(2, 3, steps=3), tmp_path / "world.mp4"))
    assert len(decoded) == 3
    assert all(side % 2 == 0 for side in decoded[0].shape[:2])
    monkeypatch.setattr(video.Painter, "frame", lambda self, k: video.Image.new("RGB", (101, 63), COLOURS[k]))
    _, decoded = decode(save_mp4(make(steps=4), tmp_path / "odd.mp4"))
    assert [frame.shape for frame in decoded] == [(64, 102, 3)] * 4
    for frame, colour in zip(decoded, COLOURS, strict=False):
        assert np.abs(frame[:60, :98] / 255 - to_rgb(colour)).max() < 0.05


def test_one_frame_is_in_memory(tmp_path, monkeypatch):
    """Each frame has gone to the encoder before the next one is drawn."""
    order, draw, write = [], video.Painter.frame, imageio_ffmpeg.write_frames

    def frame(self, k):
        order.append("draw")
        return draw(self, k)

    def write_frames(*args, **options):
        encoder = write(*args, **options)
        content = yield encoder.send(None)
        try:
            while True:
                order.append("send")
                encoder.send(content)
                content = yield
        finally:
            encoder.close()

    monkeypatch.setattr(video.Painter, "frame", frame)
    monkeypatch.setattr(imageio_ffmpeg, "write_frames", write_frames)
    save_mp4(make(steps=5), tmp_path / "world.mp4")
    assert order == ["draw", "send"] * 5


@pytest.mark.parametrize("after", [0, 3])
def test_an_encoder_that_fails_leaves_nothing(tmp_path, monkeypatch, after):
    write = imageio_ffmpeg.write_frames

    def short(*args, **options):
        """Loses what comes later, as a full disk does."""
        encoder = write(*args, **options)
        yield encoder.send(None)
        for _ in range(after):
            encoder.send((yield))
        encoder.close()
        while True:
            yield

    monkeypatch.setattr(imageio_ffmpeg, "write_frames", short)
    with pytest.raises(OSError, match=r"world\.mp4: the video could not be written .* disk full"):
        save_mp4(make(steps=6), tmp_path / "world.mp4")
    assert not list(tmp_path.iterdir())


def test_a_missing_library_is_named_before_a_folder_exists(program, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    for choice in ("mp4", "both"):
        code, output = program(evaluate.main, "controller=lloyd", f"video={choice}", "steps=2", "num_envs=1")
        assert code == 1
        assert "pip install -e '.[video]'" in " ".join(output.split())
        assert "Traceback" not in output
    assert not list(tmp_path.iterdir())
    broken = types.SimpleNamespace(get_ffmpeg_exe=lambda: (_ for _ in ()).throw(RuntimeError("No ffmpeg exe")))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", broken)
    with pytest.raises(ValueError, match="No ffmpeg exe"):
        video.check_mp4()


def test_evaluate_writes_what_is_asked_for(program, tmp_path):
    small = ("controller=charge_when_low", "num_envs=1", "steps=6", "device=cpu")
    code, output = program(evaluate.main, *small, "video=mp4", "samples=3", "format=svg", "folder=a")
    assert code == 0, output
    (folder,) = (tmp_path / "a").iterdir()
    pictures = {"surveying_1.svg", "charging.svg", "surveying_2.svg", "battery.svg", "paths.svg", "world.mp4"}
    assert {path.name for path in folder.iterdir()} == pictures | {"eval.json", "certificate.json", ".hydra"}
    _, frames = decode(folder / "world.mp4")
    assert len(frames) == 3
    code, output = program(evaluate.main, *small, "video=mp4", "pictures=false")
    assert code == 1
    assert "needs pictures=true" in output


def test_samples_are_spread_over_the_rollout():
    world = make(steps=9)
    assert video._chosen(world, 3).tolist() == [0, 4, 8]
    assert video._chosen(world, 100).tolist() == list(range(9))
    assert video._chosen(dataclasses.replace(world, position=world.position[:1]), 5).tolist() == [0]
