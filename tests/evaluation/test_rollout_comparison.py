"""All metrics of a rollout together: 0 beside itself, and the single metrics of the fluid beside another."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import wasserstein_distance
from systems import periodic_frame, periodic_scene, window_of

from cconv.data.trajectory import ParticleType
from cconv.errors import ConfigError, ShapeError
from cconv.evaluation.particle_distribution import chamfer_distance, sinkhorn_divergence, surroundings
from cconv.evaluation.rollout_comparison import rollout_metrics
from cconv.evaluation.rollout_metrics import kinetic_energies, momentum_drift

SCENE = periodic_scene()
DISTANCES = ("mse", "e_kin_mse", "chamfer", "sinkhorn", "neighbors_distance", "speeds_distance")


@pytest.fixture
def stored(generator):
    """Seven stored frames of 64 particles, and which of them are fluid: all but eight."""
    window = window_of(periodic_frame(generator), generator, future=6)
    types = window.particle_types.clone()
    types[::8] = ParticleType.SOLID_WALL
    window = replace(window, particle_types=types)
    return torch.cat([window.present[None], window.future]).double(), window.masses, window.is_fluid


@pytest.fixture
def noisy(stored, generator):
    """The same from the second frame on with noise, also of the walls."""
    positions = stored[0].clone()
    positions[1:] += 0.02 * torch.randn(positions[1:].shape, generator=generator, dtype=torch.float64)
    return positions


def test_a_path_has_no_distance_to_itself_and_its_images(stored):
    path, masses, is_fluid = stored
    found = rollout_metrics(path, path, masses, is_fluid, SCENE, stride=2)
    assert found.frames.tolist() == found.sinkhorn_frames.tolist() == [2, 4, 6]
    assert all((getattr(found, name) == 0).all() for name in DISTANCES)
    moved = rollout_metrics(path + torch.tensor([3.0, -1.0]), path, masses, is_fluid, SCENE, stride=2)
    assert all(np.allclose(getattr(moved, name), 0, atol=1e-6) for name in DISTANCES)
    for name, series in found.as_dict()["rollout"].items():
        assert np.allclose(series, moved.as_dict()["reference"][name]), name


def test_metrics_are_those_of_the_fluid_in_each_frame(stored, noisy):
    path, masses, is_fluid = stored
    found = rollout_metrics(noisy, path, masses, is_fluid, SCENE, stride=3, sinkhorn_stride=2)
    assert (found.frames.tolist(), found.sinkhorn_frames.tolist()) == ([3, 6], [3])
    fluid, true = noisy[:, is_fluid], path[:, is_fluid]
    assert np.allclose(found.mse, (noisy - path)[1:].square().mean(dim=(1, 2)))
    energies = [kinetic_energies(each, SCENE.box, 1 / 8, 0.01)[[2, 5]].numpy() for each in (fluid, true)]
    assert np.allclose(found.rollout.e_kin, energies[0])
    assert np.allclose(found.e_kin_mse, np.square(energies[0] - energies[1]))
    assert np.allclose(found.rollout.momentum_drift, momentum_drift(fluid, masses[is_fluid], SCENE.box)[[2, 5]])
    assert found.chamfer[1] == chamfer_distance(fluid[6], true[6], SCENE.box)
    assert found.sinkhorn[0] == sinkhorn_divergence(fluid[3], true[3], SCENE.box)
    speeds = [(each[6] - each[5]).norm(dim=1) / 0.01 for each in (fluid, true)]
    assert found.speeds_distance[1] == pytest.approx(wasserstein_distance(*speeds))
    assert found.speed_edges[-1] == pytest.approx(
        max(float(each.norm(dim=1).max()) for each in true.diff(dim=0)[2::3]) / 0.01
    )


def test_densities_are_of_the_fluid_among_all_particles(stored, noisy):
    path, masses, is_fluid = stored
    found = rollout_metrics(noisy, path, masses, is_fluid, SCENE, stride=6)
    around = surroundings(noisy[6], torch.full((64,), 1 / 64), SCENE.box, 1 / 8)
    densities = around.densities[is_fluid].numpy()
    assert found.rollout.rho_mae_unclamped == pytest.approx(np.abs(densities - 1).mean())
    assert found.rollout.rho_mae == pytest.approx(np.abs(np.where(densities < 0.98, 1, densities) - 1).mean())
    assert (found.rollout.rho_min[0], found.rollout.rho_max[0]) == (densities.min(), densities.max())
    assert found.rollout.dirichlet == pytest.approx(float(around.gradients[is_fluid].square().sum()) / 64 / 2)
    assert found.rollout.neighbors.sum() == found.rollout.speeds.sum() == pytest.approx(1)
    differing = np.abs(found.rollout.neighbors - found.reference.neighbors).sum() / 2
    assert 0 < found.neighbors_distance[0] == pytest.approx(differing)


def test_metrics_can_be_written_as_json(stored, noisy):
    found = rollout_metrics(noisy, stored[0], *stored[1:], SCENE, stride=3)
    read = json.loads(json.dumps(found.as_dict()))
    assert read["mse"] == found.mse.tolist()
    assert read["rollout"]["neighbors"] == found.rollout.neighbors.tolist()


def test_still_water_has_metrics(stored):
    path = stored[0][:1].expand(3, -1, -1)
    found = rollout_metrics(path, path, *stored[1:], SCENE, stride=1)
    assert found.rollout.speeds[:, 0].tolist() == [1, 1]


def test_what_does_not_fit_is_refused(stored):
    path, masses, is_fluid = stored
    with pytest.raises(ShapeError, match="`reference` must have shape"):
        rollout_metrics(path, path[:3], masses, is_fluid, SCENE)
    with pytest.raises(ConfigError, match="`stride` must be from 1 to the 6 frames"):
        rollout_metrics(path, path, masses, is_fluid, SCENE)
    with pytest.raises(ConfigError, match="`sinkhorn_stride` must be at least 1"):
        rollout_metrics(path, path, masses, is_fluid, SCENE, stride=2, sinkhorn_stride=0)
