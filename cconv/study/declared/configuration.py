"""What a trial can vary: features that the network is given, settings of the network and of its training."""

from collections.abc import Mapping
from typing import Annotated, Literal, NamedTuple, TypeVar, get_args

from pydantic import Field, ValidationError, field_validator, model_validator

from cconv.devices import AUTO, FLOAT32, WISH, Precision
from cconv.errors import ConfigError, did_you_mean, shown
from cconv.models.relaxation import Relaxation
from cconv.networks import ARCHITECTURES, ConvNetSettings
from cconv.networks.network import NetworkSettings
from cconv.sph.kernels import KERNELS
from cconv.study.declared.paths import below
from cconv.tasks import TASKS
from cconv.tasks.features import CONSTANT
from cconv.tasks.task import StepTask
from cconv.validation import Flag, Horizon, Length, OneOf, Real, StrictModel, Value, Whole

MOST_UPDATES = 10**9
MOST_UNROLLED = 10  # steps that an update differentiates through, whose states are all kept in memory
MOST_PUSHED = 20  # steps of a model's own rollout before the one that it learns from
STILL = {"noise": 0.0, "pushforward": 0, "unroll": 1}  # settings of a training, with which no particle is moved
NETWORK, TRAINING, FEATURES = "network", "training", "task.features"  # tables that hold hyperparameters
HISTORY, WITH_PREDICTOR = "task.history", "task.with_predictor"
EXTERNAL_FORCE, RELAXATION = "task.external_force", "rollout.relaxation"
BY_NETWORK, BY_INTEGRATOR = "network", "integrator"  # who knows of the external force
ARCHITECTURE = f"{NETWORK}.architecture"
OPTIONAL_FEATURES = tuple(dict.fromkeys(name for task in TASKS.values() for name in task.optional))
_OF_NETWORKS = dict.fromkeys(name for settings in ARCHITECTURES.values() for name in settings.model_fields)
HYPERPARAMETERS = (
    *(f"{NETWORK}.{name}" for name in _OF_NETWORKS),
    HISTORY,
    WITH_PREDICTOR,
    EXTERNAL_FORCE,
    *(f"{FEATURES}.{name}" for name in OPTIONAL_FEATURES),
    *(f"{TRAINING}.{name}" for name in ("batch_size", "learning_rate", "schedule", "loss", "average")),
    *(f"{TRAINING}.{name}" for name in ("noise", "pushforward", "unroll", "precision")),
    *(f"{RELAXATION}.{name}" for name in Relaxation.model_fields),
)

Settings = TypeVar("Settings", bound=StrictModel)
Updates = Annotated[Whole, Field(ge=1, le=MOST_UPDATES)]
Noise = Annotated[Real, Field(ge=0, le=1)]  # standard deviation of the last velocity's, particle spacings per frame
Device = Annotated[str, Field(pattern=rf"^({WISH.pattern})$")]
SquaredLoss = Literal["mse", "balanced_mse"]
Loss = Literal["mse", "balanced_mse", "neighbor_weighted"]


