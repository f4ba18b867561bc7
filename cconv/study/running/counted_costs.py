"""The cost of configurations: operations counted before any training, and the time that a cost model predicts."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property, lru_cache

from cconv.evaluation.cost import Cost, counted_cost, neighbor_density
from cconv.evaluation.time_model import check_cost_model
from cconv.networks.counting import CountedCost, NeighborDensity
from cconv.study.declared.configuration import configure
from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.summary import CostModel, SearchPoint
from cconv.study.records.trials import TrialRecord
from cconv.study.running.problem import Problem
from cconv.tasks.features import WALLS

FEWEST_MEASURED = 5  # models, the fewest for a check of the cost model


class CostCounter:
    """A counter of the cost of configurations in the scene of a study, from the settings alone.

    Args:
        study: Study, with the settings that the configurations do not change.
        problem: Scene and samples; neighbours are counted in the first validation frame.
    """

    def __init__(self, study: StudyConfig, problem: Problem):
        self._study, self._problem = study, problem
        self._inputs = problem.valid_samples[0].inputs
        self._around = lru_cache(maxsize=4096)(self._count)

    def __call__(self, parameters: Mapping) -> CountedCost:
        """Count the cost of a prediction per particle by a configuration.

        Raises:
            ConfigError: If its cutoff is larger than the box allows.
        """
        configuration = configure(parameters, self._study.configuration)
        features, network = self._problem.features_of(configuration), configuration.network
        counted = network.count(
            self._problem.task_of(configuration).kinds(features),
            self._inputs.wall_kinds if WALLS in features else None,
            self._problem.task.output,
            self._problem.scene.dim,
            self._around(network.relative_cutoff),
        )
        return counted + self._of_predictor if configuration.with_predictor else counted

    @cached_property
    def _of_predictor(self) -> CountedCost:
        predictor = self._problem.predictor
        return CountedCost() if predictor is None else counted_cost(predictor.config, self._inputs)

    def _count(self, relative_cutoff: float) -> NeighborDensity:
        return neighbor_density(self._inputs, relative_cutoff)


def points_of_search(
    count: CostCounter, records: Sequence[TrialRecord], measured: Mapping[str, Cost]
) -> tuple[list[SearchPoint], CostModel | None]:
    """Give every trial its error and time, which a cost model predicts if the trial was not timed.

    The cost model is fitted to the timed models and checked on them.

    Args:
        count: Counts the cost of a configuration.
        records: Trials and closed forms.
        measured: Cost of the models that were timed in one run, by the id of their trial.

    Returns:
        A point for each trial with an error, and the cost model; no points and None with fewer than five timed models.
    """
    by_id = {record.id: record for record in records}
    known = {name: cost for name, cost in measured.items() if name in by_id}
    if len(known) < FEWEST_MEASURED:
        return [], None
    check = check_cost_model(
        {name: count(by_id[name].parameters) for name in known},
        {name: cost.us_per_particle for name, cost in known.items()},
    )
    particles = next(iter(known.values())).num_particles

    def point(record: TrialRecord, error: float) -> SearchPoint:
        measurement = known.get(record.id)
        predicted = 1e-3 * particles * check.time_model.predict(count(record.parameters))
        return SearchPoint(
            id=record.id,
            stage=record.stage,
            valid_error=error,
            ms_per_frame=predicted if measurement is None else measurement.ms_per_frame,
            measured=measurement is not None,
            num_parameters=record.config["num_parameters"],
            outcome=record.outcome,
            parameters=record.parameters,
        )

    points = [point(record, error) for record in records if (error := record.last_error) is not None]
    return points, CostModel.model_validate(asdict(check))
