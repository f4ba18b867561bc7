import itertools
import json
import os
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from systems import (
    configured,
    model_of,
    observed_and_sample,
    periodic_frame,
    periodic_scene,
    problem,
    window_of,
)

from cconv import load_model
from cconv.errors import ConfigError
from cconv.forces import ConstantForce
from cconv.models.checkpoint import read_card, save_model
from cconv.models.model import build_model
from cconv.models.relaxation import Relaxation
from cconv.rollout.rollout import rollout
from cconv.tasks import task_named
from cconv.tasks.samples import make_step_sample


@pytest.fixture
def saved(generator, tmp_path):
    given = problem(generator)
    model = given.build_model(configured(layers=2, first_channels=4, kernel_size=3), 0)
    save_model(model, tmp_path / "checkpoint", {"valid_error": 0.5})
    return given, model, tmp_path / "checkpoint"


def test_round_trip_predicts_the_same(saved):
    given, model, folder = saved
    inputs = given.valid_samples[0].inputs
    assert torch.equal(load_model(folder).predict(inputs), model.predict(inputs))
    assert read_card(folder) == {"valid_error": 0.5}


def test_a_checkpoint_from_before_relaxations_has_none(saved):
    _, _, folder = saved
    config = json.loads((folder / "config.json").read_text())
    del config["relaxation"]
    (folder / "config.json").write_text(json.dumps(config))
    assert load_model(folder).config.relaxation is None


def test_a_relaxation_is_kept_and_only_models_of_steps_have_one(generator, saved, tmp_path):
    observed, sample = observed_and_sample(periodic_frame(generator), periodic_scene(), "acceleration", generator)
    model = model_of(configured(layers=1), periodic_scene(), "acceleration", [sample], generator)
    relaxation = Relaxation(alpha=0.02, beta=0.3, loops=2)
    save_model(model.relaxed_by(relaxation), tmp_path / "steps", {})
    loaded = load_model(tmp_path / "steps")
    assert loaded.config.relaxation == relaxation
    assert model.config.relaxation is None
    scene = periodic_scene()
    assert torch.equal(loaded.predict_frame(observed, scene), model.predict_frame(observed, scene))
    with pytest.raises(ConfigError, match="`relaxation` is for steps, and 'density_rate' is a field"):
        saved[1].relaxed_by(relaxation)


def test_the_force_that_the_integrator_adds_is_kept_with_how_far_it_is_smoothed(generator, tmp_path):
    task, scene = (
        task_named("acceleration", force_travel=0.3),
        replace(periodic_scene(), force=ConstantForce((1.0, 0.0))),
    )
    window = window_of(periodic_frame(generator), generator)
    network = configured(layers=1).network
    model = build_model(network, task, task.features, scene, [make_step_sample(window, scene, task)], generator)
    save_model(model, tmp_path / "steps", {})
    loaded = load_model(tmp_path / "steps")
    assert loaded.task == model.task == task
    (here,), (there,) = (islice(rollout(each, window, scene), 1) for each in (model, loaded))
    assert torch.equal(here.present, there.present)
    with pytest.raises(ConfigError, match="there is no external force"):
        next(rollout(loaded, window, periodic_scene()))


@pytest.mark.parametrize(
    ("stored", "key"),
    [({"alpha": -1.0}, "alpha"), ({"alpha": 0.02, "loops": 0}, "loops"), ({"alpha": 0.02, "gamma": 1.0}, "gamma")],
)
def test_a_relaxation_that_cannot_be_is_one_line(stored, key, saved):
    _, _, folder = saved
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"relaxation": stored}))
    with pytest.raises(ConfigError, match=rf"config\.json: .*relaxation\.{key}"):
        load_model(folder)


def test_saving_again_replaces_and_leaves_nothing_behind(saved):
    _, model, folder = saved
    save_model(model, folder, {"valid_error": 0.25})
    assert read_card(folder)["valid_error"] == 0.25
    assert [path.name for path in folder.parent.iterdir()] == ["checkpoint"]


@pytest.mark.integration
def test_a_kill_at_any_time_leaves_a_whole_model(saved):
    """A child process replaces the model and ends itself at its first file operation, then at its second, and so on."""
    given, model, folder = saved
    other = given.build_model(configured(**model.config.network.model_dump()), 1)
    known = [each.predict(given.valid_samples[0].inputs) for each in (model, other)]
    for operation in itertools.count(1):
        child = os.fork()
        if child == 0:
            _end_at(operation)
            save_model(other, folder, {"valid_error": 0.25})
            os._exit(0)
        ended_early = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
        found = load_model(folder).predict(given.valid_samples[0].inputs)
        assert any(torch.equal(found, each) for each in known)
        assert read_card(folder)["valid_error"] in (0.5, 0.25)
        if not ended_early:
            break
    assert torch.equal(found, known[1])
    assert operation > 5


