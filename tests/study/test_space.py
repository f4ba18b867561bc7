from pathlib import Path

import pytest

from cconv.errors import ConfigError
from cconv.study.config import TrainingConfig
from cconv.study.space import configure, load_space, optuna_distributions, ray_domains
from cconv.training.field_model import NetworkConfig

SPACES = sorted((Path(__file__).parents[2] / "search_spaces").glob("*.toml"))

HEAD = 'name = "mini"\ndescription = "For tests."\n'
CHOICE = '[parameters.window]\ntype = "choice"\nvalues = ["none", "poly6"]\nbaseline = "poly6"\nreason = "r"\n'
FLOAT = (
    '[parameters.learning_rate]\ntype = "float"\nrange = [1e-4, 1e-2]\nscale = "log"\nbaseline = 1e-3\nreason = "r"\n'
)
INT = '[parameters.kernel_size]\ntype = "int"\nrange = [3, 6]\nbaseline = 4\nreason = "r"\n'


@pytest.fixture
def space_file(tmp_path):
    def write(text):
        path = tmp_path / "space.toml"
        path.write_text(HEAD + text)
        return path

    return write


@pytest.mark.parametrize("path", SPACES, ids=lambda path: path.stem)
def test_every_space_of_the_repository_loads_and_explains_itself(path):
    space = load_space(path)
    assert all(len(parameter.reason) > 5 for parameter in space.parameters.values())
    configure(space.baseline, NetworkConfig(), TrainingConfig())


def test_the_density_spaces_baseline_is_the_default_network_and_training():
    space = load_space(next(path for path in SPACES if path.stem == "density"))
    network, training = configure(space.baseline, NetworkConfig(), TrainingConfig())
    assert network == NetworkConfig()
    assert training == TrainingConfig()


def test_ray_and_optuna_draw_within_the_space(space_file):
    space = load_space(space_file(CHOICE + FLOAT + INT))
    distributions = optuna_distributions(space)
    for _ in range(200):
        drawn = {name: domain.sample() for name, domain in ray_domains(space).items()}
        assert drawn["window"] in ("none", "poly6")
        assert 1e-4 <= drawn["learning_rate"] <= 1e-2
        assert drawn["kernel_size"] in (3, 4, 5, 6)
        for name, distribution in distributions.items():
            assert distribution._contains(distribution.to_internal_repr(drawn[name]))


def test_both_ends_of_a_whole_number_range_are_drawn(space_file):
    domain = ray_domains(load_space(space_file(INT)))["kernel_size"]
    assert {domain.sample() for _ in range(200)} == {3, 4, 5, 6}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CHOICE.replace("window", "windw"), r"unknown hyperparameter `parameters\.windw`\. Did you mean 'window'"),
        (CHOICE.replace("reason", "because"), "unknown key `parameters.window.because`"),
        (CHOICE.replace('baseline = "poly6"', 'baseline = "gauss"'), "baseline 'gauss' must be one of the values"),
        (CHOICE.replace('"none"', '"nothing"'), "`parameters.window`: the value 'nothing' is not possible"),
        (FLOAT.replace("1e-3", "1.0"), r"baseline 1\.0 must lie in the range"),
        (FLOAT.replace("[1e-4, 1e-2]", "[1e-2, 1e-4]"), "lower end first"),
        (FLOAT.replace("[1e-4, 1e-2]", "[0.0, 1e-2]"), "positive on a log scale"),
        (INT.replace("[3, 6]", "[0, 6]"), "the value 0 is not possible"),
        (INT.replace('"int"', '"integer"'), "parameters.kernel_size"),
        ("", "`parameters` is missing"),
    ],
)
def test_what_does_not_fit_is_named(text, message, space_file):
    with pytest.raises(ConfigError, match=message) as error:
        load_space(space_file(text))
    assert "space.toml" in str(error.value)
    assert "\n" not in str(error.value)
