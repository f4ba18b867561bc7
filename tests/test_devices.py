"""Devices by their names, and what they stand for on a machine without a GPU, with one, and with several."""

from itertools import islice

import pytest
import torch
from conftest import SMOKE
from outcomes import assert_one_clear_line
from simulated_device import DEVICE, simulated_device
from systems import configured, model_of, observed_and_sample, periodic_frame, periodic_scene, problem, steps_problem

from cconv.devices import find_device, home_of, name_of, wait_for
from cconv.errors import ConfigError
from cconv.evaluation.checks.predictor import ModelPredictor
from cconv.evaluation.cost import measure_costs
from cconv.models.checkpoint import load_model, read_card, save_model
from cconv.rollout.rollout import rollout
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.run_folder import RunFolder
from cconv.study.running import trial as trials
from cconv.study.running.trial import Trial, run_trial

CPU = torch.device("cpu")
NETWORKS = [{"layers": 2, "kernel_size": 3}, {"architecture": "radial_net", "layers": 2, "radial_terms": 4}]


@pytest.fixture
def gpus(monkeypatch):
    """Let torch find so many NVIDIA GPUs."""

    def find(count):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)

    return find


def test_auto_is_the_first_gpu_or_else_the_cpu(gpus):
    gpus(0)
    assert find_device("auto") == find_device("cpu") == CPU
    gpus(2)
    assert find_device("auto") == find_device("cuda") == torch.device("cuda", 0)
    assert find_device("cuda:1") == torch.device("cuda", 1)
    assert find_device("cpu") == CPU


@pytest.mark.parametrize(
    ("wish", "count", "reason"),
    [
        ("cuda", 0, "`--device` is cuda, and of NVIDIA GPUs torch finds none"),
        ("cuda:2", 2, r"`--device` is cuda:2, and of NVIDIA GPUs torch finds 2 of them \(cuda:0 to cuda:1\)"),
        ("gpu", 1, "`--device` must be auto, cpu, cuda, cuda:N or mps, got 'gpu'"),
        ("cuda:", 1, "`--device` must be auto"),
    ],
)
def test_a_wish_that_cannot_be_met_says_what_there_is(wish, count, reason, gpus):
    gpus(count)
    with pytest.raises(ConfigError, match=reason):
        find_device(wish)


def test_states_stand_where_float64_is_known():
    assert home_of(torch.device("mps")) == CPU
    assert home_of(torch.device("cuda", 1)) == torch.device("cuda", 1)
    assert name_of(CPU) == "cpu"
    wait_for(CPU)


@pytest.mark.parametrize("command", ["train", "fit", "study run"])
def test_a_missing_device_ends_commands_in_one_line_before_anything_is_written(command, cconv, gpus, tmp_path):
    gpus(0)
    out = tmp_path / "out"
    asked = cconv(*command.split(), SMOKE, "--data", tmp_path, "--out", out, "--device", "cuda:7")
    assert_one_clear_line(asked, "cuda:7", "take cpu or auto")
    assert not out.exists()
    asked = cconv(*command.split(), SMOKE, "--data", tmp_path, "--out", out, "--set", "training.device=gpu")
    assert_one_clear_line(asked, "training.device", "gpu")


@pytest.mark.parametrize("command", ["evaluate", "rollout"])
def test_a_missing_device_ends_commands_on_checkpoints_in_one_line(command, cconv, gpus, tmp_path):
    gpus(0)
    assert_one_clear_line(cconv(command, tmp_path, "--device", "cuda"), "cuda", "take cpu or auto")


FULL = "CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has "  # as torch says it
CAPACITY = "a total capacity of 79.00 GiB of which 19.00 GiB is free. Process 1 has 60.00 GiB memory in use."


@pytest.mark.parametrize(
    ("told", "fewer"), [("1 GiB free.", "fewer particles"), (CAPACITY, "at most about 99% of the")]
)
def test_a_device_without_memory_is_one_line(told, fewer, cconv, monkeypatch, tmp_path):
    def load(*given, **options):
        raise torch.OutOfMemoryError(FULL + told)

    monkeypatch.setattr("cconv.models.checkpoint.load_model", load)
    assert_one_clear_line(cconv("evaluate", tmp_path), "CUDA out of memory", fewer, "--device cpu")


