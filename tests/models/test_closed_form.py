import pytest
import torch

import cconv
from cconv.errors import ConfigError
from cconv.models.checkpoint import load_model, save_model
from cconv.models.closed_form import fit_closed_form
from cconv.models.errors import frame_errors, normalized_mse
from cconv.networks import ConvNetSettings, RadialNetSettings
from cconv.tasks import task_named
from cconv.tasks.samples import iterate_samples

GRID = ConvNetSettings(layers=1, message="difference", relative_cutoff=2.0, kernel_size=4)


@pytest.fixture(scope="module")
def flow(flow_folder):
    return cconv.open_dataset(flow_folder)


def valid_error(model, flow, task):
    return normalized_mse(frame_errors(model, list(iterate_samples(flow, "valid", task_named(task)))))


@pytest.mark.parametrize(("task", "bound"), [("density_rate", 1e-3), ("density_gradient", 5e-2)])
def test_radial_terms_hold_what_a_grid_of_more_parameters_does_not(task, bound, flow):
    """D2 to the accuracy of hats; D3 but for its factor 1/ρ_i, which is not linear in the features."""
    radial, grid = (fit_closed_form(flow, task, network=network) for network in (None, GRID))
    assert radial.num_parameters < grid.num_parameters
    assert valid_error(radial, flow, task) < bound
    assert valid_error(radial, flow, task) < valid_error(grid, flow, task) < 1


def test_more_terms_are_more_accurate(flow):
    errors = [
        valid_error(
            fit_closed_form(
                flow,
                network=RadialNetSettings(layers=1, message="difference", relative_cutoff=2.0, radial_terms=terms),
            ),
            flow,
            "density_rate",
        )
        for terms in (4, 8, 16)
    ]
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("network", [None, GRID])
def test_saves_loads_and_evaluates_as_any_model(network, flow, tmp_path):
    model = fit_closed_form(flow, network=network)
    save_model(model, tmp_path / "model", card={})
    frame = flow.trajectory("valid", 0)[0]
    prediction = model.predict_frame(frame, flow.scene)
    assert torch.equal(load_model(tmp_path / "model").predict_frame(frame, flow.scene), prediction)


def test_public_names():
    assert cconv.fit_closed_form is fit_closed_form


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"network": ConvNetSettings()}, "`network.layers` must be 1"),
        ({"ridge": -1.0}, "`ridge` must be at least 0"),
        ({"task": "density"}, "task"),
    ],
)
def test_bad_input_is_named(arguments, message, flow):
    with pytest.raises(ConfigError, match=message):
        fit_closed_form(flow, **arguments)
