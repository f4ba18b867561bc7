"""Checks of stability: analytic SPH passes them all, and each planted fault is caught by name."""

import json
import math
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from evaluation.flows import SPACING, flow
from evaluation.planted_faults import FAULTS, Analytic, Spoiled, Usual
from systems import configured, model_of

from cconv.evaluation import probes as probing
from cconv.evaluation.probes import make_probes
from cconv.evaluation.stability import (
    NOT_FINITE,
    ModelPredictor,
    Thresholds,
    density_rollout,
    measure_stability,
    regime_errors,
    stressed_error,
)
from cconv.models.closed_form import solve_closed_form
from cconv.neighbors import radius_graph
from cconv.sph import CubicSpline
from cconv.tasks import task_named
from cconv.tasks.samples import make_sample

pytestmark = pytest.mark.integration

NETWORK = configured(layers=1, architecture="radial_net", message="difference", relative_cutoff=2.0)
TASKS = ("density_rate", "density_gradient")
SCENES = [
    {"dim": dim, "walls": walls, "periodic": periodic}
    for dim in (2, 3)
    for walls, periodic in ((False, False), (True, False), (False, True), (True, True))
]


@lru_cache
def system(task, dim, walls, periodic):
    """Trajectory, scene, kernel and probes of a flow."""
    trajectory, scene = flow(dim, walls=walls, periodic=periodic, frames=7 if dim == 2 else 3)
    kernel = CubicSpline(SPACING, dim)
    return trajectory, scene, kernel, make_probes([trajectory], scene, task_named(task))


