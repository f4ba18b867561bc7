"""What configurations of a study cost: counted before anything is trained, and the time that follows from the count."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache

from cconv.evaluation.cost import Cost, neighbor_density
from cconv.evaluation.time_model import check_cost_model
from cconv.networks.counting import CountedCost, NeighborDensity
from cconv.study.declared.configuration import configure
from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.summary import CostModel, SearchPoint
from cconv.study.records.trials import TrialRecord
from cconv.study.running.problem import Problem
from cconv.tasks.features import WALLS, kinds_of

FEWEST_MEASURED = 5  # models that a check of the cost model takes


class CostCounter:
    """Counts the cost of configurations in a study's scene, from the settings alone.

    Args:
        study: Settings that configurations leave as they are.
        problem: Scene and samples; points are counted around the particles of the first validation frame.
    """

    def __init__(self, study: StudyConfig, problem: Problem):
        self._study, self._problem = study, problem
        self._inputs = problem.valid_samples[0].inputs
        self._around = lru_cache(maxsize=4096)(self._count)

    def __call__(self, parameters: Mapping) -> CountedCost:
        """Cost of one particle's prediction by a configuration.

        Raises:
            ConfigError: If its cutoff is more than the box allows.
        """
        features, network, _ = configure(parameters, self._study.configuration)
        return network.count(
            kinds_of(features),
            self._inputs.wall_kinds if WALLS in features else None,
            self._problem.task.output,
            self._problem.scene.dim,
            self._around(network.relative_cutoff),
        )

    def _count(self, relative_cutoff: float) -> NeighborDensity:
        return neighbor_density(self._inputs, relative_cutoff)


def points_of_search(
    count: CostCounter, records: Sequence[TrialRecord], measured: Mapping[str, Cost]
) -> tuple[list[SearchPoint], CostModel | None]:
    """Error and time of every trial, the time by a cost model that is fitted to measured models and checked on them.

    Args:
        count: Counts configurations.
        records: Trials and closed forms.
        measured: Models that were timed in one run, by the id of the trial that found them.

    Returns:
        A point of each trial with an error, and the cost model; none with fewer than five measured models.
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
