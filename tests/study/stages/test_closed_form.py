"""The closed-form stage: which layers are tried, and what becomes of the best."""

import json
from types import SimpleNamespace

import pytest

from cconv import load_model, open_dataset
from cconv.models.errors import frame_errors, normalized_mse
from cconv.study.declared.configuration import DEFAULTS, HYPERPARAMETERS, feature_path
from cconv.study.declared.domains import SearchSpace
from cconv.study.declared.search_space import load_space
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.trials import identity
from cconv.study.stages import closed_form
from cconv.study.stages.closed_form import (
    _draw,
    _neighbors,
    propose,
    single_layers,
    without_unneeded_features,
)
from cconv.tasks.density_rate import DensityRate
from cconv.tasks.samples import iterate_samples


def space_of(**parameters):
    """A space of choices, named by the ends of their paths."""
    paths = {path.rpartition(".")[2]: path for path in HYPERPARAMETERS}
    domains = {
        paths[name]: {"type": "choice", "values": values, "baseline": values[0], "reason": "test"}
        for name, values in parameters.items()
    }
    return SearchSpace.model_validate({"name": "test", "description": "test", "parameters": domains})


def test_every_combination_is_tried_once_and_what_has_no_effect_is_left_out():
    space = space_of(
        architecture=["conv_net", "radial_net"], kernel_size=[2, 3, 4], radial_terms=[8, 16],
        window=["none", "poly6"], layers=[1, 4], learning_rate=[1e-3, 1e-2],
    )  # fmt: skip
    layers = single_layers(space, DEFAULTS.network, 3)
    grid = [layer for layer in layers if layer["network.architecture"] == "conv_net"]
    radial = [layer for layer in layers if layer["network.architecture"] == "radial_net"]
    assert len(grid) == 3 * 2
    assert len(radial) == 2 * 2
    assert all(
        set(layer) == {"network.layers", "network.architecture", "network.kernel_size", "network.window"}
        for layer in grid
    )
    assert all(
        set(layer) == {"network.layers", "network.architecture", "network.radial_terms", "network.window"}
        for layer in radial
    )
    assert all(layer["network.layers"] == 1 for layer in layers)


def test_ranges_are_sampled_with_both_ends():
    space = load_space("search_spaces/density.toml")
    layers = single_layers(space, DEFAULTS.network, 3)
    assert {layer["network.relative_cutoff"] for layer in layers} == {1.5, 2.0, 2.5}


def test_a_draw_holds_as_many_of_each_basis():
    layers = [{"network.architecture": "conv_net", "network.kernel_size": size} for size in range(50)]
    layers += [{"network.architecture": "radial_net", "network.radial_terms": terms} for terms in range(5)]
    drawn = _draw(layers, 20, seed=0)
    assert len(drawn) == 20
    assert sum(layer["network.architecture"] == "radial_net" for layer in drawn) == 5
    assert drawn == _draw(layers, 20, seed=0) != _draw(layers, 20, seed=1)
    assert _draw(layers, 100, seed=0) == layers


LAYERS = single_layers(
    space_of(
        architecture=["conv_net", "radial_net"],
        kernel_size=[2, 3, 4],
        radial_terms=[8, 16, 32],
        window=["none", "poly6"],
    ),
    DEFAULTS.network,
    3,
)
RADIAL = [layer for layer in LAYERS if layer["network.architecture"] == "radial_net"]
GRID = [layer for layer in LAYERS if layer["network.architecture"] == "conv_net"]


def changes(layer, other):
    """Settings that both layers have and that differ."""
    return {name for name in layer.keys() & other if layer[name] != other[name]}


def without(layers, tried):
    known = {identity(layer) for layer in tried}
    return [layer for layer in layers if identity(layer) not in known]


def winners_of(*layers):
    return [SimpleNamespace(parameters=layer) for layer in layers]


BASIS_SIZES = {"network.kernel_size"}, {"network.radial_terms"}


@pytest.mark.parametrize("winners", [RADIAL[:1], RADIAL[:2], [GRID[0], RADIAL[0]], [RADIAL[0], RADIAL[-1]]])
def test_every_other_number_of_basis_functions_of_every_winner_comes_first_and_once(winners):
    untried = without(LAYERS, winners)
    proposed = propose(winners_of(*winners), untried)
    near = [layer for layer in LAYERS if any(changes(layer, winner) in BASIS_SIZES for winner in winners)]
    assert sorted(map(identity, proposed)) == sorted(identity(layer) for layer in near if layer in untried)


def test_then_come_the_layers_one_change_away_from_the_most_accurate_winner_that_has_any_left():
    first, second = GRID[0], RADIAL[0]
    winners = [first, second]
    of_other_size = [each for each in LAYERS if any(changes(each, winner) in BASIS_SIZES for winner in winners)]
    untried = without(LAYERS, [*winners, *of_other_size])
    proposed = propose(winners_of(first, second), untried)
    assert proposed
    assert all(len(changes(layer, first)) == 1 for layer in proposed)
    proposed_later = propose(winners_of(first, second), without(untried, proposed))
    assert proposed_later
    assert all(len(changes(layer, second)) == 1 for layer in proposed_later)


