"""What a trial can vary: features that the network is given, settings of the network and of its training."""

from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, ValidationError, field_validator, model_validator

from cconv.errors import ConfigError, did_you_mean, shown
from cconv.networks import ARCHITECTURES, ConvNetSettings
from cconv.networks.network import NetworkSettings
from cconv.sph.kernels import KERNELS
from cconv.tasks import TASKS
from cconv.tasks.features import CONSTANT
from cconv.validation import Length, Real, StrictModel, Value, Whole

MOST_UPDATES = 10**9
TRAINING_HYPERPARAMETERS = ("batch_size", "learning_rate", "schedule")
OPTIONAL_FEATURES = tuple(dict.fromkeys(name for task in TASKS.values() for name in task.optional))
NETWORK_HYPERPARAMETERS = tuple(
    dict.fromkeys(name for settings in ARCHITECTURES.values() for name in settings.model_fields)
)
HYPERPARAMETERS = (*NETWORK_HYPERPARAMETERS, *OPTIONAL_FEATURES, *TRAINING_HYPERPARAMETERS)

Updates = Annotated[Whole, Field(ge=1, le=MOST_UPDATES)]


class TaskConfig(StrictModel):
    """What is asked of a network: the task, its SPH kernel, and the features that networks are given.

    `smoothing_length` is the kernel's h in the units of the data; None takes the particle spacing. `features` None
    takes all features of the task.
    """

    name: Literal[tuple(TASKS)]
    kernel: str = "cubic_spline"
    smoothing_length: Length | None = None
    features: tuple[str, ...] | None = Field(None, max_length=100)

    @field_validator("kernel")
    @classmethod
    def _known_kernel(cls, name: str) -> str:
        if name not in KERNELS:
            raise ValueError(f"must be one of {', '.join(KERNELS)}")
        return name

    @model_validator(mode="after")
    def _features_are_of_the_task(self) -> "TaskConfig":
        if self.features is not None:
            TASKS[self.name].check_features({CONSTANT, *self.features})
        return self

    @property
    def taken(self) -> tuple[str, ...]:
        """Features that networks are given."""
        known = TASKS[self.name].features
        return known if self.features is None else tuple(name for name in known if name in (CONSTANT, *self.features))


class TrainingConfig(StrictModel):
    """Budget and optimiser of one training. Budgets count gradient updates; trials at once share the cache."""

    updates: Updates = 600
    evaluate_every: Updates = 50
    batch_size: Whole = Field(1, ge=1, le=10**6)
    learning_rate: Real = Field(1e-3, ge=1e-12, le=1e3)
    schedule: Literal["constant", "cosine", "exponential"] = "cosine"
    cache_megabytes: Whole = Field(2048, ge=0, le=2**20)


class Configuration(NamedTuple):
    """Everything that a trial can vary.

    Attributes:
        features: Names of the features that the network is given.
        network: Network settings.
        training: Training settings.
    """

    features: tuple[str, ...]
    network: NetworkSettings
    training: TrainingConfig


DEFAULTS = Configuration(TASKS["density_rate"].features, ConvNetSettings(), TrainingConfig())


def check_known(parameters: Mapping[str, Value]) -> None:
    """Raise `ConfigError` unless all names are those of hyperparameters."""
    for name in parameters:
        if name not in HYPERPARAMETERS:
            raise ConfigError(
                f"unknown hyperparameter {shown(name)}.{did_you_mean(name, HYPERPARAMETERS)} "
                f"Known: {', '.join(HYPERPARAMETERS)}."
            )


def configure(parameters: Mapping[str, Value], defaults: Configuration) -> Configuration:
    """The drawn hyperparameters in place of the study's own.

    An optional feature is named with whether it is taken. Where another architecture than the study's is drawn, the
    study's settings that it does not have fall away.

    Raises:
        ConfigError: If they are not possible together.
    """
    _check_named(parameters)
    features = set(defaults.features) | {name for name in OPTIONAL_FEATURES if parameters.get(name)}
    features -= {name for name in OPTIONAL_FEATURES if parameters.get(name) is False}
    architecture = parameters.get("architecture", defaults.network.architecture)
    drawn = {name: value for name, value in parameters.items() if name not in OPTIONAL_FEATURES}
    of_training = {name: drawn.pop(name) for name in TRAINING_HYPERPARAMETERS if name in drawn}
    try:
        settings = ARCHITECTURES[architecture]
        kept = {name: value for name, value in defaults.network.model_dump().items() if name in settings.model_fields}
        return Configuration(
            tuple(name for name in dict.fromkeys((*defaults.features, *OPTIONAL_FEATURES)) if name in features),
            settings.model_validate(kept | drawn),
            TrainingConfig.model_validate(defaults.training.model_dump() | of_training),
        )
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"])) or "together"
        if problem["type"] == "extra_forbidden":
            raise ConfigError(f"not possible ({where}: is no setting of {architecture})") from error
        raise ConfigError(f"not possible ({where}: {problem['msg'].removeprefix('Value error, ')})") from error


def _check_named(parameters: Mapping[str, Value]) -> None:
    """Check what names an architecture or a feature."""
    architecture = parameters.get("architecture")
    if architecture is not None and architecture not in ARCHITECTURES:
        raise ConfigError(f"not possible (architecture: must be one of {', '.join(ARCHITECTURES)})")
    for name in OPTIONAL_FEATURES:
        if not isinstance(parameters.get(name, True), bool):
            raise ConfigError(f"not possible ({name}: must be true or false)")
