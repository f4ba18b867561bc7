"""Study files: what to learn, from which data, how to search. TOML, validated."""

import os
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from cconv.errors import ConfigError
from cconv.models.relaxation import Relaxation
from cconv.networks import ConvNetSettings, NetworkTable
from cconv.networks.network import NetworkSettings
from cconv.study.declared.configuration import (
    EXTERNAL_FORCE,
    HISTORY,
    WITH_PREDICTOR,
    Configuration,
    Noise,
    SquaredLoss,
    TaskConfig,
    TrainingConfig,
    Updates,
    check_asked,
    check_least_squares,
    configure,
)
from cconv.study.declared.paths import paths_of_tables
from cconv.study.declared.stage import Ridge, Stage, check_names, check_order, included
from cconv.tasks import TASKS
from cconv.tasks.task import StepTask
from cconv.validation import Length, Name, PathText, Real, Seed, StrictModel, Value, Whole

_Component = Annotated[Real, Field(ge=-1e12, le=1e12)]
_Size = Annotated[Whole, Field(ge=10, le=10**6)]  # particles
Logger = Literal["mlflow", "wandb"]
_Share = Annotated[Real, Field(ge=1e-6, le=1e6)]


def rungs_up_to(full_updates: int, grace_updates: int, reduction_factor: int) -> list[int]:
    """Updates of the rungs: ``grace_updates · reduction_factor^k`` below the full budget, then the full budget."""
    rungs = []
    while grace_updates < full_updates:
        rungs.append(grace_updates)
        grace_updates *= reduction_factor
    return [*rungs, full_updates]


class DataConfig(StrictModel):
    """Particle data. Lengths and times in the units of the data; None takes what the data say."""

    path: PathText | None = None
    particle_spacing: Length | None = None
    mass: Length | None = None
    frame_dt: Length | None = None
    force: tuple[_Component, ...] | None = Field(None, min_length=1, max_length=3)
    split_fractions: tuple[_Share, _Share, _Share] = (0.7, 0.15, 0.15)
    gap: Whole = Field(2, ge=0, le=10**6)


class SearchConfig(StrictModel):
    """What random and adaptive searches share: the space, ASHA's rungs, limits of a trial.

    `baseline` gives hyperparameters of the baseline other values than the space does.
    A trial whose validation error exceeds `give_up_above` at an evaluation is stopped. One that has trained for
    `trial_seconds` is stopped at its next update, and its process ended if it hangs. `concurrency` None means as many
    trials at once as cores. `gpu_share` is the part of a GPU that each takes where they train on GPUs; None divides all
    GPUs among the trials at once.
    """

    space: PathText
    baseline: dict[str, Value] = Field({}, max_length=100)
    grace_updates: Updates = 50
    reduction_factor: Whole = Field(3, ge=2, le=1000)
    give_up_above: Real = Field(10.0, ge=1e-12, le=1e9)
    trial_seconds: Real = Field(3600.0, ge=1e-3, le=1e7)
    concurrency: Whole | None = Field(None, ge=1, le=4096)
    gpu_share: Real | None = Field(None, ge=1e-3, le=64)

    @field_validator("baseline", mode="before")
    @classmethod
    def _hyperparameters_by_path(cls, baseline: object) -> object:
        return paths_of_tables(baseline)


class PredictorConfig(StrictModel):
    """A single layer that steps first, and whose step the networks correct; least squares fits it before anything else.

    It takes the features and the history of the study's task. `noise` and `loss` are as of a training.
    """

    network: NetworkTable
    noise: Noise = 1e-2
    loss: SquaredLoss = "balanced_mse"
    ridge: Ridge = 1e-10

    @field_validator("network")
    @classmethod
    def _is_a_single_layer(cls, network: NetworkSettings) -> NetworkSettings:
        if not network.linear_with or network.linear_with.items() - network.model_dump().items():
            raise ValueError("must have `layers = 1`, so that least squares can fit it")
        return network


