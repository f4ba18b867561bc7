"""Seeds of the stages: each has a stream of its own, which nothing but the study's search seed and its name decide."""

from dataclasses import fields, replace

import numpy as np
import pytest
from conftest import SMOKE

from cconv.study.records.run_folder import RunFolder
from cconv.study.stages.session import Session
from cconv.study.studies import load_study


def session_of(*settings):
    return Session(**dict.fromkeys(field.name for field in fields(Session)) | {"study": load_study(SMOKE, settings)})


@pytest.mark.parametrize(
    "settings", [["seeds.data=7"], ["seeds.init=7"], ["stages.random.trials=9"], ["training.updates=500"]]
)
def test_no_other_seed_and_no_other_stage_shifts_the_draws_of_a_stage(settings):
    changed, known = session_of(*settings), session_of()
    assert all(changed.seed_of(stage) == known.seed_of(stage) for stage in known.study.stages)


def test_streams_of_stages_and_studies_never_overlap():
    sessions = [session_of(f"seeds.search={seed}") for seed in range(20)]
    names = [*sessions[0].study.stages, "random_2", "2_random"]
    seeds = [session.seed_of(name) for session in sessions for name in names]
    draws = {tuple(np.random.default_rng(seed).integers(2**63, size=2)) for seed in seeds}
    assert len(draws) == len(sessions) * len(names)
    assert all(0 <= seed < 2**32 for seed in seeds)  # what every sampler takes


REFINED = """name = "refined"
description = "d"

[parameters.network.radial_terms]
type = "choice"
values = [4, 8]
baseline = 4
reason = "r"
"""


def test_a_refined_space_is_read_with_the_settings_of_its_study(tmp_path):
    """Of a study of radial networks, whose own settings a space of the published ones does not have."""
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "refine.toml").write_text(REFINED)
    of_network = ["network={architecture = 'radial_net', layers = 2}", "stages.adaptive.space=refine"]
    session = replace(session_of(*of_network), run=RunFolder(tmp_path))
    assert list(session.space_of("adaptive").parameters) == ["network.radial_terms"]