def train_on(monkeypatch, given, folder, device, network):
    """Train a few updates, as a study does, with noise and pushforward where windows allow it."""
    monkeypatch.setattr(trials, "find_device", lambda wish, name: torch.device(device))
    moving = {"noise": 1e-3, "pushforward": 1, "pushforward_from": 0.0} if given.task.name == "acceleration" else {}
    training = TrainingConfig(updates=3, evaluate_every=3, average=0.5, **moving)
    asked = Trial(stage="random", parameters={}, init_seed=1, data_seed=0, provenance={})
    configuration = configured(**network)._replace(training=training, history=given.task.history)
    configuration = configuration._replace(features=given.task.features)
    return list(run_trial(given, asked, configuration, folder))


@pytest.mark.parametrize("network", NETWORKS, ids=["grid", "radial"])
@pytest.mark.parametrize("make", [problem, steps_problem])
def test_a_training_on_a_device_is_the_one_on_the_cpu(make, network, generator, monkeypatch, tmp_path):
    given = make(generator)
    here, away = RunFolder(tmp_path / "a").trial("random_0000"), RunFolder(tmp_path / "b").trial("random_0000")
    expected = train_on(monkeypatch, given, here, "cpu", network)
    with simulated_device():
        found = train_on(monkeypatch, given, away, DEVICE, network)
    assert found[-1]["valid_error"] == pytest.approx(expected[-1]["valid_error"], rel=1e-3)
    assert found[-1]["train_loss"] == pytest.approx(expected[-1]["train_loss"], rel=1e-3)
    assert (read_card(here.checkpoint)["device"], read_card(away.checkpoint)["device"]) == ("cpu", "lazy")
    sample = given.valid_samples[0]
    trained, other = load_model(away.checkpoint), load_model(here.checkpoint)
    expected = other.predict(sample.inputs)
    torch.testing.assert_close(
        trained.predict(sample.inputs), expected, rtol=1e-2, atol=1e-3 * float(expected.abs().max())
    )


def test_a_rollout_stays_on_the_device(generator):
    scene = periodic_scene()
    window, sample = observed_and_sample(periodic_frame(generator), scene, "acceleration", generator)
    model = model_of(configured(layers=1), scene, "acceleration", [sample], generator)
    expected = [each.present for each in islice(rollout(model, window, scene), 3)]
    with simulated_device() as device:
        found = [each.present for each in islice(rollout(model.to(device), window.to(device), scene), 3)]
        assert all(each.device == device for each in found)
        found = [each.cpu() for each in found]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_the_cost_names_the_device_and_frames_stand_there(generator, monkeypatch, tmp_path):
    monkeypatch.setattr("cconv.evaluation.cost.peak_megabytes", lambda load, models, *rest: dict.fromkeys(models, 1.0))
    given = problem(generator)
    save_model(given.build_model(configured(layers=1, kernel_size=3), 0), tmp_path / "model", {})
    frames = [periodic_frame(generator)]
    with simulated_device() as device:
        costs, analytic = measure_costs(
            {"model": tmp_path / "model"},
            lambda path: load_model(path, device=device),
            frames,
            given.scene,
            task=given.task,
            threads=1,
            repeats=3,
        )
    assert costs["model"].device == "lazy"
    assert costs["model"].ms_per_frame > 0
    assert analytic.ms_per_frame > 0


@pytest.mark.parametrize("network", NETWORKS, ids=["grid", "radial"])
def test_products_in_bfloat16_are_off_by_its_rounding(network, generator):
    given = problem(generator)
    frame, scene = periodic_frame(generator), given.scene
    settings = configured(**network)
    errors = {}
    for precision in ("float32", "tf32", "bfloat16"):
        training = TrainingConfig(precision=precision)
        model = given.build_model(settings._replace(training=training), 0)
        assert model.config.precision == precision
        predictor = ModelPredictor(model)
        exact, found = predictor.predict_exactly(frame, scene), predictor.predict(frame, scene)
        assert found.dtype == torch.float32
        errors[precision] = float((found - exact).abs().max() / exact.abs().max())
    assert errors["float32"] == errors["tf32"] < 1e-5  # there is no TF32 on a CPU
    assert 1e-4 < errors["bfloat16"] < 0.1


@pytest.mark.parametrize("network", NETWORKS, ids=["grid", "radial"])
def test_a_network_learns_in_bfloat16(network, generator):
    given = problem(generator)
    gradients = []
    for precision in ("float32", "bfloat16"):
        training = TrainingConfig(precision=precision)
        model = given.build_model(configured(**network)._replace(training=training), 0)
        inputs = given.train_samples[0].inputs
        model(inputs, model.geometry(inputs)).square().mean().backward()
        gradients.append(torch.cat([each.grad.flatten() for each in model.parameters() if each.grad is not None]))
    assert (gradients[1] - gradients[0]).norm() < 0.1 * gradients[0].norm()
