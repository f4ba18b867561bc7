"""`cconv export`: a file with a program and what it takes, or one clear line and no file."""

import json

import pytest
import torch
from contracts.test_tasks_and_networks import fresh
from outcomes import assert_one_clear_line
from systems import periodic_frame, periodic_scene, window_of

from cconv.models.checkpoint import save_model
from cconv.models.exported import DESCRIPTION
from cconv.models.model import build_model
from cconv.networks import RadialNetSettings
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample

LAYER = RadialNetSettings(layers=1, radial_terms=4, message="mixed")


@pytest.fixture
def checkpoint(generator, tmp_path):
    model, _, _ = fresh("density_rate", "radial_net", generator, layers=1)
    save_model(model, tmp_path / "checkpoint", {})
    return tmp_path / "checkpoint"


@pytest.mark.usefixtures("unchecked")
def test_the_file_says_what_the_program_takes(cconv, checkpoint, tmp_path):
    out = tmp_path / "model.pt2"
    status, printed, _ = cconv("export", checkpoint, "--out", out, "--json")
    assert status == 0
    inside = {DESCRIPTION: ""}
    torch.export.load(out, extra_files=inside)
    described = json.loads(inside[DESCRIPTION])
    assert described.items() <= json.loads(printed).items()
    assert described["columns"] == ["density", "velocity", "velocity"]
    assert described["wall_features"] == "normal"


def test_an_older_file_and_another_ending_are_refused(cconv, checkpoint, tmp_path):
    (tmp_path / "old.pt2").write_text("old")
    assert_one_clear_line(cconv("export", checkpoint, "--out", tmp_path / "old.pt2"), "exists already", "--overwrite")
    assert_one_clear_line(cconv("export", checkpoint, "--out", tmp_path / "model.onnx"), ".pt2", "model.onnx")
    assert (tmp_path / "old.pt2").read_text() == "old"


def test_a_network_that_corrects_a_predictor_is_refused(cconv, generator, tmp_path):
    window, scene, task = window_of(periodic_frame(generator), generator), periodic_scene(), task_named("acceleration")

    def layer(asked):
        return build_model(LAYER, asked, ["velocity"], scene, [make_step_sample(window, scene, asked)], generator)

    save_model(layer(task.correcting(layer(task))), tmp_path / "corrected", {})
    refusal = cconv("export", tmp_path / "corrected", "--out", tmp_path / "model.pt2")
    assert_one_clear_line(refusal, "corrects a predictor", "from Python")
    assert [path.name for path in tmp_path.iterdir()] == ["corrected"]