def _end_at(operation):
    """End this process, as SIGKILL would, at its file operation of that number."""
    left = itertools.count(operation - 1, -1)

    def count(event, arguments):
        if event in ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "shutil.rmtree") and next(left) == 0:
            os._exit(9)

    sys.addaudithook(count)


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


@pytest.mark.parametrize("version", [None, 1, 2, 4, "3"])
def test_a_checkpoint_of_another_format_is_refused_with_the_way_out(saved, version):
    path = saved[2] / "config.json"
    config = json.loads(path.read_text()) | {"format": version}
    if version is None:
        del config["format"]
    path.write_text(json.dumps(config))
    with pytest.raises(
        ConfigError, match=r"config\.json: `format` is .*, and this version reads 3.*fit the model again"
    ):
        load_model(saved[2])


@pytest.mark.parametrize("architecture", ["grid", "radial"])
def test_a_checkpoint_of_the_version_before_is_refused_with_the_way_out(architecture):
    folder = Path(__file__).parents[1] / "data" / "models_format_2" / architecture
    with pytest.raises(ConfigError, match="`format` is 2, and this version reads 3; train or fit the model again"):
        load_model(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"features": ["one"]}, "the feature 'velocity' must be one of `features`"),
        ({"features": ["one", "one", "velocity"]}, "must hold each name once"),
        ({"features": ["one", "velocity", "colour"]}, "no feature 'colour'"),
        ({"wall_vectors": 1, "features": ["one", "velocity"]}, "a convolution of the walls needs the feature 'walls'"),
        ({"wall_vectors": 1, "wall_scalars": 1}, "a scalar or a vector, not both"),
        ({"task": "x" * 10**6}, "`task` must be one of density_rate, density_gradient"),
        ({"network": {"architecture": "x" * 10**6}}, "expected tags: 'conv_net', 'radial_net'"),
    ],
)
def test_settings_that_no_model_has_are_refused_in_one_short_line(saved, changes, message):
    path = saved[2] / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(ConfigError, match=message) as error:
        load_model(saved[2])
    assert len(str(error.value)) < 1000
    assert "\n" not in str(error.value)


def with_weights(folder, **changes):
    """Write the weights again with other tensors; None takes one away."""
    path = folder / "model.safetensors"
    tensors = load_file(path) | changes
    save_file({name: tensor for name, tensor in tensors.items() if tensor is not None}, path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"feature_mean": None}, "'feature_mean' is nothing in the weights, and .*by the settings"),
        ({"feature_mean": torch.zeros(7)}, r"'feature_mean' is \(\(7,\), 'F32'\) in the weights"),
        ({"feature_mean": torch.zeros(4, dtype=torch.float64)}, r"'feature_mean' is \(\(4,\), 'F64'\)"),
        ({"colour": torch.zeros(1)}, "'colour' is .* and nothing by the settings"),
        ({"feature_mean": torch.full((4,), torch.nan)}, "'feature_mean' holds values that are not finite"),
        ({"feature_scale": torch.zeros(4)}, "'feature_scale' holds values that are not finite, or no scale"),
    ],
)
def test_weights_that_are_not_those_of_the_settings_are_named(saved, changes, message):
    with_weights(saved[2], **changes)
    with pytest.raises(ConfigError, match=message):
        load_model(saved[2])


@pytest.mark.integration
def test_a_huge_network_is_refused_before_anything_is_allocated(saved):
    path = saved[2] / "config.json"
    config = json.loads(path.read_text())
    config["network"] |= {"first_channels": 4096, "hidden_channels": 4096, "layers": 16, "kernel_size": 32}
    path.write_text(json.dumps(config))
    with pytest.raises(ConfigError, match="the network would have .* learned values, more than 100,000,000"):
        load_model(saved[2])
    with pytest.raises(ConfigError, match="the network would have"):
        saved[0].build_model(configured(**config["network"]), 0)


def test_a_huge_list_of_contents_is_refused(saved):
    (saved[2] / "model.safetensors").write_bytes((2**40).to_bytes(8, "little") + b"{}")
    with pytest.raises(ConfigError, match="damaged weights .its list of contents is too long"):
        load_model(saved[2])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("config.json", "[" * 100_000, r"config\.json: not JSON .*more than 32 tables"),
        ("config.json", "[]", r"config\.json: input should be"),
        ("card.json", "[]", r"card\.json: input should be"),
        ("card.json", '{"data": [1]}', r"card\.json: `data`: input should be a valid dictionary"),
        ("card.json", '{"data_seed": 1e300}', r"card\.json: `data_seed`: input should be a valid integer"),
        ("card.json", '{"valid_error": NaN}', r"card\.json: not JSON .NaN is no number"),
    ],
)
def test_a_damaged_description_is_named(saved, name, text, message):
    (saved[2] / name).write_text(text)
    read = load_model if name == "config.json" else read_card
    with pytest.raises(ConfigError, match=message):
        read(saved[2])
