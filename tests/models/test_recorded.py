"""Models of the density tasks predict what they predicted before features had names, to the accuracy of float32."""

import json
from itertools import product
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from systems import periodic_frame, periodic_scene, with_walls

from cconv.models.model import build_model
from cconv.networks import ARCHITECTURES
from cconv.tasks import task_named
from cconv.tasks.samples import make_sample

RECORDED = Path(__file__).parents[1] / "data" / "field_models.safetensors"
TASKS = ("density_rate", "density_gradient")
FORMER_NAMES = {"conv_net": "grid", "radial_net": "radial"}


@pytest.mark.parametrize(
    ("task", "architecture", "message", "walls", "density"),
    list(product(TASKS, FORMER_NAMES, ("absolute", "difference"), (True, False), (True, False))),
)
def test_predictions_are_the_recorded_ones(task, architecture, message, walls, density):
    with safe_open(RECORDED, framework="pt") as file:
        about = file.metadata()
        name = f"{task}.{FORMER_NAMES[architecture]}.{message}.boundary_{walls}.density_{density}"
        recorded, positions = file.get_tensor(name), file.get_tensor("positions")
    scene, frame = periodic_scene(), with_walls(periodic_frame(torch.Generator().manual_seed(7)))
    assert torch.equal(frame.positions, positions)
    settings = ARCHITECTURES[architecture]
    sizes = {key: value for key, value in json.loads(about["sizes"]).items() if key in settings.model_fields}
    asked = task_named(task)
    features = [feature for feature, taken in {"velocity": True, "density": density, "walls": walls}.items() if taken]
    sample = make_sample(frame, scene, asked)
    generator = torch.Generator().manual_seed(1)
    model = build_model(settings(message=message, **sizes), asked, features, scene, [sample], generator)
    predicted = model.predict_frame(frame, scene)
    torch.testing.assert_close(predicted, recorded, rtol=1e-4, atol=1e-5 * float(recorded.abs().max()))
