"""Exported programs: they answer what the model answers, in a process where this package cannot be imported."""

import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from contracts.test_tasks_and_networks import fresh
from processes import PATIENCE
from systems import periodic_frame, periodic_scene, window_of

from cconv.models.exported import PlainModel, export_model
from cconv.neighbors import radius_graph
from cconv.networks import ARCHITECTURES
from cconv.tasks.features import feature_unit

PAIRS = [
    ("conv_net", "density_gradient"),
    ("radial_net", "acceleration"),
    ("gns", "position_correction"),
    ("segnn", "density_rate"),
]
# What a user without this package does; it prints nothing and leaves the answers in a file.
ELSEWHERE = """
import sys
sys.modules["cconv"] = None
import torch
programs, cases, out = sys.argv[1:]
answers = {}
for name, arguments in torch.load(cases).items():
    with open(f"{programs}/{name.split('@')[0]}.pt2", "rb") as file:
        answers[name] = torch.export.load(file).module()(*arguments)
torch.save(answers, out)
"""


def arguments_of(model, inputs, order=None):
    """Arguments of the exported program from the inputs of a model, in the units of the data."""
    units, cutoff = inputs.units, model.settings.relative_cutoff
    columns = inputs.features.select(model.config.fluid_features).flat()[:, 1:]
    scale = torch.tensor([float(feature_unit(name, units)) for name in PlainModel(model).columns])
    searches = [radius_graph(inputs.positions, cutoff, inputs.box)]
    if model.config.walls:
        searches.append(radius_graph(inputs.wall_positions, cutoff, inputs.box, queries=inputs.positions))
    pairs = [(e.receivers, e.senders, e.displacements * units.length) for e in searches]
    if order is not None:
        orders = [torch.randperm(len(receivers), generator=order) for receivers, *_ in pairs]
        pairs = [tuple(values[by] for values in each) for each, by in zip(pairs, orders, strict=True)]
    given = [columns * scale, torch.tensor([units.length, units.density, units.time]), *pairs[0]]
    return (*given, inputs.wall_features.flat(), *pairs[1]) if model.config.walls else tuple(given)


def answers_elsewhere(folder, cases):
    """Answers of exported programs by name, from a process that knows no cconv."""
    torch.save(cases, folder / "cases.pt")
    command = [sys.executable, "-c", ELSEWHERE, folder, folder / "cases.pt", folder / "answers.pt"]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert finished.returncode == 0, finished.stderr
    return torch.load(folder / "answers.pt")


def same(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))


def larger(observed, model, scene, generator):
    """A frame or window of more particles in another resolution, and its scene."""
    scene = replace(periodic_scene(11), force=scene.force)
    frame = periodic_frame(generator, 11)
    frame = replace(frame, boundary=observed.boundary)
    return (frame if model.config.history == 1 else window_of(frame, generator)), scene


@pytest.mark.integration
@pytest.mark.usefixtures("unchecked")
def test_programs_answer_as_their_models_do_without_this_package(generator, tmp_path):
    cases, expected = {}, {}
    assert {architecture for architecture, _ in PAIRS} == set(ARCHITECTURES)
    for architecture, task in PAIRS:
        model, observed, scene = fresh(task, architecture, generator)
        export_model(model, tmp_path / f"{architecture}.pt2")
        for name, (shown, place) in {
            architecture: (observed, scene),
            f"{architecture}@larger": larger(observed, model, scene, generator),
        }.items():
            inputs = model.inputs(shown, place)
            cases[name], expected[name] = arguments_of(model, inputs, generator), model.eval().predict(inputs)
    found = answers_elsewhere(tmp_path, cases)
    for name, answer in expected.items():
        same(found[name], answer)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_a_lonely_particle_is_answered_for(architecture, generator, tmp_path):
    model, observed, scene = fresh("density_rate", architecture, generator)
    alone = type(observed)(
        positions=observed.positions[:1],
        velocities=observed.velocities[:1],
        masses=observed.masses[:1],
        particle_types=observed.particle_types[:1],
        boundary=observed.boundary,
    )
    inputs = model.eval().inputs(alone, scene)
    same(PlainModel(model)(*arguments_of(model, inputs)), model.predict(inputs))
