from itertools import product
from pathlib import Path

import pytest

from cconv.errors import ConfigError
from cconv.models.relaxation import Relaxation
from cconv.networks import RadialNetSettings
from cconv.networks.counting import CountedCost
from cconv.study.declared.configuration import DEFAULTS, configure
from cconv.study.declared.domains import Choice, SearchSpace, fixed, narrowed
from cconv.study.declared.search_space import (
    check_baseline_affordable,
    load_space,
    longest_history,
    may_add_force,
    study_space,
)
from cconv.study.stages.closed_form import MOST_LAYERS, single_layers
from cconv.study.studies import load_study

REPOSITORY = Path(__file__).parents[3]
SPACES = sorted((REPOSITORY / "search_spaces").glob("*.toml"))

HEAD = 'name = "mini"\ndescription = "For tests."\n'
CHOICE = '[parameters.network.window]\ntype = "choice"\nvalues = ["none", "poly6"]\nbaseline = "poly6"\nreason = "r"\n'
FLOAT = """[parameters.training.learning_rate]
type = "float"
range = [1e-4, 1e-2]
scale = "log"
baseline = 1e-3
reason = "r"
"""
INT = """[parameters.network.kernel_size]
type = "int"
range = [3, 6]
baseline = 4
reason = "r"
"""


ARCHITECTURE = """[parameters.network.architecture]
type = "choice"
values = ["conv_net", "radial_net"]
baseline = "conv_net"
reason = "r"
"""
SKIP = """[parameters.network.skip]
type = "choice"
values = ["after_activation"]
baseline = "after_activation"
reason = "r"
"""
OF_GRID = 'when = { network.architecture = ["conv_net"] }\n'


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
    configure(space.baseline, DEFAULTS)


@pytest.mark.parametrize("name", ["density", "thesis_initial", "thesis_random", "thesis_bayesian"])
def test_the_baseline_is_the_published_network_and_training(name):
    space = load_space(next(path for path in SPACES if path.stem == name))
    assert configure(space.baseline, DEFAULTS) == DEFAULTS


def conditional_space():
    """Kernel size on the grid only; mapping only for the larger two; terms on the radial architecture only."""
    parameters = {
        "network.mapping": {"values": ["identity", "ball_to_cube_radial"], "when": {"network.kernel_size": [4, 5]}},
        "network.kernel_size": {
            "type": "int",
            "range": [3, 5],
            "baseline": 4,
            "when": {"network.architecture": ["conv_net"]},
        },
        "network.architecture": {"values": ["conv_net", "radial_net"]},
        "network.radial_terms": {"values": [8, 16], "when": {"network.architecture": ["radial_net"]}},
        "network.window": {
            "values": ["none", "poly6"],
            "when": {"network.architecture": ["conv_net"], "network.layers": [2]},
        },
        "network.layers": {"values": [1, 2]},
    }
    for parameter in parameters.values():
        parameter.setdefault("type", "choice")
        parameter.setdefault("baseline", parameter.get("values", [None])[0])
        parameter["reason"] = "r"
    return SearchSpace.model_validate({"name": "c", "description": "d", "parameters": parameters})


ALL = {
    "network.mapping": "identity",
    "network.kernel_size": 4,
    "network.architecture": "conv_net",
    "network.radial_terms": 8,
    "network.window": "none",
    "network.layers": 2,
}


@pytest.mark.parametrize(
    ("changes", "active"),
    [
        ({}, {"network.mapping", "network.kernel_size", "network.architecture", "network.window", "network.layers"}),
        (
            {"network.kernel_size": 3},
            {"network.kernel_size", "network.architecture", "network.window", "network.layers"},
        ),
        ({"network.layers": 1}, {"network.mapping", "network.kernel_size", "network.architecture", "network.layers"}),
        ({"network.architecture": "radial_net"}, {"network.architecture", "network.radial_terms", "network.layers"}),
    ],
)
def test_a_parameter_is_active_where_all_its_conditions_hold(changes, active):
    space, values = conditional_space(), ALL | changes
    assert space.active(values) == {name: values[name] for name in values if name in active}
    assert space.active(space.active(values)) == space.active(values)


