"""What a run shows in TensorBoard, read back from its event file."""

import io
import json
import math

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams.backend_context import Context as BackendContext
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

import train
from agents.board import Board, plain
from envs import keys
from tests.conftest import call

pytestmark = pytest.mark.xdist_group("board")  # its fixtures are made once, not by every worker


def read(folder):
    return EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "histograms": 0}).Reload()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run's folder."""
    folder = tmp_path_factory.mktemp("board") / "run"
    assert (
        call(train.main, "experiment=smoke", "env.horizon=20", f"hydra.run.dir={folder}", "agent.actor_lr=0.002") == 0
    )
    return folder


@pytest.fixture(scope="module")
def events(run):
    return read(run)


def test_a_run_answers_questions(events, run):
    scalars = set(events.Tags()["scalars"])
    assert {"train/return", "train/coverage_cost", "train/noise", "loss/q_value", "loss/grad_norm_actor"} <= scalars
    assert {f"train/violations_{kind}" for kind in keys.VIOLATION_KINDS} <= scalars
    assert {f"train/violation_rate_{kind}" for kind in keys.VIOLATION_KINDS} <= scalars
    rates = {"intervention_rate", "hold_rate", "homing_rate", "infeasible", "inaccurate", "max_residual"}
    margins = {"min_h_c", "min_h_o", "min_h_s", "min_certificate_margin"}
    assert {f"filter/{name}" for name in rates | margins} <= scalars
    parts = {"collect", "filter", "inference", "env", "update", "evaluate"}
    assert {f"time/frames_per_second_{name}" for name in parts} <= scalars
    for tag in scalars:
        found = events.Scalars(tag)
        assert [event.step for event in found] == sorted({event.step for event in found}), tag
        assert all(math.isfinite(event.value) for event in found), tag
    last = {tag: events.Scalars(tag)[-1] for tag in scalars}
    assert last["filter/min_h_c"].value > 0
    assert last["filter/min_h_s"].value > 0
    summary = json.loads((run / "summary.json").read_text())
    assert last["eval/coverage_cost"].step == summary["frames"]
    assert last["eval/coverage_cost"].value == pytest.approx(summary["eval"]["coverage_cost"])
    assert last["time/env_s"].value + last["time/filter_s"].value + last["time/inference_s"].value == pytest.approx(
        last["time/collect_s"].value, rel=1e-4
    )


def test_energies_and_pictures(events):
    (tag,) = events.Tags()["histograms"]
    assert tag == "train/energy"
    histogram = events.Histograms(tag)[-1].histogram_value
    assert histogram.num == 8 * 4 * 3  # worlds, steps of a batch, robots
    assert 0 <= histogram.min <= histogram.max <= 1
    assert set(events.Tags()["images"]) == {"world/paths", "world/animation"}
    for tag in events.Tags()["images"]:
        images = events.Images(tag)
        assert [image.step for image in images] == [0, 512, 1024]
        with Image.open(io.BytesIO(images[-1].encoded_image_string)) as picture:
            assert picture.size == (images[-1].width, images[-1].height)
            assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
            assert getattr(picture, "n_frames", 1) == (20 if tag == "world/animation" else 1)


def test_hyperparameters_stand_in_the_runs_own_file(events, run):
    assert [path.name for path in run.iterdir() if path.is_dir()].count("checkpoints") == 1
    assert not [path for path in run.iterdir() if path.is_dir() and path.name[0].isdigit()]
    content = events.PluginTagToContent("hparams")
    start = HParamsPluginData.FromString(content["_hparams_/session_start_info"]).session_start_info
    assert start.hparams["agent.actor_lr"].number_value == 0.002
    assert start.hparams["env.n_agents"].number_value == 3
    assert start.hparams["seed"].number_value == 0
    assert "_hparams_/experiment" not in content  # it would fix one run's columns, in alphabetical order, for all


def test_settings_that_differ_come_first_in_the_table(tmp_path):
    """As TensorBoard's own plugin answers the page."""
    for k, rate in enumerate((0.1, 0.2, 0.1)):
        board = Board(
            tmp_path / str(k), 0, {"a": 1, "seed": k, "x": {"rate": rate}, "z": "y"}, figures=False, gif=False
        )
        board.point({"eval/coverage_cost": 0.3 + k, "train/return": -1.0}, 10)
        board.close()
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(tmp_path)).Reload()
    provider = MultiplexerDataProvider(multiplexer, str(tmp_path))
    request, backend = RequestContext(), BackendContext(TBContext(data_provider=provider, logdir=str(tmp_path)))
    found = backend.experiment_from_metadata(request, "", True, backend.hparams_metadata(request, ""), None)
    columns = [info.name for info in found.hparam_infos]
    assert columns == ["seed", "x.rate", "a", "z"]
    assert {info.name.tag for info in found.metric_infos} == {"eval/coverage_cost", "train/return"}


def test_pictures_can_be_left_out(program, tmp_path):
    quiet = ("log.figures=false", "log.gif=false", "log.histograms=false", "log.points=4")
    code, output = program(train.main, "experiment=smoke", "hydra.run.dir=run", *quiet)
    assert code == 0, output
    events = read(tmp_path / "run")
    assert not events.Tags()["images"]
    assert not events.Tags()["histograms"]
    assert len(events.Scalars("train/coverage_cost")) == 4


def test_points_of_a_killed_process_disappear(tmp_path):
    for resumed_at, until in ((0, 8), (4, 6)):
        board = Board(tmp_path, resumed_at, {"a": {"b": [1]}}, figures=False, gif=False)
        for frames in range(resumed_at + 1, until + 1):
            board.point({"x": 10.0 * resumed_at + frames}, frames)
        board.point({}, until, {"h": torch.tensor([1.0, float("nan"), 2.0])})
        board.point({}, until, {"h": torch.tensor([float("nan")])})
        board.world(None, until)
        board.close()
    events = read(tmp_path)
    assert [(event.step, event.value) for event in events.Scalars("x")] == [
        (1, 1),
        (2, 2),
        (3, 3),
        (4, 4),
        (5, 45),
        (6, 46),
    ]
    assert [event.histogram_value.num for event in events.Histograms("h")] == [2]


def test_settings_are_flattened():
    nested = {"a": {"b": 1, "c": [1, 2], "d": None}, "e": True, "f": "x", "g": 0.5}
    assert plain(nested) == {"a.b": 1, "a.c": "[1, 2]", "a.d": "None", "e": True, "f": "x", "g": 0.5}
