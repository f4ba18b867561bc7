"""What a stage trains is what its records say."""

from types import SimpleNamespace

import pytest

from cconv.errors import ConfigError
from cconv.study.declared.study_file import SeedsConfig
from cconv.study.records.run_folder import RunFolder
from cconv.study.stages.jobs import trial_job


@pytest.fixture
def session(tmp_path):
    return SimpleNamespace(run=RunFolder(tmp_path), study=SimpleNamespace(seeds=SeedsConfig()))


def test_a_trial_that_was_begun_goes_on_only_with_its_own_parameters(session):
    parameters = {"network.layers": 2, "training.learning_rate": 0.1 + 0.2, "network.message": "difference"}
    job = trial_job(session, "random", 3, parameters)
    session.run.trial(job.name).start({"stage": "random", "parameters": parameters, "init_seed": job.init_seed})
    assert trial_job(session, "random", 3, parameters) == job
    with pytest.raises(ConfigError, match=r"random_0003: was begun with other hyperparameters"):
        trial_job(session, "random", 3, parameters | {"network.layers": 3})