def test_parents_come_before_those_that_depend_on_them():
    order = conditional_space().parents_first
    assert sorted(order) == sorted(ALL)
    assert order.index("network.architecture") < order.index("network.kernel_size") < order.index("network.mapping")


def test_the_baseline_holds_active_parameters_only():
    assert conditional_space().baseline == {
        "network.mapping": "identity",
        "network.kernel_size": 4,
        "network.architecture": "conv_net",
        "network.layers": 1,
    }


def test_a_configuration_is_whole_and_in_its_domain():
    space = conditional_space()
    whole = space.active(ALL)
    assert space.holds(whole)
    assert space.holds({"network.architecture": "radial_net", "network.radial_terms": 8, "network.layers": 1})
    missing = {name: value for name, value in whole.items() if name != "network.mapping"}
    for wrong in (ALL, missing, whole | {"network.kernel_size": 7}, whole | {"training.learning_rate": 1e-3}):
        assert not space.holds(wrong)


def test_conditions_follow_a_narrower_domain():
    space = conditional_space()
    small = narrowed(
        space, {"network.kernel_size": space.parameters["network.kernel_size"].model_copy(update={"range": (3, 4)})}
    )
    assert small.parameters["network.mapping"].when == {"network.kernel_size": [4]}
    grid = Choice(type="choice", values=["conv_net"], baseline="conv_net", reason="r")
    assert narrowed(space, {"network.architecture": grid}).parameters.keys() == ALL.keys() - {"network.radial_terms"}


def test_a_fixed_parameter_keeps_its_baseline_and_what_depends_on_it():
    space = fixed(conditional_space(), "network.layers")
    assert space.parameters["network.layers"].values == [1]
    assert "network.window" not in space.parameters
    assert space.baseline == conditional_space().baseline
    assert fixed(space, "task.features.walls") == space


def test_single_layers_hold_what_is_active_in_one():
    layers = single_layers(conditional_space(), DEFAULTS.network, 3)
    grid = [layer for layer in layers if layer["network.architecture"] == "conv_net"]
    assert [layer for layer in grid if layer["network.kernel_size"] == 3] == [
        {"network.layers": 1, "network.architecture": "conv_net", "network.kernel_size": 3}
    ]
    assert all(
        set(layer) == {"network.layers", "network.architecture", "network.kernel_size", "network.mapping"}
        for layer in grid
        if layer["network.kernel_size"] > 3
    )
    assert len(grid) == 1 + 2 * 2  # no window: it takes two layers
    radial = [layer for layer in layers if layer["network.architecture"] == "radial_net"]
    assert radial == [
        {"network.layers": 1, "network.architecture": "radial_net", "network.radial_terms": terms} for terms in (8, 16)
    ]


def test_single_layers_of_the_density_space_are_distinct_configurations_with_all_switches():
    space = load_space(next(path for path in SPACES if path.stem == "density"))
    layers = single_layers(space, DEFAULTS.network, 2)
    assert len({repr(sorted(layer.items())) for layer in layers}) == len(layers)
    assert all(space.holds(layer | {"training.learning_rate": 1e-3}) for layer in layers)
    assert {(layer["task.features.walls"], layer["task.features.density"]) for layer in layers} == set(
        product([True, False], repeat=2)
    )


def test_a_baseline_above_the_cap_is_refused():
    space = conditional_space().model_copy(update={"max_flops_per_particle": 2e6})
    check_baseline_affordable(space, lambda parameters: costing(1e6 if parameters == space.baseline else 3e6))
    check_baseline_affordable(conditional_space(), lambda parameters: costing(1e9))
    with pytest.raises(ConfigError, match=r"'c': its baseline costs 3e\+06 flops .* `max_flops_per_particle` = 2e"):
        check_baseline_affordable(space, lambda parameters: costing(3e6))
    space = conditional_space().model_copy(update={"max_bytes_per_particle": 1e3})
    with pytest.raises(ConfigError, match="costs 2e.03 bytes per particle .* `max_bytes_per_particle` = 1e"):
        check_baseline_affordable(space, lambda parameters: costing(3e6))