class TaskConfig(StrictModel):
    """What is asked of a network: the task, its SPH kernel, and the features that networks are given.

    `smoothing_length` is the kernel's h in the units of the data; None takes the particle spacing. `features` None
    takes all features of the task but those that are on request. A step task also has `history`, the frames that an
    answer depends on, and `horizon`, the frames of the rollouts that models are compared by; None takes 6 and 20, as
    LagrangeBench.
    `external_force` says whether the network learns it, or the integrator adds it and the network learns the rest.
    """

    name: Annotated[str, OneOf(tuple(TASKS))]
    kernel: str = "cubic_spline"
    smoothing_length: Length | None = None
    features: tuple[str, ...] | None = Field(None, max_length=100)
    history: Whole | None = None
    horizon: Horizon | None = None
    external_force: Literal["network", "integrator"] = "network"

    @field_validator("kernel")
    @classmethod
    def _known_kernel(cls, name: str) -> str:
        if name not in KERNELS:
            raise ValueError(f"must be one of {', '.join(KERNELS)}")
        return name

    @field_validator("features", mode="before")
    @classmethod
    def _features_are_listed(cls, features: object) -> object:
        if isinstance(features, Mapping):
            raise ValueError('must list the features that are taken, e.g. ["velocity", "density"]')
        return features

    @model_validator(mode="after")
    def _features_are_of_the_task(self) -> "TaskConfig":
        if self.features is not None:
            TASKS[self.name].check_features({CONSTANT, *self.features})
        return self

    @model_validator(mode="after")
    def _frames_are_of_a_step(self) -> "TaskConfig":
        if self.history is not None:
            TASKS[self.name].check_history(self.history)
        if self.horizon is not None and not issubclass(TASKS[self.name], StepTask):
            raise ValueError(f"`horizon` is for steps, and {self.name!r} is a field of one frame; remove it")
        return self

    @property
    def taken(self) -> tuple[str, ...]:
        """Features that networks are given."""
        task = TASKS[self.name]
        wanted = {*task.features} - {*task.on_request} if self.features is None else {CONSTANT, *self.features}
        return tuple(name for name in task.features if name in wanted)

    @property
    def usual_history(self) -> int:
        """Frames that an answer depends on where no hyperparameter says otherwise."""
        return TASKS[self.name].history if self.history is None else self.history


class TrainingConfig(StrictModel):
    """Budget and optimiser of one training; trials at once share the cache.

    The budget is `updates`, and with `cpu_seconds` also so much CPU time of the training's process in updates,
    evaluations not counted: whichever is spent first. With it networks of different cost are compared at equal time,
    and wall time would tell more of the other programs on the machine than of the network. Shares are of that budget.
    `loss` says how much each frame counts, or with "neighbor_weighted" each particle. `noise`, for step tasks, is the
    standard deviation of the random walk that is added to the velocities of a window, in particle spacings per frame.
    `pushforward` is the largest number of steps that the model's own rollout goes on before the step that it learns
    from, once a share `pushforward_from` of the budget is spent. `unroll` is the number of steps of that rollout that
    it then learns from at once, with gradients through all of them, once a share `unroll_from` of it is spent.
    `average` is the decay of a moving average of the weights, which is evaluated and kept in their place; 0 keeps the
    weights themselves.

    `device` is where models are trained, compared and timed; "auto" takes the first NVIDIA GPU, or else the CPU.
    `precision` is that of the products of matrices in the network. `deterministic` gives the same bits every time on a
    GPU too.
    """

    updates: Updates = 600
    cpu_seconds: Real | None = Field(None, ge=1e-3, le=1e8)
    evaluate_every: Updates = 50
    batch_size: Whole = Field(1, ge=1, le=10**6)
    learning_rate: Real = Field(1e-3, ge=1e-12, le=1e3)
    schedule: Literal["constant", "cosine", "exponential"] = "cosine"
    loss: Loss = "mse"
    noise: Noise = 0.0
    pushforward: Whole = Field(0, ge=0, le=MOST_PUSHED)
    pushforward_from: Real = Field(0.5, ge=0, le=1)
    unroll: Whole = Field(1, ge=1, le=MOST_UNROLLED)
    unroll_from: Real = Field(0.5, ge=0, le=1)
    average: Real = Field(0.0, ge=0, lt=1)
    cache_megabytes: Whole = Field(2048, ge=0, le=2**20)
    device: Device = AUTO
    precision: Precision = FLOAT32
    deterministic: Flag = False

    @property
    def budget(self) -> str:
        """The budget in words."""
        if self.cpu_seconds is None:
            return f"{self.updates} updates"
        return f"{self.cpu_seconds:g} s of CPU time or {self.updates} updates"

    def is_spent(self, entry: Mapping) -> bool:
        """Tell whether the budget is spent at an evaluation, by its record."""
        in_time = self.cpu_seconds is None or entry.get("cpu_seconds", 0.0) < self.cpu_seconds
        return entry["updates"] >= self.updates or not in_time

    @property
    def moving(self) -> dict[str, float]:
        """Settings by name that move particles, so that no geometry serves twice; only steps have them."""
        return {name: getattr(self, name) for name, still in STILL.items() if getattr(self, name) != still}


