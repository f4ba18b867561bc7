"""Frames in one graph are learned from as one after another: losses, gradients, and what leaves on its way."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from systems import configured, model_of, periodic_frame, periodic_scene, window_of, with_walls

from cconv.data.trajectory import ParticleType
from cconv.devices import CPU
from cconv.forces import ConstantForce
from cconv.models.model import join_geometries
from cconv.tasks import TASKS, task_named
from cconv.tasks.samples import WindowSamples, join_samples, make_sample, make_step_sample
from cconv.tasks.task import StepTask
from cconv.training.augmentation import RandomWalkNoise
from cconv.training.examples import AugmentedExamples, StoredExamples
from cconv.training.geometry_cache import GeometryCache
from cconv.training.loop import losses_of
from cconv.training.losses import LOSSES
from cconv.training.unroll import Pushforward, pushed

SCENE = replace(periodic_scene(), force=ConstantForce((500.0, -900.0)))
SIZES = (64, 41, 57)  # particles of each frame
NETWORKS = {
    "grid": {"layers": 2, "kernel_size": 3, "normalize": True},
    "radial": {"architecture": "radial_net", "layers": 2, "radial_terms": 4, "message": "mixed"},
    "radial layer": {"architecture": "radial_net", "layers": 1, "radial_terms": 4, "message": "mixed"},
}


def observed(task, walls, generator, future=1):
    """Frames, or windows for a step, that differ in their numbers of particles and masses."""
    found = []
    for number, size in enumerate(SIZES):
        whole = periodic_frame(generator)
        frame = replace(
            whole,
            positions=whole.positions[:size],
            velocities=whole.velocities[:size],
            masses=(1 + 0.2 * number) * whole.masses[:size],
            particle_types=whole.particle_types[:size].clone(),
        )
        if walls == "particles":
            frame.particle_types[: 5 + number] = ParticleType.SOLID_WALL
        if walls in ("normals", "points"):
            frame = with_walls(frame, normals=walls == "normals")
            some = {
                name: values[number:]
                for name, values in vars(frame.boundary).items()
                if isinstance(values, torch.Tensor)
            }
            frame = replace(frame, boundary=replace(frame.boundary, **some))
        if isinstance(task, StepTask):
            frame = replace(window_of(frame, generator, future=future), frame=10 * number)
        found.append(frame)
    return found


def samples_of(task, frames):
    if isinstance(task, StepTask):
        return [make_step_sample(window, SCENE, task) for window in frames]
    return [make_sample(frame, SCENE, task, "0", number) for number, frame in enumerate(frames)]


def in_double(sample):
    return replace(sample, inputs=sample.inputs.double(), target=sample.target.double())


def one_graph(task, frames, steps=1):
    """The same in one graph, as trainings join them."""
    if isinstance(task, StepTask):
        model = SimpleNamespace(config=SimpleNamespace(features=task.features), home=CPU)
        (joined,) = StoredExamples(WindowSamples(frames, SCENE, task)).draw(range(len(frames)), 1, model, steps)
    else:
        (joined,) = StoredExamples(samples_of(task, frames)).draw(range(len(frames)), 1, SimpleNamespace(home=CPU))
    return joined


def learned(model, graphs, weight, steps):
    """Each frame's loss, and the derivative of their sum, which is that of a batch."""
    model.zero_grad()
    losses = [
        loss
        for sample in graphs
        for loss in losses_of(model, sample, lambda each: model.geometry(each.inputs), weight, steps)
    ]
    torch.stack(losses).sum().backward()
    gradients = [weights.grad.clone() for weights in model.parameters() if weights.numel()]
    return torch.stack(losses).detach(), gradients


def assert_learned_alike(model, joined, samples, weight, steps):
    losses, gradients = learned(model, [in_double(joined)], weight, steps)
    expected, expected_gradients = learned(model, map(in_double, samples), weight, steps)
    assert len(losses) == len(SIZES)
    torch.testing.assert_close(losses, expected, rtol=1e-9, atol=0)
    for found, each in zip(gradients, expected_gradients, strict=True):
        torch.testing.assert_close(found, each, rtol=1e-8, atol=1e-10 * float(each.abs().max() + 1))
    assert any(bool((each != 0).any()) for each in expected_gradients)


@pytest.mark.parametrize("walls", ["none", "normals", "points", "particles"])
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("task", TASKS)
def test_losses_and_gradients_of_frames_in_one_graph_are_their_own(task, network, walls, generator):
    asked = task_named(task)
    frames = observed(asked, walls, generator)
    samples, joined = samples_of(asked, frames), one_graph(asked, frames)
    settings = NETWORKS[network]
    if asked.output.vectors and "architecture" in settings:
        settings = settings | {"conserves_momentum": True}
    model = model_of(configured(**settings), SCENE, task, samples, generator).double()
    assert_learned_alike(model, joined, samples, LOSSES["balanced_mse"], 1)


@pytest.mark.parametrize("walls", ["none", "particles"])
def test_so_are_those_of_unrolled_steps_through_positions(walls, generator):
    asked = task_named("acceleration")
    frames = observed(asked, walls, generator, future=3)
    samples, joined = samples_of(asked, frames), one_graph(asked, frames, 3)
    settings = configured(**NETWORKS["radial"], conserves_momentum=True)
    model = model_of(settings, SCENE, "acceleration", samples, generator)
    losses, gradients = learned(model, [joined], LOSSES["mse"], 3)
    expected, expected_gradients = learned(model, samples, LOSSES["mse"], 3)
    torch.testing.assert_close(losses, expected, rtol=1e-4, atol=0)
    for found, each in zip(gradients, expected_gradients, strict=True):
        torch.testing.assert_close(found, each, rtol=1e-3, atol=1e-4 * float(each.abs().max()))