def costing(flops):
    return CountedCost(flops_per_particle=flops, bytes_per_particle=2e3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CHOICE.replace("window", "windw"), r"`parameters\.network\.windw`\. Did you mean 'network\.window'"),
        (CHOICE.replace("reason", "because"), "unknown key `parameters.network.window.because`"),
        (CHOICE.replace('baseline = "poly6"', 'baseline = "gauss"'), "baseline 'gauss' must be one of the values"),
        (CHOICE.replace('"none"', '"nothing"'), "`parameters.network.window`: the value 'nothing' is not possible"),
        (FLOAT.replace("1e-3", "1.0"), r"baseline 1\.0 must lie in the range"),
        (FLOAT.replace("[1e-4, 1e-2]", "[1e-2, 1e-4]"), "lower end first"),
        (FLOAT.replace("[1e-4, 1e-2]", "[0.0, 1e-2]"), "positive on a log scale"),
        (INT.replace("[3, 6]", "[0, 6]"), "the value 0 is not possible"),
        (INT.replace('"int"', '"integer"'), "parameters.network.kernel_size"),
        ("", "`parameters` is missing"),
        ("max_flops_per_particle = 0.0\n" + CHOICE, "`max_flops_per_particle`: input should be greater than 0"),
        (
            INT + OF_GRID,
            r"`parameters\.network\.kernel_size\.when\.network\.architecture`: names no parameter of the space",
        ),
        (INT + 'when = { architectures = ["conv_net"] }\n' + ARCHITECTURE, r"Did you mean 'network.architecture'"),
        (
            INT + 'when = { network.architecture = ["gird"] }\n' + ARCHITECTURE,
            r"architecture`: lists 'gird', which is not in the domain of 'network.architecture'",
        ),
        (
            INT + "when = { network.architecture = [] }\n" + ARCHITECTURE,
            r"`parameters\.network\.kernel_size\.when\.network\.architecture`: list should have",
        ),
        (
            CHOICE + "when = { network.kernel_size = [7] }\n" + INT,
            r"when\.network\.kernel_size`: lists 7, which is not in the domain",
        ),
        (CHOICE + "when = { training.learning_rate = [1e-3] }\n" + FLOAT, "'training.learning_rate' is a real number"),
        (
            CHOICE + "when = { network.kernel_size = [4] }\n" + INT + 'when = { network.window = ["none"] }\n',
            "closes a circle of cond",
        ),
        (
            ARCHITECTURE + INT,
            r'kernel_size`: is no setting of radial_net, .* `when = . network.architecture = \["conv_net"\] .`',
        ),
        (
            ARCHITECTURE.replace('= "conv_net"', '= "radial_net"') + SKIP,
            r"the baseline is not possible .network.skip: Input should be 'before_activation'",
        ),
        (
            FLOAT.replace("1e-2]", "inf]"),
            r"`parameters\.training\.learning_rate\.range\.1`: input should be a finite number",
        ),
        (FLOAT.replace("1e-4", "1e-300"), r"the value 1e-300 is not possible"),
        (
            INT.replace("= 4", "= true"),
            r"`parameters\.network\.kernel_size\.baseline`: input should be a valid integer, got True",
        ),
        (INT.replace("[3, 6]", "[3, 100000000000]"), r"range\.1`: input should be less than or equal to 1000000000"),
        (
            CHOICE.replace('["none",', "[nan,"),
            r"`parameters\.network\.window\.values\.0`: must be true, false, a number",
        ),
        (CHOICE.replace('"none"', ", ".join(f'"{n}"' for n in range(200))), "list should have at most 100 items"),
        ("max_flops_per_particle = inf\n" + CHOICE, "`max_flops_per_particle`: input should be a finite number"),
        (
            CHOICE.replace('"r"', '"\\u001b[2J"'),
            "`parameters.network.window.reason`: a text must hold no control characters",
        ),
        ("x." * 100_000 + "x = 1\n" + CHOICE, "a key has more than 32 parts"),
    ],
)
def test_what_does_not_fit_is_named(text, message, space_file):
    with pytest.raises(ConfigError, match=message) as error:
        load_space(space_file(text))
    assert "space.toml" in str(error.value)
    assert "\n" not in str(error.value)