class Configuration(NamedTuple):
    """Everything that a trial can vary.

    Attributes:
        features: Names of the features that the network is given.
        history: Frames that an answer depends on, the present one among them.
        network: Network settings.
        training: Training settings.
        external_force: "network" if the network learns it, "integrator" if the integrator of a step adds it.
        with_predictor: Whether the network corrects the step of the study's predictor, if it has one.
        relaxation: SPH relaxation after every step of rollouts, those of the training included; None without.
    """

    features: tuple[str, ...]
    history: int
    network: NetworkSettings
    training: TrainingConfig
    external_force: str = BY_NETWORK
    with_predictor: bool = False
    relaxation: Relaxation | None = None


DEFAULTS = Configuration(TASKS["density_rate"].features, 1, ConvNetSettings(), TrainingConfig())


def known_hyperparameters(name: str) -> str:
    """The hyperparameter that an unknown name may stand for, and all that there are, for a message."""
    nearest = [path for path in HYPERPARAMETERS if path.rpartition(".")[2] == name]
    meant = f" Did you mean {nearest[0]!r}?" if nearest else did_you_mean(name, HYPERPARAMETERS)
    return f"{meant} Known: {', '.join(HYPERPARAMETERS)}."


def feature_path(name: str) -> str:
    """Path of the hyperparameter that says whether networks are given an optional feature."""
    return f"{FEATURES}.{name}"


def configure(parameters: Mapping[str, Value], defaults: Configuration) -> Configuration:
    """The drawn hyperparameters in place of the study's own.

    Hyperparameters are paths into the study file; an optional feature is named with whether it is taken. Where another
    architecture than the study's is drawn, the study's settings that it does not have fall away.

    Raises:
        ConfigError: If a name is not that of a hyperparameter, or they are not possible together.
    """
    _check_known(parameters)
    architecture = _architecture(parameters, defaults)
    _check_features(parameters)
    taken, drawn = below(FEATURES, parameters), below(NETWORK, parameters)
    features = dict.fromkeys((*defaults.features, *(name for name in OPTIONAL_FEATURES if taken.get(name))))
    settings = ARCHITECTURES[architecture]
    kept = {name: value for name, value in defaults.network.model_dump().items() if name in settings.model_fields}
    return Configuration(
        tuple(name for name in features if taken.get(name, True)),
        _history(parameters, defaults),
        _possible(settings, NETWORK, kept | drawn),
        _possible(TrainingConfig, TRAINING, defaults.training.model_dump() | below(TRAINING, parameters)),
        _external_force(parameters, defaults),
        _with_predictor(parameters, defaults),
        _relaxation(parameters, defaults),
    )


def check_asked(configuration: Configuration, task: str) -> None:
    """Check that a configuration has features and a history of the task, and changes windows only where there are some.

    Raises:
        ConfigError: With the setting.
    """
    foreign = [name for name in configuration.features if name not in TASKS[task].features]
    if foreign:
        raise ConfigError(f"not possible ({feature_path(foreign[0])}: is no feature of the task {task!r})")
    try:
        TASKS[task].check_history(configuration.history)
    except ConfigError as error:
        raise ConfigError(f"not possible ({HISTORY}: {error})") from error
    if not issubclass(TASKS[task], StepTask):
        _check_still(configuration, task)


def _check_still(configuration: Configuration, field: str) -> None:
    """Check that a configuration for a field has nothing that only steps have."""
    of_steps = {
        EXTERNAL_FORCE: configuration.external_force == BY_INTEGRATOR,
        RELAXATION: configuration.relaxation is not None,
    }
    for name, is_asked in of_steps.items():
        if is_asked:
            raise ConfigError(f"not possible ({name}: is for steps, and {field!r} is a field of one frame)")
    for name, value in configuration.training.moving.items():
        allowed = f"must be {STILL[name]:g} for the field {field!r}"
        raise ConfigError(f"not possible ({TRAINING}.{name}: {allowed}, got {value:g})")