def test_a_window_that_diverges_leaves_the_others_to_go_on_unrolled(generator):
    """The middle one breaks after its first step; the others are learned from as if it were not there."""
    asked = task_named("acceleration")
    frames = observed(asked, "none", generator, future=3)
    samples, joined = samples_of(asked, frames), one_graph(asked, frames, 3)
    model = model_of(configured(**NETWORKS["radial"]), SCENE, "acceleration", samples, generator)
    convert = model.in_units_of_data

    def breaking(prediction, inputs):
        """What leads the window of 41 particles on is not a number."""
        counts = inputs.answer_counts
        factors = torch.tensor([torch.nan if count == SIZES[1] else 1.0 for count in counts])
        return convert(prediction, inputs) * factors.repeat_interleave(torch.tensor(counts))[:, None]

    model.in_units_of_data = breaking
    learned = partial(losses_of, model, geometry=lambda each: model.geometry(each.inputs), loss_of=LOSSES["mse"])
    together = torch.stack(learned(joined, steps=3)).detach()
    apart = torch.stack([loss for sample in samples for loss in learned(sample, steps=3)]).detach()
    first_steps = torch.stack(learned(joined, steps=1)).detach()
    torch.testing.assert_close(together, apart, rtol=1e-4, atol=0)
    assert torch.equal(together[1], first_steps[1])
    assert (together != first_steps).tolist() == [True, False, True]


def test_a_cache_keeps_the_geometries_of_frames_that_come_in_one_graph(generator):
    asked = task_named("density_rate")
    frames = observed(asked, "normals", generator)
    samples = samples_of(asked, frames)
    for network in NETWORKS.values():
        model = model_of(configured(**network), SCENE, "density_rate", samples, generator)
        built = []
        cache = GeometryCache(lambda inputs, built=built, model=model: built.append(1) or model.geometry(inputs), 2**30)
        joined = one_graph(asked, frames)
        cached = [model(joined.inputs, cache(joined)) for _ in range(2)]
        assert len(built) == len(SIZES)
        assert cache(samples[1]) is cache(samples[1])
        assert len(built) == len(SIZES)
        torch.testing.assert_close(cached[0], model(joined.inputs, model.geometry(joined.inputs)))
        assert torch.equal(*cached)
        assert join_geometries([cache(samples[0])]) is cache(samples[0])


def test_inputs_that_are_joined_are_separated_again(generator):
    for task in TASKS:
        asked = task_named(task)
        for walls in ("none", "normals", "particles"):
            frames = observed(asked, walls, generator)
            joined, samples = one_graph(asked, frames).inputs, samples_of(asked, frames)
            for part, sample in zip(joined.separated(), samples, strict=True):
                whole = sample.inputs
                assert torch.equal(part.positions, whole.positions)
                assert torch.equal(part.features.flat(), whole.features.flat())
                assert part.units == whole.units
                assert (part.box, part.wall_kinds, part.num_answers) == (whole.box, whole.wall_kinds, whole.num_answers)
                for name in ("wall_positions", "answered"):
                    found, expected = getattr(part, name), getattr(whole, name)
                    assert found is expected is None or torch.equal(found, expected)


def test_frames_of_other_boxes_or_walls_are_in_other_graphs(generator):
    asked = task_named("density_rate")
    bare, walled = (samples_of(asked, observed(asked, walls, generator)) for walls in ("none", "normals"))
    found = join_samples([*bare, *walled])
    assert [len(sample.origins) for sample in found] == [3, 3]


def test_examples_in_one_graph_are_those_that_are_drawn_one_by_one(generator):
    """With noise, and after different numbers of steps of the model's own rollout."""
    asked = task_named("acceleration")
    windows = [
        replace(window, trajectory=str(number)) for number, window in enumerate(observed(asked, "none", generator, 4))
    ]
    samples = WindowSamples(windows, SCENE, asked)
    model = model_of(configured(**NETWORKS["radial"]), SCENE, "acceleration", list(samples), generator)
    examples = AugmentedExamples(samples, RandomWalkNoise(0.02), Pushforward(3, 0), seed=0)
    for update in range(1, 5):
        drawn = examples.draw([2, 0, 1], update, model, share=1.0)
        one_by_one = [sample for index in range(3) for sample in examples.draw([index], update, model, share=1.0)]
        alone = {sample.origins[0]: sample for sample in one_by_one}
        assert sum(len(sample.origins) for sample in drawn) == 3
        for sample in drawn:
            for origin, inputs, target in zip(
                sample.origins, sample.inputs.separated(), sample.target.split(sample.inputs.answer_counts), strict=True
            ):
                torch.testing.assert_close(
                    inputs.features.flat(), alone[origin].inputs.features.flat(), rtol=1e-4, atol=1e-4
                )
                torch.testing.assert_close(target, alone[origin].target, rtol=1e-4, atol=1e-4)


def test_a_window_that_diverges_stays_where_it_came_while_others_are_pushed(generator):
    asked = task_named("acceleration")
    windows = observed(asked, "none", generator, future=4)

    class Breaks:
        task = asked

        def predict_frame(self, window, scene):
            """The window of 41 particles breaks at its second step."""
            answers = [
                torch.full_like(part.present, torch.nan if len(part.masses) == 41 and len(part.future) < 4 else 0.0)
                for part in window.separated()
            ]
            return torch.cat(answers)

    found = pushed(Breaks(), windows, SCENE, [3, 3, 0])
    assert [window.frame - start.frame for window, start in zip(found, windows, strict=True)] == [3, 1, 0]
    assert found[2] is windows[2]
    assert all(torch.isfinite(window.present).all() for window in found)
