"""The analysis of the thesis's claims reads tables of the published columns and answers from them, not from memory."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cconv.errors import DataError

pytestmark = pytest.mark.integration

SCRIPT = Path(__file__).parents[1] / "experiments" / "thesis_claims.py"
WORDS = {
    "coordinate_mapping": ["identity", "ball_to_cube_radial", "ball_to_cube_volume_preserving"],
    "window": ["none", "poly6", "gaussian"],
    "activation": ["ReLU", "Tanh", "GeLU", "Leaky_ReLU"],
    "interpolation": ["linear", "nearest_neighbor"],
    "ignore_query_points": [False, True],
    "dense_center_flag": [False, True],
}


@pytest.fixture(scope="module")
def claims():
    spec = importlib.util.spec_from_file_location("thesis_claims", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.RESAMPLES = 100
    return module


def written(folder, claims, error_of):
    """Both tables with random configurations, whose errors are a function of them."""
    rng = np.random.default_rng(0)
    count = 60
    words = pd.DataFrame({name: rng.choice(values, count) for name, values in WORDS.items()})
    numbers = {
        "kernel_size": [1, 2, 3, 4, 8],
        "hidden_units": [16, 48],
        "input_channels": [4, 64],
        "hidden_layers": [0, 4],
    }
    search_2 = words.assign(
        **{name: rng.choice(values, count) for name, values in numbers.items()},
        filter_extent=rng.uniform(0.08, 0.19, count),
        learning_rate=10 ** rng.uniform(-3.9, -2.1, count),
    )
    drawn = {name: rng.uniform(low, high, count) for name, (low, high) in claims.SEARCH_3_DRAWN.items()}
    search_3 = pd.DataFrame(drawn | {name: values[0] for name, values in WORDS.items()})
    for search, file in ((search_2, "search2_random_asha.csv"), (search_3, "search3_bayesian.csv")):
        sizes = [claims.count_parameters(trial) for trial in search.to_dict("records")]
        table = search.assign(num_parameters=sizes)
        errors = error_of(table).rank(pct=True)
        ages = np.where(errors < 0.4, 660.0, 330.0) if file.startswith("search2") else 6000.0
        table.assign(val_loss=errors, step=ages).to_csv(folder / file, index=False)
    return folder


def verdicts(claims, folder):
    figures = claims.analyse(*claims.read_trials(folder))
    found = list(claims.answers(figures))
    text = claims.page(figures, found)
    assert all(f"| {each['claim']} | **{each['verdict']}** |" in text for each in found)
    json.dumps([found, figures], allow_nan=False)
    return {each["claim"].split(" (")[0]: each["verdict"] for each in found}, figures


def test_where_size_decides_the_claim_holds(claims, tmp_path):
    folder = written(tmp_path, claims, lambda table: -(table["num_parameters"] ** 0.5 + 1e3 * table["kernel_size"]))
    found, figures = verdicts(claims, folder)
    assert found["More parameters and larger kernels go with smaller errors."] == "holds"
    assert found["The number of parameters and the kernel size are the strongest predictors."] == "holds"
    assert figures["counted_parameters_agree"] == 1
    assert figures["survival"]["trials"] == figures["complete"]["trials"] == 60
    assert min(figures["search_3_departure_from_uniform"].values()) > 1e-3
    claims.draw(*claims.read_trials(folder), figures, tmp_path)
    assert {path.name for path in tmp_path.glob("*.png")} == {
        "importance_search_2.png",
        "importance_search_3.png",
        "partial_dependence_search_3.png",
    }


def test_where_extent_and_activation_decide_the_claims_do_not_hold(claims, tmp_path):
    folder = written(tmp_path, claims, lambda table: table["filter_extent"] + 9 * (table["activation"] == "Tanh"))
    found, _ = verdicts(claims, folder)
    assert found["The number of parameters and the kernel size are the strongest predictors."] == "does not hold"
    assert found["The filter extent is not among what matters most"] == "does not hold"
    assert found["The activation has little influence."] == "does not hold"
    assert found["Initial weights have a negligible influence."] == "cannot be decided"


def test_parameters_are_counted_as_the_published_trials_count_them(claims):
    trial = {"kernel_size": 6.6528, "hidden_units": 43.95, "input_channels": 26.55, "hidden_layers": 3.12}
    assert claims.count_parameters(trial) == 1585011
    trial = {"kernel_size": 4, "hidden_units": 128, "input_channels": 4, "hidden_layers": 4}
    assert claims.count_parameters(trial) == 3306146


def test_a_missing_table_is_named(claims, tmp_path):
    with pytest.raises(DataError, match="search2_random_asha.csv: no such file; give the folder"):
        claims.read_trials(tmp_path)