@pytest.mark.parametrize("winners", [[GRID[0]], [RADIAL[0]], [RADIAL[0], GRID[0]], [GRID[0], RADIAL[-1], RADIAL[0]]])
def test_proposals_to_the_same_winners_end_when_nothing_is_left_near_them(winners):
    untried = without(LAYERS, winners)
    while batch := propose(winners_of(*winners), untried):
        assert all(layer in untried for layer in batch)
        untried = without(untried, batch)
    assert all(len(changes(layer, winner)) != 1 for layer in untried for winner in winners)
    assert propose([], LAYERS) == []


@pytest.fixture
def run(finished_run):
    return RunFolder.open(finished_run)


def test_the_best_is_fitted_to_all_frames_and_tested_like_the_others(run, flow_folder):
    screened = [record for record in run.trials() if record.stage == "closed_form"]
    best = min(screened, key=lambda record: record.last["valid_error"])
    entry = run.summary().finalist(best.id)
    (record,) = run.retrainings()[entry.id]
    assert record.is_closed_form
    model = load_model(run.path / entry.checkpoint)
    samples = list(iterate_samples(open_dataset(flow_folder), "test", model.task))
    assert entry.test.error == pytest.approx(normalized_mse(frame_errors(model, samples)), rel=1e-6)
    assert list(entry.test.by_seed) == [record.id]
    assert "1 unit says too little of others" in entry.test.why_no_interval
    card = json.loads((run.path / entry.checkpoint / "card.json").read_text())
    assert card["closed_form"]
    assert card["test"]["ci95"] is entry.test.ci95 is None


@pytest.mark.parametrize(
    ("errors", "kept"),
    [
        ({"walls density": 1.0, "density": 1.04, "": 1.08}, ""),  # each within the margin of the one before
        ({"walls density": 1.0, "density": 1.06, "walls": 0.5}, "walls"),
        ({"walls density": 1.0, "density": 0.9, "": 0.96}, "density"),
        ({"walls density": 1.0, "density": 1.06, "walls": 1.06}, "walls density"),
    ],
)
def test_a_finalist_loses_the_branches_that_its_error_does_not_need(errors, kept, tmp_path, monkeypatch):
    def fit(session, parameters, folder, stage, seed, ridge):
        folder.start({"stage": stage, "parameters": parameters})
        error = errors[" ".join(branch for branch in DensityRate.optional if parameters[feature_path(branch)])]
        folder.append({"updates": 0, "valid_error": error, "seconds": 1.0})

    monkeypatch.setattr(closed_form, "fit_whole", fit)
    space = space_of(walls=[True, False], density=[True, False])
    study = SimpleNamespace(selection=SimpleNamespace(margin=0.05))
    session = SimpleNamespace(run=RunFolder(tmp_path), space=space, study=study)
    candidate = SimpleNamespace(
        id="found", parameters={"network.layers": 1, "task.features.walls": True, "task.features.density": True}
    )
    finalist, parameters = without_unneeded_features(session, candidate, seed=1, ridge=0.0)
    assert " ".join(branch for branch in DensityRate.optional if parameters[feature_path(branch)]) == kept
    assert finalist == "found" + "".join(
        f"_no_{branch}" for branch in DensityRate.optional if not parameters[feature_path(branch)]
    )
    assert session.run.finalist(finalist, 1).parameters == parameters


def test_a_finalist_keeps_a_branch_that_the_space_does_not_vary(tmp_path, monkeypatch):
    fitted = []

    def fit(session, parameters, folder, stage, seed, ridge):
        fitted.append(parameters)
        folder.start({"stage": stage, "parameters": parameters})

    monkeypatch.setattr(closed_form, "fit_whole", fit)
    session = SimpleNamespace(run=RunFolder(tmp_path), space=space_of(walls=[True]))
    candidate = SimpleNamespace(id="found", parameters={"network.layers": 1, "task.features.walls": True})
    assert without_unneeded_features(session, candidate, seed=1, ridge=0.0) == ("found", candidate.parameters)
    assert fitted == [candidate.parameters]


def test_candidates_go_on_from_the_would_be_finalists(run):
    """Of four candidates the last two are one change away from the best of those before them."""
    records = run.trials_of("closed_form")
    best = min(records[:2], key=lambda record: record.best)
    for record in records[2:]:
        parents = [best, *records[2:]]
        assert any(record in _neighbors_of(parent, records) for parent in parents)


def _neighbors_of(parent, records):
    near = _neighbors(parent.parameters, [record.parameters for record in records])
    return [record for record in records if record.parameters in near]


def test_optuna_is_told_of_trained_trials_only(run):
    import optuna

    from cconv.study.running.optuna_mirror import open_storage

    study = optuna.load_study(study_name="smoke", storage=open_storage(run.path / "optuna.journal"))
    assert {trial.user_attrs["trial"].split("_")[0] for trial in study.trials} == {"random", "adaptive"}
