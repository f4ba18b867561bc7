import json
import os
from pathlib import Path

import pytest

from cconv.errors import ConfigError
from cconv.study.studies import load_study

REPOSITORY = Path(__file__).parents[3]
STUDIES = sorted((REPOSITORY / "experiments").rglob("*.toml"))

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
    assert study.task.kernel == "cubic_spline"
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
        ("[finalists]\nseeds = 0", r"`finalists\.seeds`: .*greater than or equal to 1"),
        ("[trainin]\nupdates = 10", "unknown key `trainin`. Did you mean 'training'"),
        ("give_up_above = inf", r"`search\.give_up_above`: input should be a finite number, got inf"),
        ("trial_seconds = 1e300", r"`search\.trial_seconds`: input should be less than or equal to 10000000"),
        ("concurrency = true", r"`search\.concurrency`: input should be a valid integer, got True"),
        ("trial_seconds = true", r"`search\.trial_seconds`: input should be a valid number, got True"),
        ("[training]\nnoise = 0.1", r"not possible .training\.noise: must be 0 for the field 'density_rate', got 0\.1"),
        ("[training]\npushforward = 2", r"not possible .training\.pushforward: must be 0 for the field 'density_rate'"),
        ("[training]\nlearning_rate = 1e-300", r"`training\.learning_rate`: input should be greater than"),
        ("[training]\nlearning_rate = nan", r"`training\.learning_rate`: input should be a finite number"),
        ("[data]\nmass = inf", r"`data\.mass`: input should be a finite number"),
        ("[data]\nparticle_spacing = 1e-300", r"`data\.particle_spacing`: input should be greater than"),
        ('[data]\npath = "a\\u0000b"', r"`data\.path`: a path must hold"),
        ("[seeds]\ninit = 9223372036854775808", r"`seeds\.init`: input should be less than 2147483648"),
        ("[cost]\nsizes = []", r"`cost\.sizes`: tuple should have at least 1 item"),
        ("[cost]\nsizes = [1000, 1000]", r"`cost\.sizes`: sizes must ascend"),
        ("[cost]\nsizes = [-5]", r"`cost\.sizes\.0`: input should be greater than or equal to 10, got -5"),
        ("[cost]\nsizes = [10000000000]", r"`cost\.sizes\.0`: input should be less than or equal to 1000000"),
        ("[cost]\nthreads = 1000000000", r"`cost\.threads`: input should be less than or equal to 1024"),
        ("[cost]\ntrials = 1000000000", r"`cost\.trials`: input should be less than"),
        ("[finalists]\nseeds = 1000000000", r"`finalists\.seeds`: input should be less than"),
        ("[finalists]\nframes_per_block = 10000000000", r"`finalists\.frames_per_block`: input should be less"),
        ("[stages.closed_form]\nscreening_frames = 1000000000", r"`stages\.closed_form\.screening_frames`: .* less"),
        ("[stages.closed_form]\nvalues_per_range = 1000000000", r"`stages\.closed_form\.values_per_range`: .* less"),
        ("[stages.closed_form]\nridge = inf", r"`stages\.closed_form\.ridge`: input should be a finite number"),
        ("[selection]\nmargin = inf", r"`selection\.margin`: input should be a finite number"),
        ("[network]\nhidden_channels = 1000000", r"`network\.hidden_channels`: input should be less"),
        ("[network]\nnormalize = 1", r"`network\.normalize`: input should be a valid boolean, got 1"),
        ("[stages.random]\ntrials = " + "1" * 5000, "not a TOML file .*4300 digits"),
        ("x = " + "[" * 10_000, "not a TOML file .*more than 32 tables or arrays"),
        ("x = " + "{x = " * 200, "not a TOML file .*"),
        ("a." * 100_000 + "a = 1", "not a TOML file .*a key has more than 32 parts"),
        ("[" + "a . " * 100_000 + "a]", "not a TOML file .*a key has more than 32 parts"),
        ("x = " + "[" * 40 + "]" * 40, "not a TOML file .*more than 32 tables or arrays"),
        ("#" + "x" * 2**20, "such a file has at most 1048576"),
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