class RolloutConfig(StrictModel):
    """What rollouts of steps apply after every frame, those within a training and those that models are compared by."""

    relaxation: Relaxation | None = None


class FinalistsConfig(StrictModel):
    """Protocol of every retraining and test. `updates` None means the search's budget.

    With one seed nothing is known of how far trainings differ, and trained models have no intervals.
    """

    seeds: Whole = Field(5, ge=1, le=1000)
    updates: Updates | None = None
    frames_per_block: Whole = Field(3, ge=1, le=10**6)


class SelectionConfig(StrictModel):
    """When accurate is accurate enough.

    Models below `accurate_enough` count as equal, and the cheapest wins; `margin` is how much worse than the best a
    model may be, as a share of the best error, to count as not inferior.
    """

    accurate_enough: Real | None = Field(None, ge=1e-15, le=1e6)
    margin: Real = Field(0.05, ge=1e-9, le=100)


class CostConfig(StrictModel):
    """Isolated timing of the finalists; of `trials` further models for the check of the cost model; growth with N."""

    threads: Whole = Field(1, ge=1, le=1024)
    repeats: Whole = Field(20, ge=3, le=10_000)
    trials: Whole = Field(6, ge=0, le=10_000)
    sizes: tuple[_Size, ...] = Field((1000, 3000, 10_000, 30_000, 100_000), min_length=1, max_length=20)

    @field_validator("sizes")
    @classmethod
    def _ascending(cls, sizes: tuple[int, ...]) -> tuple[int, ...]:
        if not all(low < high for low, high in pairwise(sizes)):
            raise ValueError("sizes must ascend, each one once")
        return sizes


class SeedsConfig(StrictModel):
    """Three seeds, never one: split and batch order, initial weights, sampling of configurations."""

    data: Seed = 0
    init: Seed = 0
    search: Seed = 0