def check_least_squares(loss: str, of: str) -> None:
    """Check that a loss is one that least squares minimises.

    Args:
        loss: Name of the loss.
        of: What is to be fitted, for the message.

    Raises:
        ConfigError: If it is another.
    """
    squared = get_args(SquaredLoss)
    if loss not in squared:
        names = " or ".join(map(repr, squared))
        raise ConfigError(f"`{TRAINING}.loss` must be {names} for {of}, which least squares fits; got {loss!r}")


def _possible(form: type[Settings], table: str, values: Mapping[str, Value]) -> Settings:
    """Settings of a table of the study file from plain values."""
    try:
        return form.model_validate(values)
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, (table, *problem["loc"])))
        if problem["type"] == "extra_forbidden":
            raise ConfigError(
                f"not possible ({where}: is no setting of {values.get('architecture', table)})"
            ) from error
        raise ConfigError(f"not possible ({where}: {problem['msg'].removeprefix('Value error, ')})") from error


def _check_known(parameters: Mapping[str, Value]) -> None:
    """Check that all names are paths of hyperparameters."""
    for name in parameters:
        if name not in HYPERPARAMETERS:
            raise ConfigError(f"unknown hyperparameter {shown(name)}.{known_hyperparameters(name)}")


def _architecture(parameters: Mapping[str, Value], defaults: Configuration) -> str:
    """The architecture that is drawn, or the study's own."""
    architecture = parameters.get(ARCHITECTURE, defaults.network.architecture)
    if not isinstance(architecture, str) or architecture not in ARCHITECTURES:
        raise ConfigError(f"not possible ({ARCHITECTURE}: must be one of {', '.join(ARCHITECTURES)})")
    return architecture


def _history(parameters: Mapping[str, Value], defaults: Configuration) -> int:
    """The history that is drawn, or the study's own."""
    history = parameters.get(HISTORY, defaults.history)
    if not isinstance(history, int) or isinstance(history, bool):
        raise ConfigError(f"not possible ({HISTORY}: must be a whole number, got {shown(history)})")
    return history


def _external_force(parameters: Mapping[str, Value], defaults: Configuration) -> str:
    """Who knows of the external force: what is drawn, or the study's own."""
    known = parameters.get(EXTERNAL_FORCE, defaults.external_force)
    if known not in (BY_NETWORK, BY_INTEGRATOR):
        raise ConfigError(f"not possible ({EXTERNAL_FORCE}: must be {BY_NETWORK!r} or {BY_INTEGRATOR!r})")
    return str(known)


def _with_predictor(parameters: Mapping[str, Value], defaults: Configuration) -> bool:
    """Whether the predictor steps first, as drawn or as in the study."""
    with_predictor = parameters.get(WITH_PREDICTOR, defaults.with_predictor)
    if not isinstance(with_predictor, bool):
        raise ConfigError(f"not possible ({WITH_PREDICTOR}: must be true or false, got {shown(with_predictor)})")
    return with_predictor


def _relaxation(parameters: Mapping[str, Value], defaults: Configuration) -> Relaxation | None:
    """The relaxation as drawn or as in the study; one of size 0, or without a size, is none."""
    drawn = below(RELAXATION, parameters)
    if not drawn:
        return defaults.relaxation
    known = {"alpha": 0.0} if defaults.relaxation is None else defaults.relaxation.model_dump()
    relaxation = _possible(Relaxation, RELAXATION, known | drawn)
    return relaxation if relaxation.alpha > 0 else None


def _check_features(parameters: Mapping[str, Value]) -> None:
    """Check that each feature is said to be taken or not by true or false."""
    for path in map(feature_path, OPTIONAL_FEATURES):
        if not isinstance(parameters.get(path, True), bool):
            raise ConfigError(f"not possible ({path}: must be true or false)")
