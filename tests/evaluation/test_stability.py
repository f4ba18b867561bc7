"""Checks of stability against what they must say of models whose failures are known."""

import json
import math

import pytest
import torch

from cconv.data.targets import make_sample
from cconv.data.trajectory import Boundary, ParticleType, Scene, Trajectory
from cconv.domain import Box
from cconv.evaluation.stability import (
    NOT_FINITE,
    Thresholds,
    density_rollout,
    measure_stability,
    precision,
    regime_errors,
    stressed_error,
    stressed_frames,
)
from cconv.neighbors import radius_graph
from cconv.sph import CubicSpline
from cconv.training.closed_form import solve_closed_form
from cconv.training.field_model import NetworkConfig, build_field_model

SPACING = 0.1
NETWORK = NetworkConfig(layers=1, basis="radial", message="difference", relative_cutoff=2.0)


def scene_of(box, has_boundary=False):
    return Scene(
        name="test", dim=box.dim, particle_spacing=SPACING, frame_dt=0.01, box=box, force=None,
        has_boundary=has_boundary, velocity_source="stored", mass_source="stored", missing=(),
    )  # fmt: skip


def drop(generator, frames=5):
    """A disc of particles in open space over a wall, in a swirling, stretching flow."""
    ticks = torch.arange(-0.75, 0.76, SPACING, dtype=torch.float64)
    points = torch.cartesian_prod(ticks, ticks)
    start = points[points.norm(dim=1) < 0.72]
    start = start + 0.02 * (2 * torch.rand(start.shape, generator=generator, dtype=torch.float64) - 1)
    positions, velocities = [start], []
    for _ in range(frames):
        x, y = positions[-1].unbind(dim=1)
        velocities.append(torch.stack([-y + 0.8 * x * x, x - 0.5 * torch.sin(3 * y)], dim=1))
        positions.append(positions[-1] + 0.01 * velocities[-1])
    wall = torch.stack([ticks, torch.full_like(ticks, -0.8)], dim=1).float()
    normals = torch.tensor([0.0, 1.0]).expand_as(wall).clone()
    trajectory = Trajectory(
        name="drop", first_frame=0, positions=torch.stack(positions[:-1]).float(),
        velocities=torch.stack(velocities).float(), masses=torch.full((len(start),), SPACING**2),
        particle_types=torch.full((len(start),), int(ParticleType.FLUID)),
        boundary=Boundary(positions=wall, normals=normals),
    )  # fmt: skip
    return trajectory, scene_of(Box((-2.0, -2.0), (2.0, 2.0)), has_boundary=True)


@pytest.fixture
def system(generator):
    trajectory, scene = drop(generator)
    samples = [make_sample(frame, scene, "density_rate", CubicSpline(SPACING, 2)) for frame in trajectory]
    model = build_field_model(NETWORK, scene, "density_rate", "cubic_spline", SPACING, samples)
    solve_closed_form(model, samples)
    return model.eval(), trajectory, scene


@pytest.fixture
def untrained(system):
    model, trajectory, scene = system
    samples = [make_sample(frame, scene, "density_rate", CubicSpline(SPACING, 2)) for frame in trajectory]
    network = NetworkConfig(layers=2, first_channels=4, hidden_channels=4)
    return build_field_model(
        network, scene, "density_rate", "cubic_spline", SPACING, samples, torch.Generator().manual_seed(0)
    )


def test_a_model_of_the_exact_form_is_stable_and_an_untrained_one_is_not(system, untrained):
    model, trajectory, scene = system
    good, bad = (measure_stability(each, [trajectory], scene) for each in (model, untrained))
    assert good["stable"]
    assert good["failures"] == []
    assert not bad["stable"]
    assert any("regime bulk" in line for line in bad["failures"])
    assert any("frame as_it_is" in line for line in bad["failures"])
    json.dumps([good, bad], allow_nan=False)


def test_each_threshold_decides_about_its_own_check(system):
    model, trajectory, scene = system
    for name, word in (
        ("stressed_error", "on the frame"),
        ("regime_error", "in regime"),
        ("precision", "float32"),
        ("density", "integrated density"),
    ):
        checks = measure_stability(model, [trajectory], scene, Thresholds(**{name: 0.0}))
        assert checks["failures"]
        assert all(word in line for line in checks["failures"])


def test_regimes_share_out_all_particles_and_their_errors(system, untrained):
    _, trajectory, scene = system
    frames = list(trajectory)
    regimes = regime_errors(untrained, frames, scene)
    for names in (
        ["near_wall", "free_surface", "bulk"],
        [name for name in regimes if name.startswith("neighbors")],
        [name for name in regimes if name.startswith("speed")],
    ):
        present = [regimes[name] for name in names if name in regimes]
        assert sum(regime["share"] for regime in present) == pytest.approx(1.0)
        mean = sum(regime["share"] * regime["normalized_mse"] for regime in present)
        assert mean == pytest.approx(sum(_errors(untrained, frames, scene)) / len(frames), rel=1e-5)
    assert 0.02 < regimes["near_wall"]["share"] < 0.4
    assert 0.1 < regimes["free_surface"]["share"] < 0.7


