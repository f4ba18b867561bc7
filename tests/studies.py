"""Study files for tests that run them."""

from pathlib import Path

from cconv.study.declared.search_space import load_space
from cconv.study.pipeline import begin_study
from cconv.study.records.run_folder import RunFolder
from cconv.study.running.problem import with_data_path
from cconv.study.studies import load_study

SMOKE_SPACE = Path(__file__).parents[1] / "search_spaces" / "smoke.toml"

SEARCH = """
name = "{name}"
task = "density_gradient"

[network]
layers = 2
first_channels = 4
hidden_channels = 8

[training]
updates = 36
evaluate_every = 4

[search]
space = "{space}"
grace_updates = 4
concurrency = {concurrency}

[stages.random]
trials = {random}

[stages.adaptive]
trials = {adaptive}
"""


def write_search(folder: Path, name: str, *, concurrency: int, random: int, adaptive: int) -> Path:
    """A study of two searches, seconds long, that nothing else reads."""
    path = folder / f"{name}.toml"
    settings = {"concurrency": concurrency, "random": random, "adaptive": adaptive}
    path.write_text(SEARCH.format(name=name, space=SMOKE_SPACE, **settings))
    return path


def begin_search(study_file: Path, data: Path, folder: Path) -> RunFolder:
    """A fresh run folder of a study file on given data."""
    study = with_data_path(load_study(study_file), str(data))
    run = RunFolder.create(folder, overwrite=False)
    begin_study(study, load_space(study.search.space, study), run)
    return run


class Silent:
    """An observer that does nothing with what it sees."""

    def on_data(self, findings):
        pass

    def on_stage(self, stage, num_trials, training):
        pass

    def on_trial_start(self, trial, parameters):
        pass

    def on_trial_result(self, trial, entry):
        pass

    def on_trial_end(self, trial, outcome, reason):
        pass
