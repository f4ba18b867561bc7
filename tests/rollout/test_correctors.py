"""Correctors: they change the present frame only, the next velocity follows from it, and none changes nothing."""

from dataclasses import replace
from itertools import islice

import pytest
import torch
from systems import configured, model_of, observed_and_sample, periodic_frame, periodic_scene, window_of

import cconv
from cconv.errors import ConfigError
from cconv.models.relaxation import Relaxation
from cconv.rollout.correctors import SPHRelaxation
from cconv.rollout.rollout import Diverged, advance
from cconv.sph import relax
from cconv.tasks.integrators import SemiImplicitEuler

EULER = SemiImplicitEuler()
SIDE = 10
SCENE = periodic_scene(SIDE)
RELAXATION = SPHRelaxation(alpha=0.02, beta=0.3, loops=2)


def start_window(generator, walls=0):
    """A window of smooth motion, the first particles of which are walls at rest."""
    window = window_of(periodic_frame(generator, SIDE), generator)
    positions = window.positions.double()
    positions[:, :walls] = positions[-1, :walls]
    types = (torch.arange(len(window.masses)) < walls).long()
    return replace(window, positions=positions, particle_types=types)


def coasting(window, scene):
    """No acceleration."""
    return torch.zeros(int(window.is_fluid.sum()), scene.dim)


def frames_of(window, correctors, count=3, predict=coasting):
    return list(islice(advance(predict, EULER, window, SCENE, correctors=correctors), count))


def test_a_relaxation_corrects_the_present_frame_only(generator):
    before = start_window(generator, walls=7)
    after = EULER.advance(before, coasting(before, SCENE), SCENE)
    relaxed = RELAXATION(before, after, SCENE)
    expected = relax(
        after.present,
        before.present,
        ~after.is_fluid,
        box=SCENE.box,
        particle_spacing=0.1,
        alpha=0.02,
        beta=0.3,
        loops=2,
    )
    assert torch.equal(relaxed.present, expected)
    assert torch.equal(relaxed.positions[:-1], after.positions[:-1])
    assert torch.equal(relaxed.present[:7], after.present[:7])
    assert (relaxed.present != after.present).any(dim=1)[7:].all()
    assert (relaxed.frame, len(relaxed.future)) == (after.frame, len(after.future))


def test_the_next_velocity_follows_from_corrected_positions(generator):
    first, second = frames_of(start_window(generator), [RELAXATION], 2)
    going_on = EULER.advance(first, coasting(first, SCENE), SCENE)
    assert torch.equal(second.positions[:-1], first.positions[1:])
    assert torch.equal(second.present, RELAXATION(first, going_on, SCENE).present)


def test_correctors_act_one_after_another(generator):
    window = start_window(generator)
    other = SPHRelaxation(alpha=0.01, beta=0.0, loops=1)
    after = EULER.advance(window, coasting(window, SCENE), SCENE)
    expected = other(window, RELAXATION(window, after, SCENE), SCENE)
    assert torch.equal(frames_of(window, [RELAXATION, other], 1)[0].present, expected.present)


def test_a_model_is_asked_about_corrected_frames(generator):
    frame, scene = periodic_frame(generator), periodic_scene()
    window, sample = observed_and_sample(frame, scene, "acceleration", generator)
    model = model_of(configured(layers=1), scene, "acceleration", [sample], generator)
    found = list(islice(cconv.rollout(model, window, scene, correctors=[RELAXATION]), 3))
    window = replace(window, positions=window.positions.double())
    for each in found:
        after = EULER.advance(window, model.predict_frame(window, scene), scene)
        window = RELAXATION(window, after, scene)
        torch.testing.assert_close(each.present, window.present, atol=1e-6, rtol=0)


def test_the_relaxation_of_a_saved_model_belongs_to_its_rollouts(generator):
    scene = periodic_scene()
    observed, sample = observed_and_sample(periodic_frame(generator), scene, "acceleration", generator)
    model = model_of(configured(layers=1), scene, "acceleration", [sample], generator)
    own = model.relaxed_by(Relaxation(alpha=0.02, beta=0.3, loops=2))

    def last(model, **given):
        return list(islice(cconv.rollout(model, observed, scene, **given), 3))[-1].present

    assert torch.equal(last(own), last(model, correctors=[RELAXATION]))
    assert torch.equal(last(own, correctors=[]), last(model))
    assert not torch.equal(last(own), last(model))


def test_replayed_targets_are_the_stored_frames_without_correctors(generator):
    window = window_of(periodic_frame(generator, SIDE), generator, future=3)
    replayed = frames_of(window, (), 3, EULER.target)
    for found, stored in zip(replayed, window.future, strict=True):
        assert SCENE.box.displacement(found.present, stored.double()).abs().max() < 1e-6


def test_a_relaxation_keeps_the_momentum_of_a_rollout(generator):
    window = start_window(generator)
    momentum = window.last_displacements(SCENE.box).sum(dim=0)
    for found in frames_of(window, [RELAXATION], 5):
        assert torch.allclose(found.last_displacements(SCENE.box).sum(dim=0), momentum, rtol=0, atol=1e-9)


def test_a_relaxation_that_shifts_too_far_ends_the_rollout_and_says_so(generator):
    window = start_window(generator)
    with pytest.raises(Diverged, match="at frame 6: A relaxation with alpha 9 shifted a particle by") as error:
        frames_of(window, [SPHRelaxation(alpha=9.0)])
    assert error.value.frame == 6


def test_frames_that_a_corrector_ruins_end_the_rollout(generator):
    def ruin(before, after, scene):
        return replace(after, positions=after.positions * torch.nan)

    with pytest.raises(Diverged, match="positions are not finite"):
        frames_of(start_window(generator), [ruin])


@pytest.mark.parametrize("settings", [{"alpha": -1.0}, {"alpha": 0.1, "beta": -1.0}, {"alpha": 0.1, "loops": 0}])
def test_settings_that_cannot_be_are_refused_before_a_rollout(settings):
    with pytest.raises(ConfigError, match="of a relaxation must be"):
        SPHRelaxation(**settings)
