"""Rollouts of models, and when they end."""

from itertools import islice

import pytest
import torch
from systems import configured, model_of, observed_and_sample, periodic_frame, periodic_scene, window_of

import cconv
from cconv.errors import ConfigError
from cconv.rollout.rollout import Diverged, _most_in_a_cell, advance, rollout
from cconv.tasks.integrators import SemiImplicitEuler

EULER = SemiImplicitEuler()


def model_for(task, generator):
    observed, sample = observed_and_sample(periodic_frame(generator), periodic_scene(), task, generator)
    return model_of(configured(layers=1), periodic_scene(), task, [sample], generator), observed


def test_a_models_rollout_is_its_answers_integrated_one_after_another(generator):
    model, window = model_for("acceleration", generator)
    scene = periodic_scene()
    for found in islice(rollout(model, window, scene), 3):
        window = EULER.advance(window, model.predict_frame(window, scene), scene)
        torch.testing.assert_close(found.present, window.present.double(), atol=1e-6, rtol=0)
        assert (found.frame, len(found.positions)) == (window.frame, 6)


def test_the_public_function_is_this_one(generator):
    model, window = model_for("acceleration", generator)
    (frame,) = islice(cconv.rollout(model, window, periodic_scene()), 1)
    (same,) = islice(rollout(model, window, periodic_scene()), 1)
    assert torch.equal(frame.present, same.present)


def test_a_model_of_a_field_cannot_be_rolled_out(generator):
    model, _ = model_for("density_rate", generator)
    with pytest.raises(ConfigError, match="'density_rate' is a field, and only steps are possible here"):
        rollout(model, window_of(periodic_frame(generator), generator), periodic_scene())


def ends(predict, generator):
    """The reason why a rollout ends at its first frame."""
    window, scene = window_of(periodic_frame(generator, 16), generator), periodic_scene(16)
    with pytest.raises(Diverged) as error:
        next(advance(predict, EULER, window, scene))
    assert error.value.frame == window.frame + 1
    return error.value.reason


def test_positions_that_are_not_finite_end_it(generator):
    def predict(window, scene):
        answers = torch.zeros(len(window.masses), 2)
        answers[3, 1] = torch.nan
        return answers

    assert ends(predict, generator) == "positions are not finite"


def test_a_leap_ends_it(generator):
    def predict(window, scene):
        return torch.full((len(window.masses), 2), 0.7 * scene.box.lengths[0] / 2)

    assert "spacings in a frame" not in ends(lambda window, scene: predict(window, scene) * torch.nan, generator)
    small = periodic_scene(64)
    window = window_of(periodic_frame(generator, 64), generator)
    with pytest.raises(Diverged, match="moved .* spacings in a frame"):
        next(advance(predict, EULER, window, small))


def test_clumps_end_it_before_their_neighbours_are_searched(generator):
    def predict(window, scene):
        """Every particle within reach of the centre goes there."""
        from_center = scene.box.displacement(torch.full((1, 2), 0.53, dtype=torch.float64), window.present)
        near = from_center.norm(dim=1, keepdim=True) < 0.35
        return torch.where(near, from_center, 0.0) - window.last_displacements(scene.box)

    assert "particles clumped within two spacings" in ends(predict, generator)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_fullest_cell_is_counted_however_far_apart_particles_are(dim, generator):
    cells = torch.randint(-2, 3, (200, dim), generator=generator)
    cells[::10] *= 2**61
    index = torch.arange(200) // 70  # of three windows, which do not see each other
    expected = [int(cells[index == window].unique(dim=0, return_counts=True)[1].max()) for window in range(3)]
    assert _most_in_a_cell(cells, index, 3) == expected
    assert _most_in_a_cell(cells[:1], index[:1], 1) == [1]
