from pathlib import Path

import pytest

from cconv.errors import ConfigError
from cconv.study.config import load_study

REPOSITORY = Path(__file__).parents[2]
STUDIES = sorted((REPOSITORY / "experiments").glob("*.toml"))

MINIMAL = """
name = "mini"
task = "density_rate"

[search]
space = "space.toml"
"""


@pytest.fixture
def study_file(tmp_path):
    def write(text):
        path = tmp_path / "study.toml"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_study_of_the_repository_loads_and_finds_its_space(path):
    assert Path(load_study(path).search.space).is_file()


def test_minimal_study_has_the_published_network_and_defaults(study_file):
    study = load_study(study_file(MINIMAL))
    assert study.network.layers == 4
    assert study.data.kernel == "cubic_spline"
    assert study.finalists.seeds >= 2


def test_settings_replace_those_of_the_file(study_file):
    study = load_study(study_file(MINIMAL), ["training.updates=900", "network.window=none", "seeds.init=3"])
    assert (study.training.updates, study.network.window, study.seeds.init) == (900, "none", 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("grace_update = 5", r"study\.toml: unknown key `search\.grace_update`\. Did you mean 'grace_updates'"),
        ("reduction_factor = 1", r"study\.toml: `search\.reduction_factor`: .*greater than or equal to 2, got 1"),
        ('trial_seconds = "many"', r"`search\.trial_seconds`: .*valid number"),
        ("[stages.random]\ntrials = 0", r"`stages\.random\.trials`: .*greater than or equal to 1, got 0"),
        ("[stages.random]\ntrial = 3", r"unknown key `stages\.random\.trial`\. Did you mean 'trials'"),
        ('[stages.random]\n[stages.refine]\nreads = ["rando"]', "`refine` names `rando`.* Did you mean 'random'"),
        ("[training]\nupdates = 10", "grace_updates .50. must not exceed"),
        ("grace_updates = 60", "multiple of"),
        ('[data]\nkernel = "cubic"', r"`data\.kernel`: must be one of cubic_spline"),
        ("[finalists]\nseeds = 1", r"`finalists\.seeds`: .*greater than or equal to 2"),
        ("[trainin]\nupdates = 10", "unknown key `trainin`. Did you mean 'training'"),
    ],
)
def test_a_key_or_value_that_does_not_fit_is_named(change, message, study_file):
    with pytest.raises(ConfigError, match=message):
        load_study(study_file(MINIMAL + change))


def test_a_missing_key_is_named(study_file):
    with pytest.raises(ConfigError, match="`search` is missing"):
        load_study(study_file('name = "x"\ntask = "density_rate"'))


def test_unreadable_files_are_named(tmp_path, study_file):
    with pytest.raises(ConfigError, match="no such file"):
        load_study(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="not a TOML file"):
        load_study(study_file("name = "))


@pytest.mark.parametrize("setting", ["training.updates", "name.part=3"])
def test_a_setting_that_cannot_be_read_is_named(setting, study_file):
    with pytest.raises(ConfigError, match="--set"):
        load_study(study_file(MINIMAL), [setting])
