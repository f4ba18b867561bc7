"""What a model has learned, measured on models whose filters are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from systems import configured, kernel, model_of, periodic_frame, periodic_scene

from cconv.evaluation.explanation import error_distribution, explain, first_layer_filters
from cconv.models.closed_form import solve_closed_form
from cconv.tasks import task_named
from cconv.tasks.inputs import Features
from cconv.tasks.samples import make_sample

SIDE = 12
RADIAL = configured(layers=1, architecture="radial_net", message="difference", relative_cutoff=2.0)
GRID = configured(
    layers=1, kernel_size=6, message="difference", relative_cutoff=2.0, mapping="identity", window="poly6"
)


def samples_of(generator, task, count=3):
    """Frames with pairs at all distances: filters are known nowhere else."""
    scene = periodic_scene(SIDE)
    frames = [periodic_frame(generator, SIDE) for _ in range(count)]
    gases = [replace(frame, positions=torch.rand(SIDE**2, 2, generator=generator)) for frame in frames]
    return [make_sample(frame, scene, task_named(task)) for frame in gases]


def built(network, samples, task="density_rate"):
    scene = periodic_scene(SIDE)
    generator = torch.Generator().manual_seed(0)
    return model_of(network, scene, task, samples, generator).eval()


def fitted(network, samples, task="density_rate"):
    model = built(network, samples, task)
    solve_closed_form(model, samples)
    return model


@pytest.mark.parametrize("network", [RADIAL, GRID], ids=["radial", "grid"])
@pytest.mark.parametrize("task", ["density_rate", "density_gradient"])
def test_least_squares_finds_the_gradient_of_the_kernel(generator, network, task):
    samples = samples_of(generator, task)
    filters = first_layer_filters(fitted(network, samples, task), samples[0])
    assert not filters["is_combined"]
    far = filters["radii"] > 0.5 / SIDE  # few pairs are closer, and their densities are too alike to tell a filter
    learned, analytic = filters["learned_radial"][far], filters["analytic_radial"][far]
    assert learned @ analytic > 0.98 * np.linalg.norm(learned) * np.linalg.norm(analytic)
    if task == "density_rate":  # the other's filters are divided by a density that differs from particle to particle
        assert filters["unexplained"] < (0.01 if network is RADIAL else 0.1)


def test_analytic_filters_are_the_printed_formulas(generator):
    """m ∇W(d) on the velocities for D2, -m ∇W(d)/ρ on the density for D3, with mass dx² and the mean density."""
    scene, mass = periodic_scene(SIDE), SIDE**-2.0
    for task, sign in (("density_rate", 1), ("density_gradient", -1)):
        samples = samples_of(generator, task, 1)
        filters = first_layer_filters(built(RADIAL, samples, task), samples[0])
        line = torch.from_numpy(filters["line"])
        gradient = sign * mass * (kernel(scene).derivative(line.abs()) * line.sign()).numpy()
        if task == "density_gradient":
            gradient = gradient / float(samples[0].inputs.features.scalars[:, 1].mean())
        for axis in range(2):
            along = filters["analytic_on_axes"][axis]
            found = along[:, 2 + axis, 0] if task == "density_rate" else along[:, 1, axis]
            np.testing.assert_allclose(found, gradient, rtol=1e-5, atol=1e-5 * abs(gradient).max())
            assert np.count_nonzero(np.abs(along).max(axis=(0, 2)) > 1e-9) == 1


def test_a_layer_answers_with_its_filters(generator):
    """A grid of one cell is the window times the same weights at every place, in the units of the data."""
    samples = samples_of(generator, "density_rate", 1)
    model = built(configured(GRID, kernel_size=1), samples)
    filters = first_layer_filters(model, samples[0])
    inside = (1 - (filters["line"] / model.cutoff) ** 2).clip(0) ** 3
    weights = model.network.convs[0].filters.detach().double()[0, 0]
    units = samples[0].inputs.units
    per_unit = torch.tensor([units.density, units.velocity, units.velocity])[:, None]
    weights = weights[[2, 0, 1]]  # of the published order, velocity and density
    weights = weights / model.feature_scale[1:, None] * model.target_scale * samples[0].target_unit / per_unit
    weights = torch.cat([torch.zeros(1, 1), weights]).numpy()  # differences of the constant are 0
    for axis in range(2):
        expected = inside[:, None, None] * weights
        np.testing.assert_allclose(filters["learned_on_axes"][axis], expected, rtol=1e-5, atol=1e-7)


def test_radial_filters_are_the_same_in_all_directions_and_grids_are_not(generator):
    samples = samples_of(generator, "density_rate")
    spread = {}
    for name, network in (("radial", RADIAL), ("grid", GRID)):
        filters = first_layer_filters(fitted(network, samples), samples[0])
        spread[name] = abs(filters["learned_radial_high"] - filters["learned_radial_low"]).max()
        spread[name] /= abs(filters["analytic_radial"]).max()
    assert spread["radial"] < 1e-6 < spread["grid"]


def test_normalised_filters_are_divided_by_the_mean_sum_of_windows(generator):
    samples = samples_of(generator, "density_rate", 1)
    plain, normalized = (
        first_layer_filters(built(configured(GRID, normalize=value), samples), samples[0]) for value in (False, True)
    )
    ratio = plain["learned_on_axes"] / np.where(normalized["learned_on_axes"] == 0, 1, normalized["learned_on_axes"])
    sums = ratio[ratio != 0]
    assert sums.std() < 1e-6 * sums.mean()
    assert 1 < sums.mean() < 12


@pytest.mark.parametrize("architecture", ["conv_net", "radial_net"])
def test_outputs_of_deeper_networks_are_combined_never_worse_than_nothing(generator, architecture):
    samples = samples_of(generator, "density_rate", 1)
    wide = configured(layers=2, architecture=architecture, first_channels=24, hidden_channels=8, relative_cutoff=2.0)
    narrow = configured(wide, first_channels=1)
    found = [first_layer_filters(built(network, samples), samples[0]) for network in (narrow, wide)]
    assert all(filters["is_combined"] for filters in found)
    assert 0 <= found[1]["unexplained"] < found[0]["unexplained"] <= 1


def test_models_without_density_or_with_walls_are_explained(generator):
    samples = samples_of(generator, "density_rate", 1)
    filters = first_layer_filters(built(configured(RADIAL, density=False), samples), samples[0])
    assert abs(filters["learned_on_axes"][:, :, 1]).max() == 0
    ones = Features(scalars=torch.ones(7, 1), vectors=torch.zeros(7, 0, 2), scalar_names=("one",), vector_names=())
    walled = replace(
        samples[0],
        inputs=replace(samples[0].inputs, wall_positions=torch.rand(7, 2), wall_features=ones),
    )
    model = built(GRID, [walled])
    assert explain(model, walled)["prediction"].shape == (SIDE**2, 1)


def test_fields_are_those_of_the_model_and_files_need_no_pickle(generator, tmp_path):
    samples = samples_of(generator, "density_gradient", 2)
    model = fitted(RADIAL, samples, "density_gradient")
    np.savez(tmp_path / "best.npz", **explain(model, samples[1]), **error_distribution(model, samples))
    with np.load(tmp_path / "best.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["prediction"], model.predict(samples[1].inputs).numpy())
        np.testing.assert_array_equal(arrays["target"], (samples[1].target * SIDE).numpy())  # ρ0/dx
        assert arrays["error"].shape == (SIDE**2,)


def test_mean_squared_particle_error_is_the_normalized_mse(generator):
    from cconv.models.errors import frame_errors

    (sample,) = samples_of(generator, "density_gradient", 1)
    model = built(GRID, [sample], "density_gradient")
    (frame,) = frame_errors(model, [sample])
    assert explain(model, sample)["error"].mean() == pytest.approx(frame.normalized_mse, rel=1e-4)


def test_error_distribution_counts_every_particle_also_what_is_not_finite(generator):
    samples = samples_of(generator, "density_rate", 2)
    model = fitted(RADIAL, samples)
    found = error_distribution(model, samples)
    assert found["error_counts"].sum() == 2 * SIDE**2
    assert (np.diff(found["error_quantiles"]) >= 0).all()
    median = found["error_quantiles"][list(found["error_levels"]).index(0.5)]
    assert 0 < median < 0.05
    with torch.no_grad():
        model.network.convs[0].scalar_filters.fill_(float("nan"))
    broken = error_distribution(model, samples)
    assert broken["error_counts"][-1] == 2 * SIDE**2
