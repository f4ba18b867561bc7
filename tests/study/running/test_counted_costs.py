"""Costs counted from settings agree with those of built models, and times follow from them."""

import numpy as np
import pytest
from systems import problem

from cconv.evaluation.cost import Cost, flops_per_particle
from cconv.study.declared.configuration import DEFAULTS, configure
from cconv.study.records.trials import TrialRecord
from cconv.study.running.counted_costs import CostCounter, points_of_search
from cconv.study.studies import Study

STUDY = Study.model_validate({"name": "s", "task": "density_rate", "search": {"space": "s.toml"}})
PARAMETERS = [
    {
        "network.layers": layers,
        "network.first_channels": width,
        "network.hidden_channels": width,
        "network.relative_cutoff": cutoff,
    }
    for layers in (1, 2, 3)
    for width, cutoff in ((4, 1.5), (8, 2.0), (16, 2.5))
]


def record(number, parameters):
    return TrialRecord(
        id=f"random_{number:04d}", stage="random", parameters=parameters, config={"num_parameters": 1},
        log=[{"updates": 9, "valid_error": 0.5, "seconds": 1.0}], outcome="completed", reason="",
    )  # fmt: skip


def cost(us_per_particle):
    return Cost(
        ms_per_frame=us_per_particle * 0.064, ms_low=0.0, ms_high=0.0, geometry_ms=0.0, network_ms=0.0, turns_ms=(),
        us_per_particle=us_per_particle, peak_mb=0.0, flops_per_particle=0.0, threads=1, num_particles=64,
    )  # fmt: skip


@pytest.mark.parametrize(
    "parameters",
    [*PARAMETERS, {"network.architecture": "radial_net", "network.layers": 2}, {"task.features.density": False}],
)
def test_the_count_is_that_of_the_built_model(generator, parameters):
    given = problem(generator)
    model = given.build_model(configure(parameters, DEFAULTS), 0)
    counted = CostCounter(STUDY, given)(parameters).flops_per_particle
    assert counted == pytest.approx(flops_per_particle(model, given.valid_samples[0].inputs))


def test_times_that_follow_from_the_count_are_found_again(generator):
    """Every second trial was measured; the times of the others come from the cost model."""
    count = CostCounter(STUDY, problem(generator))
    records = [record(number, parameters) for number, parameters in enumerate(PARAMETERS)]
    truth = [1.0 + 1e-3 * count(each).flops_per_particle + 1e-4 * count(each).bytes_per_particle for each in PARAMETERS]
    measured = {each.id: cost(time) for each, time in list(zip(records, truth, strict=True))[::2]}
    points, cost_model = points_of_search(count, records, measured)
    assert [point.measured for point in points] == [number % 2 == 0 for number in range(len(records))]
    assert np.allclose([point.ms_per_frame for point in points], 0.064 * np.array(truth), rtol=1e-6)
    assert cost_model.median_relative_error < 1e-6


def test_few_measured_models_predict_nothing(generator):
    count = CostCounter(STUDY, problem(generator))
    records = [record(number, parameters) for number, parameters in enumerate(PARAMETERS)]
    assert points_of_search(count, records, {records[0].id: cost(1.0)}) == ([], None)