def _errors(model, frames, scene):
    for frame in frames:
        sample = make_sample(frame, scene, model.config.task, model.kernel)
        difference = model.predict(sample.inputs) - sample.target
        yield float((difference / model.target_scale).square().mean())


def test_stressed_frames_are_what_they_say(system):
    _, trajectory, scene = system
    frame = trajectory[2]
    stressed = stressed_frames(frame, scene)
    near = {
        name: float(radius_graph(changed.positions.double(), 1.0, its.box).distances.min())
        for name, (changed, its) in stressed.items()
    }
    assert near["half_spacing"] == pytest.approx(near["as_it_is"] / 2, rel=1e-4)
    assert near["double_spacing"] == pytest.approx(near["as_it_is"] * 2, rel=1e-4)
    assert near["clumped"] < 0.11 * SPACING
    assert near["mirrored"] == pytest.approx(near["as_it_is"], rel=1e-4)
    isolated = stressed["isolated"][0]
    counts = radius_graph(isolated.positions.double(), 2 * SPACING, scene.box).row_splits.diff()
    assert (counts == 0).any()
    assert torch.equal(stressed["ten_times_as_fast"][0].velocities, 10 * frame.velocities)
    turned, its = stressed["turned"]
    assert torch.equal(turned.velocities[:, 1], frame.velocities[:, 0])
    assert torch.equal(turned.boundary.normals[:, 0], -frame.boundary.normals[:, 1])
    kernel = CubicSpline(SPACING, 2)
    targets = [
        make_sample(each, where, "density_rate", kernel).target for each, where in (stressed["turned"], (frame, scene))
    ]
    torch.testing.assert_close(*targets, rtol=1e-4, atol=1e-4)


def test_periodic_boxes_are_scaled_and_turned_with_their_particles(generator):
    box = Box((0.0, -1.0), (1.0, 1.0), periodic=(True, False))
    particles = torch.rand(100, 2, generator=generator) * torch.tensor([1.0, 1.5]) - torch.tensor([0.0, 0.9])
    trajectory = Trajectory(
        name="strip", first_frame=0, positions=particles[None], velocities=torch.randn(1, 100, 2, generator=generator),
        masses=torch.full((100,), 0.01), particle_types=torch.zeros(100, dtype=torch.long), boundary=None,
    )  # fmt: skip
    stressed = stressed_frames(trajectory[0], scene_of(box))
    assert stressed["stretched"][1].box.lengths == pytest.approx((1.3, 2.0))
    assert stressed["turned"][1].box.periodic == (False, True)
    assert stressed["turned"][1].box.lengths == pytest.approx((2.0, 1.0))
    kernel = CubicSpline(SPACING, 2)
    plain = make_sample(*stressed["as_it_is"], "density_rate", kernel).target
    for name in ("turned", "mirrored"):
        torch.testing.assert_close(
            make_sample(*stressed[name], "density_rate", kernel).target, plain, rtol=1e-4, atol=1e-4
        )


def test_radial_models_turn_with_the_scene(system):
    model, trajectory, scene = system
    frames = stressed_frames(trajectory[2], scene)
    plain, turned, mirrored = (stressed_error(model, *frames[name]) for name in ("as_it_is", "turned", "mirrored"))
    assert turned == pytest.approx(plain, rel=1e-3)
    assert mirrored == pytest.approx(plain, rel=1e-3)


def test_the_analytic_rate_itself_does_not_drift(system, monkeypatch):
    model, trajectory, scene = system
    samples = iter([make_sample(frame, scene, "density_rate", model.kernel) for frame in trajectory])
    monkeypatch.setattr(type(model), "predict", lambda self, inputs: next(samples).target)
    rollout = density_rollout(model, trajectory, scene)
    assert rollout == {"frames": 5, "drift": 0.0, "largest": 0.0, "first_frame_outside": None}


def test_a_constant_bias_drifts_by_time_and_leaves_the_band_when_it_must(system, monkeypatch):
    model, trajectory, scene = system
    exact = [make_sample(frame, scene, "density_rate", model.kernel).target for frame in trajectory]
    targets = iter(exact)
    monkeypatch.setattr(type(model), "predict", lambda self, inputs: next(targets) + 1.0)
    rollout = density_rollout(model, trajectory, scene, limit=0.025)
    assert rollout["drift"] == pytest.approx(4 * 0.01 * 1.0 / 0.9, rel=0.3)  # densities are near 0.9 on average
    assert rollout["first_frame_outside"] in (2, 3)


def test_predictions_that_are_not_finite_fail_every_check(system, monkeypatch):
    model, trajectory, scene = system
    monkeypatch.setattr(
        type(model), "forward", lambda self, inputs, geometry: torch.full((inputs.num_particles, 1), math.nan)
    )
    checks = measure_stability(model, [trajectory], scene)
    assert not checks["stable"]
    assert checks["regimes"]["bulk"]["normalized_mse"] == NOT_FINITE
    assert checks["stress"]["as_it_is"] == NOT_FINITE
    assert checks["density_rollout"]["first_frame_outside"] is not None
    json.dumps(checks, allow_nan=False)


def test_float32_is_close_to_float64(system):
    assert 0 < precision(*_frame(system)) < 1e-3


def _frame(system):
    model, trajectory, scene = system
    return model, trajectory[0], scene