def usual_of(trajectory, scene, probes):
    counts = [
        radius_graph(frame.positions.double(), 2 * SPACING, scene.box).row_splits.diff().double()
        for frame in trajectory
    ]
    return Usual(
        spacing=SPACING,
        neighbors=float(torch.cat(counts).median()),
        fastest=float(trajectory.velocities.norm(dim=2).max()),
        rate=probes.typical**0.5,
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("scene", SCENES, ids=str)
def test_analytic_sph_passes_every_check(scene, task, dtype):
    *_, kernel, probes = system(task, **scene)
    checks = measure_stability({"it": Analytic(task=task, kernel=kernel, dtype=dtype)}, probes)
    assert checks["failures"] == []
    assert checks["stable"]
    json.dumps(checks, allow_nan=False)


def _places(fault):
    """Scenes in which a fault can be planted: all in 2D, in 3D those whose finding depends on the dimension."""
    walls, periodic = fault.needs_walls, fault.needs_periodic or not (fault.needs_walls or fault.needs_open)
    return [{"dim": dim, "walls": walls, "periodic": periodic} for dim in ((2, 3) if fault.in_3d else (2,))]


@pytest.mark.parametrize("name", FAULTS)
def test_each_planted_fault_is_caught_by_name(name):
    fault = FAULTS[name]
    for place in _places(fault):
        for task in fault.tasks:
            trajectory, scene, kernel, probes = system(task, **place)
            usual = usual_of(trajectory, scene, probes)
            spoiled = Spoiled(task=task, kernel=kernel, usual=usual, fault=fault.spoil)
            failures = measure_stability({"it": spoiled}, probes)["failures"]
            assert any(fault.named in line for line in failures), (place, task, failures)


def test_a_planted_fault_is_one_of_few_findings():
    """Faults in one situation leave the others alone, so that the name says where to look."""
    trajectory, scene, kernel, probes = system("density_rate", dim=2, walls=False, periodic=True)
    usual = usual_of(trajectory, scene, probes)
    for name in ("zero for pairs closer than 0.2 spacings", "explosion beyond 20 times the largest speed"):
        spoiled = Spoiled(task="density_rate", kernel=kernel, usual=usual, fault=FAULTS[name].spoil)
        (line,) = measure_stability({"it": spoiled}, probes)["failures"]
        assert FAULTS[name].named in line
        assert "trajectory flow, frame" in line


def test_a_fault_of_few_particles_is_not_averaged_away():
    """One particle in a thousand is off by the typical rate; where it is the one that counts, nothing else does."""
    *_, probes = system("density_rate", dim=2, walls=False, periodic=True)
    wrong = torch.zeros(1000, 1)
    wrong[7] = 1.0
    probe = replace(
        probes.stressed[0], target=torch.zeros(1000, 1).double(), affected=wrong[:, 0] > 0, scale=1.0
    )  # fmt: skip

    class Constant(Analytic):
        def predict(self, frame, scene):
            return wrong

    constant = Constant(task="density_rate", kernel=None)
    assert stressed_error(constant, probe) == 1.0
    everywhere = replace(probe, affected=torch.ones(1000, dtype=torch.bool))
    assert stressed_error(constant, everywhere) == pytest.approx(1e-3)


def test_particles_that_were_changed_are_those_that_count():
    *_, probes = system("density_rate", dim=2, walls=False, periodic=True)
    counted = {probe.name: float(probe.affected.double().mean()) for probe in probes.stressed}
    plain = probes.plain[0].frame.positions
    clumped = next(probe for probe in probes.stressed if probe.name == "clumped")
    moved = (clumped.frame.positions != plain).any(dim=1)
    assert 4 <= moved.sum() <= 8
    assert bool(clumped.affected[moved].all())
    assert int(clumped.affected.sum()) == 2 * int(moved.sum())
    assert counted["as_it_is"] == counted["turned"] == 1
    assert 0 < counted["squeezed"] < 1


def test_a_model_is_stable_only_if_all_its_seeds_are():
    trajectory, scene, kernel, probes = system("density_rate", dim=2, walls=False, periodic=True)
    good = Analytic(task="density_rate", kernel=kernel)
    bad = Spoiled(
        task="density_rate", kernel=kernel, usual=usual_of(trajectory, scene, probes),
        fault=FAULTS["no number for isolated particles"].spoil,
    )  # fmt: skip
    checks = measure_stability({"seed_1": good, "seed_2": bad, "seed_3": good}, probes)
    assert not checks["stable"]
    assert all("seeds seed_2 of 3" in line for line in checks["failures"])
    assert any("isolated" in line for line in checks["failures"])
    assert checks["stress"]["isolated"] == NOT_FINITE
    assert checks["counts"]["seeds"] == 3


def test_frames_from_start_to_end_are_stressed():
    trajectory, *_, probes = system("density_rate", dim=2, walls=False, periodic=True)
    origins = list(dict.fromkeys(probe.origin for probe in probes.stressed))
    assert origins == [f"trajectory flow, frame {index}" for index in (0, 3, 6)]
    assert len(trajectory) == 7


@pytest.fixture
def model():
    """A model of the exact form."""
    trajectory, scene, kernel, _ = system("density_rate", dim=2, walls=True, periodic=False)
    return solved(trajectory, scene, kernel)


def solved(trajectory, scene, kernel):
    samples = [make_sample(frame, scene, task_named("density_rate")) for frame in trajectory]
    model = model_of(NETWORK, scene, "density_rate", samples)
    solve_closed_form(model, samples)
    return model.eval()


def probes_of_model():
    return system("density_rate", dim=2, walls=True, periodic=False)[-1]


def test_an_untrained_model_is_not_stable():
    trajectory, scene, kernel, probes = system("density_rate", dim=2, walls=True, periodic=False)
    samples = [make_sample(frame, scene, task_named("density_rate")) for frame in trajectory]
    network = configured(layers=2, first_channels=4, hidden_channels=4)
    generator = torch.Generator().manual_seed(0)
    model = model_of(network, scene, "density_rate", samples, generator)
    checks = measure_stability({"it": ModelPredictor(model)}, probes)
    assert not checks["stable"]
    assert any("regime bulk" in line for line in checks["failures"])
    assert any("frame as_it_is" in line for line in checks["failures"])
    json.dumps(checks, allow_nan=False)


def test_each_threshold_decides_about_its_own_check(model):
    failing = {
        name: measure_stability({"it": ModelPredictor(model)}, probes_of_model(), Thresholds(**{name: 0.0}))["failures"]
        for name in ("stressed_error", "regime_error", "precision", "density")
    }
    usual = set(measure_stability({"it": ModelPredictor(model)}, probes_of_model())["failures"])
    words = {
        "stressed_error": "on the frame", "regime_error": "in regime", "precision": "float32", "density": "integrated",
    }  # fmt: skip
    for name, lines in failing.items():
        own = [line for line in lines if "(limit 0)" in line]
        assert own
        assert all(words[name] in line for line in own)
        assert {line for line in lines if line not in own} <= usual


def test_regimes_share_out_all_particles_and_their_errors(model):
    probes = probes_of_model()
    errors = regime_errors(ModelPredictor(model), probes)
    shares = {name: regime.share for name, regime in probes.regimes.items()}
    whole = torch.cat([(model.predict_frame(each.frame, each.scene) - each.target)[:, 0] for each in probes.plain])
    for names in (
        ["near_wall", "free_surface", "bulk"],
        [name for name in shares if name.startswith("neighbors")],
        [name for name in shares if name.startswith("speed")],
    ):
        present = [name for name in names if name in shares]
        assert sum(shares[name] for name in present) == pytest.approx(1.0)
        mean = sum(shares[name] * errors[name] * probes.regimes[name].scale for name in present)
        assert mean == pytest.approx(float(whole.square().mean()), rel=1e-5)


def test_the_integral_of_the_analytic_rate_does_not_drift():
    *_, kernel, probes = system("density_rate", dim=2, walls=False, periodic=True)
    rollout = density_rollout(Analytic(task="density_rate", kernel=kernel, dtype=torch.float64), probes)
    assert (rollout["frames"], rollout["drift"], rollout["largest"]) == (7, 0.0, 0.0)
    assert rollout["first_frame_outside"] is None


def test_frames_that_lie_apart_spoil_the_integral_of_the_rate_but_not_the_check():
    """The same flow in steps of one frame and of six: a bias drifts alike, though the rate alone is far off."""
    *_, kernel, probes = system("density_rate", dim=2, walls=False, periodic=True)
    coarse = replace(
        probes.rollout, frames=probes.rollout.frames[::6], targets=probes.rollout.targets[::6],
        densities=probes.rollout.densities[::6],
        scene=replace(probes.rollout.scene, frame_dt=6 * probes.rollout.scene.frame_dt),
    )  # fmt: skip
    usual = Usual(spacing=SPACING, neighbors=12, fastest=1.0, rate=probes.typical**0.5)
    spoiled = Spoiled(task="density_rate", kernel=kernel, usual=usual, fault=FAULTS["a bias that drifts"].spoil)
    fine, apart = (density_rollout(spoiled, replace(probes, rollout=each)) for each in (probes.rollout, coarse))
    assert apart["drift"] == pytest.approx(fine["drift"], rel=1e-3)
    assert apart["largest"] == pytest.approx(fine["largest"], rel=1e-3)
    assert apart["analytic_by_frames"] > 0.05  # by which the rate alone, summed over frames, misses the density


def test_predictions_that_are_not_finite_fail_every_check():
    *_, kernel, probes = system("density_rate", dim=2, walls=False, periodic=True)

    def nothing(field, *others):
        return math.nan * field

    spoiled = Spoiled(task="density_rate", kernel=kernel, usual=None, fault=nothing)
    checks = measure_stability({"it": spoiled}, probes)
    assert checks["regimes"]["bulk"]["normalized_mse"] == NOT_FINITE
    assert set(checks["stress"].values()) == set(checks["still"].values()) == {NOT_FINITE}
    assert checks["precision"] == checks["density_rollout"]["largest"] == NOT_FINITE
    assert checks["density_rollout"]["first_frame_outside"] == 1
    json.dumps(checks, allow_nan=False)


def test_a_trajectory_at_rest_is_judged_too():
    """Rates that are all zero leave nothing to divide by; the analytic field passes and a constant does not."""
    trajectory, scene = flow(2, walls=False, periodic=True)
    resting = replace(trajectory, velocities=torch.zeros_like(trajectory.velocities))
    kernel = CubicSpline(SPACING, 2)
    probes = make_probes([resting], scene, task_named("density_rate"))
    assert measure_stability({"it": Analytic(task="density_rate", kernel=kernel)}, probes)["stable"]
    constant = Spoiled(task="density_rate", kernel=kernel, usual=None, fault=lambda field, *others: field + 1)
    assert not measure_stability({"it": constant}, probes)["stable"]


def test_the_number_of_frames_is_bounded():
    trajectory, scene = flow(2, walls=False, periodic=True, frames=3)
    long = replace(
        trajectory,
        positions=trajectory.positions.repeat(20, 1, 1),
        velocities=trajectory.velocities.repeat(20, 1, 1),
    )
    probes = make_probes([long, replace(long, name="other")], scene, task_named("density_rate"))
    assert len(probes.plain) == probing.REGIME_FRAMES
    assert len(probes.rollout.frames) == probing.ROLLOUT_FRAMES
    assert len({probe.origin for probe in probes.stressed}) == probing.STRESSED_FRAMES
