"""A study of steps beside walls and a lid, relaxed after every step, from a training to the report."""

import pytest
from conftest import SMOKE, run_main

from cconv.data.generate import generate
from cconv.scenes import scene_named
from cconv.study.records.run_folder import RunFolder

pytestmark = pytest.mark.integration

STUDY = """
name = "walled"

[task]
name = "acceleration"
horizon = 3

[predictor.network]
architecture = "radial_net"
layers = 1
message = "mixed"
relative_cutoff = 2.0
radial_terms = 3

[training]
updates = 4
evaluate_every = 2

[rollout.relaxation]
alpha = 0.02

[search]
space = "{space}"
grace_updates = 2

[stages.finalists]
count = 1

[stages.select]

[finalists]
seeds = 1

[cost]
repeats = 3
trials = 0
sizes = [100, 200]
"""


def test_models_beside_walls_are_compared_timed_and_checked(tmp_path):
    data, study, folder = tmp_path / "cavity", tmp_path / "walled.toml", tmp_path / "run"
    scene = scene_named("lid_driven_cavity_2d", "small", particle_spacing=0.1, steps_per_frame=5, relaxation_steps=20)
    generate(scene, data, num_trajectories=3, num_frames=20, workers=1)
    study.write_text(STUDY.format(space=SMOKE.parents[1] / "search_spaces" / "rollout_walls.toml"))
    assert run_main("study", "run", study, "--serial", "--data", data, "--out", folder) == 0
    (finalist,) = RunFolder.open(folder).summary().finalists
    assert finalist.test.error > 0
    assert finalist.cost.ms_per_frame > 0
    assert (folder / "report.html").is_file()