class StudyConfig(StrictModel):
    """A whole study, whatever kinds of stages there are: `studies` makes the form of a study file from their list.

    Attributes:
        kinds: All kinds of stages that a study file can ask for.
        log: Programs that evaluations of trainings are logged for, besides TensorBoard.
    """

    kinds: ClassVar[tuple[str, ...]] = ()
    name: Name
    task: TaskConfig
    data: DataConfig = DataConfig()
    network: NetworkTable = ConvNetSettings()
    predictor: PredictorConfig | None = None
    training: TrainingConfig = TrainingConfig()
    rollout: RolloutConfig = RolloutConfig()
    search: SearchConfig
    finalists: FinalistsConfig = FinalistsConfig()
    cost: CostConfig = CostConfig()
    selection: SelectionConfig = SelectionConfig()
    seeds: SeedsConfig = SeedsConfig()
    log: tuple[Logger, ...] = ()
    stages: dict[Name, Stage]

    @field_validator("log", mode="before")
    @classmethod
    def _logger_by_its_name(cls, log: object) -> object:
        return (log,) if isinstance(log, str) else log

    @field_validator("task", mode="before")
    @classmethod
    def _task_by_its_name(cls, task: object) -> object:
        return task_table(task)

    @field_validator("network", mode="before")
    @classmethod
    def _published_architecture(cls, network: object) -> object:
        return {"architecture": "conv_net"} | network if isinstance(network, dict) else network

    @field_validator("stages", mode="before")
    @classmethod
    def _kinds_from_names(cls, stages: object) -> object:
        if not isinstance(stages, Mapping):
            return stages
        return {name: {"kind": name} | stage if isinstance(stage, dict) else stage for name, stage in stages.items()}

    @field_validator("stages")
    @classmethod
    def _stages_read_earlier_ones(cls, stages: dict[str, Stage]) -> dict[str, Stage]:
        check_names(stages, cls.kinds)
        check_order(stages)
        return stages

    @model_validator(mode="after")
    def _budgets_fit(self) -> "StudyConfig":
        search, training = self.search, self.training
        if search.grace_updates > training.updates:
            raise ValueError(
                f"search.grace_updates ({search.grace_updates}) must not exceed training.updates ({training.updates}), "
                "or no rung would be reached"
            )
        if search.grace_updates % training.evaluate_every:
            raise ValueError(
                f"search.grace_updates ({search.grace_updates}) must be a multiple of "
                f"training.evaluate_every ({training.evaluate_every}), or no rung would be evaluated"
            )
        return self

    @model_validator(mode="after")
    def _configuration_fits_the_task(self) -> "StudyConfig":
        check_asked(self.configuration, self.task.name)
        if self.predictor is not None and not issubclass(TASKS[self.task.name], StepTask):
            raise ValueError(f"`predictor` is for steps, and {self.task.name!r} is a field of one frame; remove it")
        return self

    @model_validator(mode="after")
    def _stages_fit_the_task(self) -> "StudyConfig":
        for name, stage in self.stages.items():
            if stage.only_for_steps and not issubclass(TASKS[self.task.name], StepTask):
                raise ValueError(f"stage `{name}` is for steps, and {self.task.name!r} is a field; remove it")
        return self

    @model_validator(mode="after")
    def _included_are_possible(self) -> "StudyConfig":
        for finalist, parameters in included(self.stages):
            try:
                self.configured(parameters)
            except ConfigError as error:
                raise ValueError(f"finalist `{finalist}`: {error}") from error
        return self

    def check_stages(self) -> None:
        """Check that the stages can run with this training; a file for a single training need not ask that.

        Raises:
            ConfigError: With the stage and the setting.
        """
        for name, stage in self.stages.items():
            if stage.fits_squares:
                check_least_squares(self.training.loss, f"stage `{name}`")
            if stage.counts_updates and self.training.cpu_seconds is not None:
                raise ConfigError(
                    f"stage `{name}` compares trainings after equal numbers of updates, and `training.cpu_seconds` "
                    "ends them after equal time; remove one of them, or name other stages."
                )

    @property
    def configuration(self) -> Configuration:
        """What trials have where no hyperparameter is drawn."""
        task = self.task
        return Configuration(
            features=task.taken,
            history=task.usual_history,
            network=self.network,
            training=self.training,
            external_force=task.external_force,
            with_predictor=self.predictor is not None,
            relaxation=self.rollout.relaxation,
        )

    def configured(self, parameters: Mapping[str, Value]) -> Configuration:
        """What a trial has for which these hyperparameters are drawn.

        Raises:
            ConfigError: If they are not possible together, or not for the task.
        """
        configuration = configure(parameters, self.configuration)
        check_asked(configuration, self.task.name)
        self._check_predictor(configuration)
        return configuration

    def _check_predictor(self, configuration: Configuration) -> None:
        """Check that there is a predictor where one is to be corrected, and that it does not look back farther."""
        if not configuration.with_predictor:
            return
        if self.predictor is None:
            raise ConfigError(f"not possible ({WITH_PREDICTOR}: needs a table [predictor] in the study file)")
        if configuration.history < self.task.usual_history:
            raise ConfigError(
                f"not possible ({HISTORY}: must be at least {self.task.usual_history}, that of the predictor, got "
                f"{configuration.history})"
            )
        if configuration.external_force != self.task.external_force:
            raise ConfigError(f"not possible ({EXTERNAL_FORCE}: must be that of the predictor)")

    @property
    def rungs(self) -> list[int]:
        """Updates of ASHA's rungs, the full budget last."""
        return rungs_up_to(self.training.updates, self.search.grace_updates, self.search.reduction_factor)

    @property
    def concurrency(self) -> int:
        """Trials at once: as many as cores, unless set."""
        return self.search.concurrency or os.cpu_count() or 1


def task_table(task: object) -> object:
    """The table of a task of which a study file gives the name alone."""
    return {"name": task} if isinstance(task, str) else task