@pytest.mark.parametrize(
    "name", ["../../evil", "/tmp/evil", "r[0-9]*", "a/b", "", "a\nb", "[/red]", "a..b", "x" * 65, "1"]
)
@pytest.mark.parametrize("setting", ["name", "stage", "finalist", "reads", "space"])
def test_names_follow_one_pattern(name, setting, study_file):
    quoted = json.dumps(name)
    text = {
        "name": MINIMAL.replace('"mini"', quoted),
        "stage": f'{MINIMAL}[stages.{quoted}]\nkind = "random"',
        "finalist": f"{MINIMAL}[stages.random]\n[stages.finalists]\ninclude = {{ {quoted} = {{}} }}",
        "reads": f"{MINIMAL}[stages.random]\n[stages.refine]\nreads = [{quoted}]",
        "space": f"{MINIMAL}[stages.random]\nspace = {quoted}",
    }[setting]
    with pytest.raises(ConfigError, match=r"a name must match \^\[A-Za-z\]\[A-Za-z0-9_\.-\]\*\$") as refused:
        load_study(study_file(text))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ('[stages.random]\n[stages.random_0]\nkind = "random"', "stage `random_0` could be taken for stage `random`"),
        ('[stages.random]\n[stages.Random]\nkind = "random"', "could be taken for stage"),
        ('[stages.finalists]\nkind = "random"', "stage `finalists` must have another name"),
        ('[stages.data]\nkind = "random"', "stage `data` must have another name"),
        ("include = { baseline = {} }", "finalist `baseline` must have another name"),
        ("include = { random_0003 = {} }", "finalist `random_0003` could be taken for a trial of stage `random`"),
    ],
)
def test_names_that_could_be_taken_for_others_are_refused(stages, message, study_file):
    text = f"[stages.random]\n[stages.finalists]\n{stages}" if stages.startswith("include") else stages
    with pytest.raises(ConfigError, match=message):
        load_study(study_file(MINIMAL + text))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ("{ layers = 2 }", "finalist `x`: unknown hyperparameter 'layers'. Did you mean 'network.layers'"),
        (
            "{ network.layers = 99 }",
            r"finalist `x`: not possible .network.layers: Input should be less than or equal to 16",
        ),
        ("{ network.layers = true }", r"finalist `x`: not possible .network.layers: Input should be a valid integer"),
        (
            '{ network.architecture = "radial_net", network.skip = "after_activation" }',
            "finalist `x`: not possible .network.skip: Input should be",
        ),
        ("{ training.learning_rate = inf }", r"include\.x\.training\.learning_rate`: must be true, false, a number"),
        ("{ network.layers = [1] }", r"include\.x\.network\.layers`: must be true, false, a number"),
        ("{ training.noise = 0.1 }", r"finalist `x`: not possible .training\.noise: must be 0 for the field"),
        ("{ task.features.force = true }", r"finalist `x`: not possible .task\.features\.force: is no feature of"),
    ],
)
def test_an_included_configuration_is_checked_when_the_study_is_loaded(parameters, message, study_file):
    text = f"{MINIMAL}[stages.random]\n[stages.finalists]\ninclude = {{ x = {parameters} }}"
    with pytest.raises(ConfigError, match=message):
        load_study(study_file(text))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("a." * 100_000 + "b=1", "a key of more than 32 parts"),
        ("training.updates=" + "[" * 10_000, "no value for a setting"),
        ("training.updates=" + "1" * 10_000, "no value for a setting .*4300 digits"),
        ("training.updates=0x" + "f" * 10_000, "got a int that is too long to show"),
        ("training.updates=5\nseeds.init=3", "must be one line"),
        ("training.updates=true", "valid integer, got True"),
    ],
)
def test_a_setting_that_no_study_has_is_refused(setting, message, study_file):
    with pytest.raises(ConfigError, match=message) as refused:
        load_study(study_file(MINIMAL), [setting])
    assert len(str(refused.value)) < 1000


def test_what_is_no_regular_file_is_refused_without_reading_it(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    for path in ("/dev/zero", tmp_path, tmp_path / "fifo"):
        with pytest.raises(ConfigError, match="no regular file"):
            load_study(path)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.kernel=cubic", r"`task\.kernel`: must be one of cubic_spline"),
        ("task.smoothing_length=1e300", r"`task\.smoothing_length`: input should be less than"),
        (
            "task.name=density_rat",
            r"`task\.name`: input should be 'density_rate', 'density_gradient', 'acceleration' or 'position_",
        ),
        ('task.features=["velocity", "densit"]', "no feature 'densit'. Did you mean 'density'"),
        ('task.features=["walls"]', "the feature 'velocity' must be one of `features`"),
        ("network.architecture=grid", "does not match any of the expected tags: 'conv_net', 'radial_net'"),
        ("network.radial_terms=8", r"unknown key `network\.radial_terms`\. Known: architecture, relative_cutoff"),
    ],
)
def test_a_task_or_network_that_is_none_is_named(study_file, override, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_study(study_file(MINIMAL), [override])
    assert "\n" not in str(error.value)


def test_a_task_is_given_by_name_or_as_a_table(study_file):
    path = study_file(MINIMAL)
    assert load_study(path).task.taken == ("one", "density", "velocity", "walls")
    study = load_study(path, ['task.features=["velocity"]', "network.architecture=radial_net"])
    assert study.task.taken == ("one", "velocity")
    assert study.network.radial_terms == 16
