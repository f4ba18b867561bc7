"""Study files: what to learn, from which data, how to search. TOML, validated."""

import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator, model_validator

from cconv.errors import ConfigError
from cconv.sph.kernels import KERNELS
from cconv.study.asha import rungs_up_to
from cconv.study.stages import Stage, check_order, default_stages
from cconv.training.field_model import NetworkConfig
from cconv.validation import StrictModel, validated


class DataConfig(StrictModel):
    """Particle data and targets. Lengths and times in the units of the data; None takes what the data say."""

    path: str | None = None
    particle_spacing: float | None = Field(None, gt=0)
    mass: float | None = Field(None, gt=0)
    frame_dt: float | None = Field(None, gt=0)
    force: tuple[float, ...] | None = None
    kernel: str = "cubic_spline"
    smoothing_length: float | None = Field(None, gt=0)
    split_fractions: tuple[float, float, float] = (0.7, 0.15, 0.15)
    gap: int = Field(2, ge=0)

    @field_validator("kernel")
    @classmethod
    def _known_kernel(cls, name: str) -> str:
        if name not in KERNELS:
            raise ValueError(f"must be one of {', '.join(KERNELS)}")
        return name


class TrainingConfig(StrictModel):
    """Budget and optimiser of one training. Budgets count gradient updates; trials at once share the cache."""

    updates: int = Field(600, ge=1)
    evaluate_every: int = Field(50, ge=1)
    batch_size: int = Field(1, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    schedule: Literal["constant", "cosine", "exponential"] = "cosine"
    cache_megabytes: int = Field(2048, ge=0)


class SearchConfig(StrictModel):
    """What random and adaptive searches share: the space, ASHA's rungs, limits of a trial.

    A trial whose validation error exceeds `give_up_above` at an evaluation is stopped. One that has trained for
    `trial_seconds` is stopped at its next update, and its process ended if it hangs. `concurrency` None means as many
    trials at once as cores.
    """

    space: str
    grace_updates: int = Field(50, ge=1)
    reduction_factor: int = Field(3, ge=2)
    give_up_above: float = Field(10.0, gt=0)
    trial_seconds: float = Field(3600.0, gt=0)
    concurrency: int | None = Field(None, ge=1)


class FinalistsConfig(StrictModel):
    """Protocol of every retraining and test. `updates` None means the search's budget."""

    seeds: int = Field(5, ge=2)
    updates: int | None = Field(None, ge=1)
    frames_per_block: int = Field(3, ge=1)


class SelectionConfig(StrictModel):
    """When accurate is accurate enough.

    Models below `accurate_enough` count as equal, and the cheapest wins; `margin` is how much worse than the best a
    model may be, as a share of the best error, to count as not inferior.
    """

    accurate_enough: float | None = Field(None, gt=0)
    margin: float = Field(0.05, gt=0)


class CostConfig(StrictModel):
    """Isolated timing of the finalists; of `trials` further models for the check of the cost model; growth with N."""

    threads: int = Field(1, ge=1)
    repeats: int = Field(20, ge=3)
    trials: int = Field(6, ge=0)
    sizes: tuple[int, ...] = (1000, 3000, 10_000, 30_000, 100_000)


class SeedsConfig(StrictModel):
    """Three seeds, never one: split and batch order, initial weights, sampling of configurations."""

    data: int = Field(0, ge=0)
    init: int = Field(0, ge=0)
    search: int = Field(0, ge=0)


class StudyConfig(StrictModel):
    """A whole study."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    task: Literal["density_rate", "density_gradient"]
    data: DataConfig = DataConfig()
    network: NetworkConfig = NetworkConfig()
    training: TrainingConfig = TrainingConfig()
    search: SearchConfig
    finalists: FinalistsConfig = FinalistsConfig()
    cost: CostConfig = CostConfig()
    selection: SelectionConfig = SelectionConfig()
    seeds: SeedsConfig = SeedsConfig()
    stages: dict[str, Stage] = Field(default_factory=default_stages, min_length=1)

    @field_validator("stages", mode="before")
    @classmethod
    def _kinds_from_names(cls, stages: object) -> object:
        if not isinstance(stages, Mapping):
            return stages
        return {name: {"kind": name} | stage if isinstance(stage, dict) else stage for name, stage in stages.items()}

    @field_validator("stages")
    @classmethod
    def _stages_read_earlier_ones(cls, stages: dict[str, Stage]) -> dict[str, Stage]:
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

    @property
    def rungs(self) -> list[int]:
        """Updates of ASHA's rungs, the full budget last."""
        return rungs_up_to(self.training.updates, self.search.grace_updates, self.search.reduction_factor)

    @property
    def concurrency(self) -> int:
        """Trials at once: as many as cores, unless set."""
        return self.search.concurrency or os.cpu_count() or 1


def read_toml(path: Path | str) -> dict:
    """Content of a TOML file.

    Raises:
        ConfigError: If the file is missing or is not TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text())
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file; give the path of a TOML file.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, IsADirectoryError) as error:
        raise ConfigError(f"{path}: not a TOML file ({error}); mend that line.") from error


def load_study(path: Path | str, overrides: Sequence[str] = ()) -> StudyConfig:
    """Study from a TOML file; its search space is looked for beside the file, then in the working folder.

    Args:
        path: The study file.
        overrides: Settings that replace the file's, as ``"training.updates=100"``; values in TOML or plain text.

    Raises:
        ConfigError: If the file cannot be read or a key or value does not fit.
    """
    path = Path(path)
    values = read_toml(path)
    for override in overrides:
        _apply(values, override)
    study = validated(StudyConfig, values, path)
    space = path.parent / study.search.space
    if space.is_file():
        study = study.model_copy(update={"search": study.search.model_copy(update={"space": str(space)})})
    return study


def _apply(values: dict, override: str) -> None:
    name, equals, text = override.partition("=")
    if not equals:
        raise ConfigError(f"--set {override}: must read key=value, e.g. training.updates=100.")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *tables, key = name.strip().split(".")
    for table in tables:
        values = values.setdefault(table, {})
        if not isinstance(values, dict):
            raise ConfigError(f"--set {override}: `{table}` is not a table; see the study file for its keys.")
    values[key] = value