def test_true_is_no_one(space_file):
    layers = '[parameters.network.layers]\ntype = "choice"\nvalues = [1, 2]\nbaseline = 1\nreason = "r"\n'
    assert not load_space(space_file(layers)).holds({"network.layers": True})
    with pytest.raises(ConfigError, match="baseline True must be one of"):
        load_space(space_file(layers.replace("baseline = 1", "baseline = true")))


def test_a_space_is_checked_with_the_settings_of_its_study(space_file):
    path = space_file(ARCHITECTURE)
    study = load_study(REPOSITORY / "experiments" / "smoke.toml", ["network.skip=after_activation"])
    load_space(path)
    with pytest.raises(
        ConfigError,
        match="`parameters.network.architecture`: the value 'radial_net' is not possible .network.skip: Input",
    ):
        load_space(path, study)


@pytest.mark.parametrize(
    ("name", "values", "baseline", "message"),
    [
        (
            "training.noise",
            "[0.0, 0.1]",
            "0.0",
            r"the value 0\.1 is not possible .training\.noise: must be 0 for the field",
        ),
        ("task.history", "[2, 3]", "3", "the value 2 is not possible .task.history: .* must be 1 for the task"),
        ("training.pushforward", "[0, 3]", "0", "the value 3 is not possible .*must be 0 for the field"),
        ("task.features.force", "[true, false]", "false", "the value True is not possible .*no feature of the task"),
    ],
)
def test_what_only_steps_have_is_refused_in_the_space_of_a_field(name, values, baseline, message, space_file):
    """Trials would end the study only after others were trained."""
    path = space_file(f'[parameters.{name}]\ntype = "choice"\nvalues = {values}\nbaseline = {baseline}\nreason = "r"\n')
    with pytest.raises(ConfigError, match=message):
        load_space(path, load_study(REPOSITORY / "experiments" / "smoke.toml"))
    load_space(path, load_study(REPOSITORY / "experiments" / "rollout.toml"))


@pytest.mark.parametrize("values", ["[2, true]", '[2, "3"]', "[2, 2.5]", "[2, 21]", "[1, 2]"])
def test_a_history_that_steps_cannot_have_is_refused(values, space_file):
    path = space_file(f'[parameters.task.history]\ntype = "choice"\nvalues = {values}\nbaseline = 2\nreason = "r"\n')
    with pytest.raises(ConfigError, match=r"the value .* is not possible .task\.history: "):
        load_space(path, load_study(REPOSITORY / "experiments" / "rollout.toml"))


@pytest.mark.parametrize(
    ("domain", "own", "longest"),
    [
        ('type = "choice"\nvalues = [2, 5]\nbaseline = 2', 3, 5),
        ('type = "int"\nrange = [2, 7]\nbaseline = 2', 3, 7),
        ('type = "choice"\nvalues = [2, 5]\nbaseline = 2', 8, 8),
    ],
)
def test_the_longest_history_is_that_of_any_configuration(domain, own, longest, space_file):
    study = load_study(REPOSITORY / "experiments" / "rollout.toml", [f"task.history={own}"])
    space = load_space(space_file(f'[parameters.task.history]\n{domain}\nreason = "r"\n'), study)
    assert longest_history(space, study) == longest
    assert study.configured({"task.history": 2}).history == 2
    assert study.configured({}).history == own


FORCE = '[parameters.task.external_force]\ntype = "choice"\nvalues = {}\nbaseline = "network"\nreason = "r"\n'


@pytest.mark.parametrize(
    ("values", "own", "added"),
    [
        (["network", "integrator"], "network", True),
        (["network"], "network", False),
        (["network"], "integrator", True),
    ],
)
def test_who_knows_of_the_external_force_is_a_hyperparameter_of_steps(values, own, added, space_file):
    study = load_study(REPOSITORY / "experiments" / "rollout.toml", [f"task.external_force={own}"])
    assert may_add_force(load_space(space_file(FORCE.format(values)), study), study) == added
    assert study.configured({"task.external_force": "integrator"}).external_force == "integrator"
    assert study.configured({}).external_force == own


def test_the_external_force_is_known_to_the_network_or_the_integrator_of_a_step(space_file):
    study = load_study(REPOSITORY / "experiments" / "rollout.toml")
    with pytest.raises(ConfigError, match=r"task\.external_force: must be 'network' or 'integrator'"):
        load_space(space_file(FORCE.format(["network", "solver"])), study)
    field = load_study(REPOSITORY / "experiments" / "quick.toml")
    with pytest.raises(ConfigError, match=r"task\.external_force: is for steps, and 'density_rate' is a field"):
        load_space(space_file(FORCE.format(["network", "integrator"])), field)


