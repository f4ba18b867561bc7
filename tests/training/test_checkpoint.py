import json

import pytest
import torch
from systems import problem

from cconv import load_model
from cconv.errors import ConfigError
from cconv.training.checkpoint import read_card, save_model
from cconv.training.field_model import NetworkConfig


@pytest.fixture
def saved(generator, tmp_path):
    given = problem(generator)
    model = given.build_model(NetworkConfig(layers=2, first_channels=4, kernel_size=3), 0)
    save_model(model, tmp_path / "checkpoint", {"valid_normalized_mse": 0.5})
    return given, model, tmp_path / "checkpoint"


def test_round_trip_predicts_the_same(saved):
    given, model, folder = saved
    inputs = given.valid_samples[0].inputs
    assert torch.equal(load_model(folder).predict(inputs), model.predict(inputs))
    assert read_card(folder) == {"valid_normalized_mse": 0.5}


def test_saving_again_replaces_and_leaves_nothing_behind(saved):
    _, model, folder = saved
    save_model(model, folder, {"valid_normalized_mse": 0.25})
    assert read_card(folder)["valid_normalized_mse"] == 0.25
    assert [path.name for path in folder.parent.iterdir()] == ["checkpoint"]


def test_a_checkpoint_of_another_task_is_refused(saved):
    with pytest.raises(ConfigError, match="task 'density_rate', not 'density_gradient'"):
        load_model(saved[2], task="density_gradient")


def test_missing_files_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"no model\.safetensors"):
        load_model(tmp_path)


def test_damaged_weights_are_named(saved):
    weights = saved[2] / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:100])
    with pytest.raises(ConfigError, match="damaged weights"):
        load_model(saved[2])


def test_weights_of_another_network_are_refused(saved):
    path = saved[2] / "config.json"
    config = json.loads(path.read_text())
    config["network"]["first_channels"] = 5
    path.write_text(json.dumps(config))
    with pytest.raises(ConfigError, match="do not belong together"):
        load_model(saved[2])


def test_an_unknown_setting_is_named(saved):
    path = saved[2] / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"colour": "red"}))
    with pytest.raises(ConfigError, match=r"config\.json: .*colour"):
        load_model(saved[2])
