"""The finalists stage retrains the best configurations and the baseline with fresh seeds.

The select stage evaluates, times and compares them with the functions at the end of this file.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from cconv.errors import DataError, StudyError
from cconv.evaluation.cost import Cost
from cconv.evaluation.objectives import Objective
from cconv.evaluation.statistics import FEWEST, interval_beside, why_no_interval
from cconv.models.checkpoint import load_model, read_card, save_model
from cconv.models.model import Model
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.declared.paths import paths_of_tables
from cconv.study.declared.stage import BASELINE, Stage
from cconv.study.declared.study_file import StudyConfig
from cconv.study.evidence.budget import fall_at_the_end
from cconv.study.evidence.recommendation import choose_finalists
from cconv.study.records.found import Found
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import Errors, FinalistConfig, FinalistEntry, ModelCost, Stability, Units
from cconv.study.records.trials import TrialRecord
from cconv.study.running.trial_queue import Job, job_in
from cconv.study.stages.closed_form import fit_closed_form_finalists
from cconv.study.stages.jobs import train_all
from cconv.study.stages.session import Session
from cconv.tasks.samples import Sample
from cconv.validation import Name, Value, Whole

FINALISTS = "finalists"


@dataclass(frozen=True, kw_only=True)
class Finalist:
    """A configuration that is retrained.

    Attributes:
        id: "baseline", the id of the trial that found the configuration, or its name in the study file.
        parameters: Its hyperparameters.
    """

    id: str
    parameters: dict


@dataclass(frozen=True, kw_only=True)
class Retrained:
    """A finalist all of whose retrainings finished.

    Attributes:
        id: Its id.
        records: Its retrainings, one a seed.
        checkpoints: Checkpoint folder of each.
    """

    id: str
    records: list[TrialRecord]
    checkpoints: list[Path]

    @property
    def valid_errors(self) -> list[float]:
        """Validation error of each checkpoint, the smallest of its training."""
        return [record.best for record in self.records]

    @property
    def best_checkpoint(self) -> Path:
        """Checkpoint with the smallest validation error."""
        return self.checkpoints[int(np.argmin(self.valid_errors))]


class FinalistsStage(Stage):
    """Retrain the `count` best configurations and the baseline with fresh seeds; fit the best closed forms.

    `include` holds further configurations, e.g. a published one, by the id that they get. Without a search before it,
    these and the baseline are all finalists.
    """

    kind: Literal["finalists"] = "finalists"
    uses = ("closed_form", "random", "adaptive")
    count: Whole = Field(3, ge=1, le=1000)
    include: dict[Name, dict[str, Value]] = Field({}, max_length=100)

    @field_validator("include", mode="before")
    @classmethod
    def _hyperparameters_by_path(cls, include: object) -> object:
        if not isinstance(include, Mapping):
            return include
        return {name: paths_of_tables(each) for name, each in include.items()}

    @property
    def included(self) -> Mapping[str, dict[str, Value]]:
        """Hyperparameters of the configurations that the stage makes finalists, by the id that they get."""
        return self.include

    def run(self, session: Session, name: str) -> Found:
        """Retrain the baseline, named configurations and the best of the searches; fit the closed forms.

        Raises:
            StudyError: If none of them finished its training.
        """
        study = session.study
        first_seed = study.seeds.init + 1
        closed = fit_closed_form_finalists(session, name, first_seed)
        named = {BASELINE: session.space.baseline, **self.include}
        searched = {record.id: record.parameters for record in self._best_trials(session, name)}
        trained = [Finalist(id=finalist, parameters=parameters) for finalist, parameters in (named | searched).items()]
        jobs = finalist_jobs(trained, study.finalists.seeds, first_seed, session.run)
        train_all(session, FINALISTS, jobs, finalist_training(study))
        finalists = named | searched | closed
        check_any_finished(session.run, *retrained_finalists(session.run, finalists, study.finalists.seeds))
        return Found(finalists=finalists)

    def _best_trials(self, session: Session, name: str) -> list[TrialRecord]:
        """Return the best trained configurations of the searches that the stage reads, without the baseline."""
        records = session.read(name, "random", "adaptive")
        others = [record for record in records if record.parameters != session.space.baseline]
        cost = {record.id: record.config["flops_per_particle"] for record in others}
        return choose_finalists(others, cost, self.count, session.study.selection.accurate_enough)


def check_any_finished(run: RunFolder, finished: Sequence[Retrained], failed: Mapping[str, str]) -> None:
    """Raise `StudyError`, with the outcome of each training, if no finalist finished its trainings."""
    if not finished:
        ends = ". ".join(f"{finalist}: {end}" for finalist, end in failed.items())
        raise StudyError(f"{run.path}: no finalist finished its training ({ends}); see trials/ and finalists/ there.")


def finalist_training(study: StudyConfig) -> TrainingConfig:
    """Return the training settings of the finalists: those of the search with the finalists' budget."""
    return study.training.model_copy(update={"updates": study.finalists.updates or study.training.updates})


def finalist_jobs(finalists: Sequence[Finalist], num_seeds: int, first_seed: int, run: RunFolder) -> list[Job]:
    """List the trainings of every finalist with `num_seeds` initialisation seeds that the search did not use.

    The trainings run in this order; give the costliest finalist, usually the baseline, first.
    """
    return [
        job_in(run.finalist(finalist.id, seed), f"{finalist.id}/seed_{seed}", finalist.parameters, seed)
        for finalist in finalists
        for seed in range(first_seed, first_seed + num_seeds)
    ]