def test_layers_of_a_huge_space_are_drawn_without_listing_them():
    """2e13 layers, of which no more than a limit are ever held."""
    choices = {
        "network.relative_cutoff": [1.5 + number / 100 for number in range(100)],
        "network.radial_terms": list(range(1, 101)),
    }
    for name in ("network.window", "network.mapping", "network.interpolation", "network.message", "network.normalize"):
        choices[name] = [f"{name}{number}" for number in range(50)]
    parameters = {
        name: {"type": "choice", "values": values, "baseline": values[0], "reason": "r"}
        for name, values in choices.items()
    }
    space = SearchSpace.model_validate({"name": "huge", "description": "d", "parameters": parameters})
    network = RadialNetSettings()
    layers = single_layers(space, network, 3)
    assert 1000 < len(layers) <= MOST_LAYERS
    assert {layer["network.relative_cutoff"] for layer in layers} == set(choices["network.relative_cutoff"])
    assert layers == single_layers(space, network, 3)


RELAXATION = (
    '[parameters.rollout.relaxation.alpha]\ntype = "choice"\nvalues = [0.0, 0.02]\nbaseline = 0.02\nreason = "r"\n'
)


def test_the_relaxation_of_rollouts_is_a_hyperparameter_of_steps(space_file):
    study = load_study(REPOSITORY / "experiments" / "rollout.toml", ["rollout.relaxation.alpha=0.01"])
    assert study.configured({}).relaxation == Relaxation(alpha=0.01)
    drawn = study.configured({"rollout.relaxation.alpha": 0.02, "rollout.relaxation.loops": 3})
    assert drawn.relaxation == Relaxation(alpha=0.02, loops=3)
    assert study.configured({"rollout.relaxation.alpha": 0.0}).relaxation is None
    assert load_space(space_file(RELAXATION)).parameters["rollout.relaxation.alpha"].baseline == 0.02


def test_a_relaxation_needs_a_size_and_a_step():
    study = load_study(REPOSITORY / "experiments" / "rollout.toml", [])
    assert study.configured({"rollout.relaxation.loops": 3}).relaxation is None
    with pytest.raises(ConfigError, match=r"rollout\.relaxation\.alpha: "):
        study.configured({"rollout.relaxation.alpha": -1.0})
    with pytest.raises(ConfigError, match="rollout.relaxation.alpha"):
        load_study(REPOSITORY / "experiments" / "rollout.toml", ["rollout.relaxation.loops=3"])
    with pytest.raises(ConfigError, match=r"rollout\.relaxation: is for steps, and 'density_gradient' is a field"):
        load_study(REPOSITORY / "experiments" / "smoke.toml", ["rollout.relaxation.alpha=0.01"])


def test_a_study_has_a_baseline_of_its_own(space_file):
    path = space_file(FLOAT + CHOICE)
    study = load_study(REPOSITORY / "experiments" / "quick.toml", [f"search.space={path}"])
    own = study.search.model_copy(update={"baseline": {"training.learning_rate": 5e-3}})
    space = study_space(study.model_copy(update={"search": own}))
    assert space.baseline == {"training.learning_rate": 5e-3, "network.window": "poly6"}
    assert study_space(study).baseline["training.learning_rate"] == 1e-3


@pytest.mark.parametrize(
    ("baseline", "message"),
    [
        ({"training.learning_rate": 1.0}, r"`search\.baseline\.training\.learning_rate`.*must lie in the range"),
        ({"training.noise": 0.1}, r"`search\.baseline\.training\.noise`: no such parameter"),
    ],
)
def test_a_baseline_lies_within_the_space(baseline, message, space_file):
    study = load_study(REPOSITORY / "experiments" / "quick.toml", [f"search.space={space_file(FLOAT + CHOICE)}"])
    own = study.search.model_copy(update={"baseline": baseline})
    with pytest.raises(ConfigError, match=message):
        study_space(study.model_copy(update={"search": own}))