def retrained_finalists(
    run: RunFolder, finalists: Iterable[str], num_seeds: int
) -> tuple[list[Retrained], dict[str, str]]:
    """Separate the finalists whose trainings all finished, one fit for a closed form, from the failed ones.

    Returns:
        The finished finalists, and by the id of each other one how its trainings ended.

    Raises:
        DataError: If the records of a finalist are missing.
    """
    retrained, failed = [], {}
    retrainings = run.retrainings()
    for finalist in dict.fromkeys(finalists):  # two stages of finalists have the baseline in common
        if finalist not in retrainings:
            raise DataError(f"{run.path}: no retraining of {finalist!r} in finalists/; restore it, or run it again.")
        records = retrainings[finalist]
        lost = [record for record in records if record.outcome != "completed"]
        wanted = 1 if records[0].is_closed_form else num_seeds
        if lost or len(records) < wanted:
            ends = [f"{record.id} {record.outcome} {record.reason}".strip() for record in lost]
            failed[finalist] = "; ".join(ends) or f"only {len(records)} of {wanted} seeds were trained"
        else:
            folders = [run.finalist(finalist, record.config["init_seed"]).checkpoint for record in records]
            retrained.append(Retrained(id=finalist, records=records, checkpoints=folders))
    return retrained, failed


def evaluate_finalist(
    finalist: Retrained,
    objective: Objective,
    samples: Sequence[Sample],
    frames_per_block: int,
    load: Callable[[Path], Model] = load_model,
) -> tuple[Errors, np.ndarray]:
    """Measure the errors of a finalist on a split, over its seeds.

    Args:
        finalist: The finalist.
        objective: The error that finalists are compared by.
        samples: Frames of the split.
        frames_per_block: Frames of a unit if the split has a single trajectory.
        load: Reads a checkpoint folder, e.g. onto a device.

    Returns:
        The mean errors, and the errors of each seed and unit (seeds, units).

    Raises:
        StudyError: If a prediction is not finite.
    """
    tables = [objective.table(load(each), samples, frames_per_block) for each in finalist.checkpoints]
    by_seed = [table.error for table in tables]
    units = np.stack([table.units for table in tables])
    mean = float(np.mean(by_seed))
    if not math.isfinite(mean):
        raise StudyError(
            f"finalist {finalist.id}: its predictions on a split are not finite; leave it out, or train it anew."
        )
    why = _why_one_says_little(finalist) or why_no_interval(*units.shape)
    facts = Errors(
        error=mean,
        in_words=objective.in_words(mean),
        measures={name: _mean_of_seeds([table.measures[name] for table in tables]) for name in objective.measures},
        ci95=None if why else interval_beside(mean, units),
        why_no_interval=why,
        by_seed=dict(zip([record.id for record in finalist.records], by_seed, strict=True)),
        units=Units(count=units.shape[1], worst=float(units.mean(axis=0).max())),
    )
    return facts, units


def _why_one_says_little(finalist: Retrained) -> str:
    """Why a single training gives no interval, or ""; a closed form has no chance of trainings."""
    if len(finalist.records) > 1 or finalist.records[0].is_closed_form:
        return ""
    return f"1 training says too little of others; at least {FEWEST} are needed"


def _mean_of_seeds(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None


def finalist_entry(
    finalist: Retrained, valid: Errors, test: Errors, cost: Cost, stability: Stability, run: RunFolder
) -> FinalistEntry:
    """Build the entry of a finalist in summary.json."""
    config = finalist.records[0].config
    return FinalistEntry(
        id=finalist.id,
        in_words=_in_words(load_model(finalist.best_checkpoint)),
        config=FinalistConfig(network=config["network"], training=config["training"], parameters=config["parameters"]),
        num_parameters=config["num_parameters"],
        updates=round(np.mean([record.log[-1]["updates"] for record in finalist.records])),
        fall_at_the_end=fall_at_the_end(finalist.records),
        valid=valid,
        test=test,
        cost=ModelCost.model_validate(cost, from_attributes=True),
        stability=stability,
        checkpoint=str(finalist.best_checkpoint.relative_to(run.path)),
        train_seconds=float(np.mean([record.log[-1]["seconds"] for record in finalist.records])),
        train_cpu_seconds=_mean_of_seeds([record.log[-1].get("cpu_seconds") for record in finalist.records]),
    )


def _in_words(model: Model) -> str:
    """What a model's network is, and whether it corrects another model's step."""
    after = "" if model.predictor is None else f" after a predictor, a {model.predictor.settings.in_words}"
    return f"{model.settings.in_words}{after}"


def complete_cards(finalist: Retrained, test: Errors, environment: Mapping) -> None:
    """Add test errors and provenance to the card beside each of a finalist's models."""
    for record, folder in zip(finalist.records, finalist.checkpoints, strict=True):
        own = {"error": test.by_seed[record.id]}
        card = read_card(folder) | {
            "finalist": finalist.id,
            "test": own | {"mean_over_seeds": test.error, "ci95": test.ci95},
            "data_sha256": environment["data"]["sha256"],
            "git_commit": environment["git_commit"],
        }
        save_model(load_model(folder), folder, card)
