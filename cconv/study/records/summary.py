"""The summary of a finished study, as typed values: what the selection found, and the parts of the other stages.

Errors are those of the objective that the task names, and times are those of one frame. ``ci95`` is a 95 % interval,
None where there is too little for one.
"""

from pydantic import Field, model_validator

from cconv.study.records.forms import Count, NonNegative
from cconv.study.records.found import Interval, Parts
from cconv.validation import Flag, Id, Name, PathText, Real, StrictModel, Value


class TaskFacts(StrictModel):
    """The task of a study, for readers.

    Attributes:
        name: Name of the task.
        symbol: Symbol of what networks predict.
        meaning: What networks predict, in words.
        error: What errors are called.
        error_meaning: What that is, in words.
        measures: What else is measured, by name: what it is, in words.
    """

    name: Name
    symbol: str
    meaning: str
    error: str
    error_meaning: str
    measures: dict[str, str]


class DatasetFacts(StrictModel):
    """The data: their folder, their scene, and the number of frames of each split."""

    path: PathText
    scene: str
    frames: dict[str, Count]


class MeanPredictor(StrictModel):
    """Error of predicting the training mean, by split."""

    valid: NonNegative
    test: NonNegative


class Units(StrictModel):
    """Units that errors are averaged over: trajectories, or time blocks of a single one; and the largest mean error."""

    count: Count
    worst: NonNegative


class Errors(StrictModel):
    """Errors of a finalist on a split, means over its seeds.

    Attributes:
        error: The error.
        in_words: What it means, as the end of a sentence.
        measures: Further measures by name; None where one is not defined.
        ci95: Interval of the error over seeds and units.
        why_no_interval: The reason why there is none, or "".
        by_seed: Error of each training.
        units: Units of the split.
    """

    error: NonNegative
    in_words: str
    measures: dict[str, NonNegative | None]
    ci95: Interval | None
    why_no_interval: str
    by_seed: dict[str, NonNegative]
    units: Units


class FrameTime(StrictModel):
    """Time of a frame in ms: median, quartiles, and the medians of geometry and network alone."""

    ms_per_frame: NonNegative
    ms_low: NonNegative
    ms_high: NonNegative
    geometry_ms: Real
    network_ms: Real


class AnalyticCost(FrameTime):
    """Cost of the analytic field; "network" are the sums over the pairs.

    Attributes:
        turns_ms: Time of each turn; the same turn of all models that were timed together had the same frame.
    """

    turns_ms: tuple[NonNegative, ...]


class ModelCost(AnalyticCost):
    """Cost of a finalist.

    Attributes:
        us_per_particle: Median time by the number of particles, µs.
        peak_mb: Memory that predictions add to a fresh process, MB.
        flops_per_particle: Operations of one particle's prediction.
        threads: Threads of the measurement.
        num_particles: Particles of a frame, mean.
    """

    us_per_particle: NonNegative
    peak_mb: Real
    flops_per_particle: NonNegative
    threads: Count
    num_particles: NonNegative


class SizeTime(FrameTime):
    """Time of a frame of so many particles."""

    num_particles: Count


class Growth(StrictModel):
    """How times grow with the number of particles.

    Attributes:
        sizes: Numbers of particles.
        models: Times of each model.
        exponents: Slope of time over number in logarithms, of each model measured at several sizes.
        left_out: Sizes that would have taken too long, by model.
    """

    sizes: tuple[Count, ...]
    models: dict[str, tuple[SizeTime, ...]]
    exponents: dict[str, Real]
    left_out: dict[str, tuple[Count, ...]]


class FinalistConfig(StrictModel):
    """Settings of a finalist, and the hyperparameters that gave them."""

    network: dict
    training: dict
    parameters: dict[str, Value]


class Finding(StrictModel):
    """What a check of stability measured in the worst seed of a finalist.

    Attributes:
        check: Name of the check.
        label: What was looked at.
        value: What was measured.
        limit: What it must not exceed.
        detail: What else a reader needs.
    """

    check: Name
    label: str
    value: Real
    limit: Real
    detail: str

    @property
    def passes(self) -> bool:
        """Whether the limit is kept."""
        return self.value <= self.limit


class CheckedCounts(StrictModel):
    """How many seeds were checked, on how many frames as they are, and on how many in every other state."""

    seeds: Count
    plain_frames: Count
    stressed_frames: Count


class Stability(StrictModel):
    """Whether a finalist passes every check of stability.

    Attributes:
        stable: Whether all seeds keep every limit.
        findings: What the checks measured; their checks and labels are the same for all finalists.
        failures: A line for each finding beyond its limit.
        counts: What was looked at.
    """

    stable: Flag
    findings: tuple[Finding, ...]
    failures: tuple[str, ...]
    counts: CheckedCounts


class FinalistEntry(StrictModel):
    """A finalist.

    Attributes:
        id: Its id.
        config: Its settings.
        num_parameters: Learned parameters.
        updates: Gradient updates of each training.
        fall_at_the_end: Share by which the error fell in the last quarter of the updates; None where none was measured.
        valid: Errors on the validation split.
        test: Errors on the test split.
        cost: Cost of a prediction.
        stability: Checks of stability.
        checkpoint: Folder of the best model, in the run folder.
        train_seconds: Duration of a training, mean.
    """

    id: Id
    config: FinalistConfig
    num_parameters: Count
    updates: Count
    fall_at_the_end: Real | None
    valid: Errors
    test: Errors
    cost: ModelCost
    stability: Stability
    checkpoint: PathText
    train_seconds: NonNegative


class AttainmentStep(StrictModel):
    """Test error that one seed of each model attains at a time per frame: median, and the range of 8 of 10 draws."""

    ms_per_frame: NonNegative
    median: NonNegative
    low: NonNegative
    high: NonNegative


class Hypervolume(StrictModel):
    """Area between the test errors and a reference point (ms per frame, error), in decades of both."""

    value: Real
    ci95: Interval | None
    why_no_interval: str
    reference: Interval


class Front(StrictModel):
    """The front of error and time, with its uncertainty."""

    attainment: tuple[AttainmentStep, ...]
    hypervolume: Hypervolume


class Recommended(StrictModel):
    """The recommended finalist, and the reason in words."""

    id: Id
    reason: str


class ComparedModel(StrictModel):
    """A finalist beside the most accurate one, by validation errors.

    Attributes:
        id: Its id.
        error: Its error.
        ms_per_frame: Its time.
        ratio: Its error by the best's, geometric mean over seeds and units.
        log_standard_error: Standard error of the logarithm of the ratio.
        ci95: Interval of the ratio.
        within_one_se: Whether it is within one standard error of the best.
        non_inferior: Whether the interval is below 1 plus the margin.
        accurate_enough: Whether the error is below the limit of the study.
        stable: Whether it passed every check of stability.
        eligible: Whether it may be recommended.
        why_not: Why not, or "".
    """

    id: Id
    error: NonNegative
    ms_per_frame: NonNegative
    ratio: NonNegative
    log_standard_error: NonNegative
    ci95: Interval | None
    within_one_se: Flag
    non_inferior: Flag
    accurate_enough: Flag
    stable: Flag
    eligible: Flag
    why_not: str


class ExpectedError(StrictModel):
    """Test error to expect of a new training of what is chosen without one seed, and how often each model is chosen."""

    error: NonNegative
    choices: dict[Id, Count]


class Selection(StrictModel):
    """How the recommended finalist was chosen.

    Attributes:
        units: Units of the validation split.
        margin: Margin of non-inferiority, as a share.
        best: The most accurate finalist.
        tied: Finalists whose times cannot be told apart from the fastest's.
        by_rule: What each rule alone would choose.
        comparisons: Every finalist beside the best.
        retrained: What a new training would give; None with a single seed.
    """

    units: Count
    margin: NonNegative
    best: Id
    tied: tuple[Id, ...]
    by_rule: dict[str, Id | None]
    comparisons: tuple[ComparedModel, ...]
    retrained: ExpectedError | None


class SearchPoint(StrictModel):
    """A trial of the search: its last validation error and its time, estimated unless it was measured."""

    id: Id
    stage: Name
    valid_error: NonNegative
    ms_per_frame: NonNegative
    measured: Flag
    num_parameters: Count
    outcome: str
    parameters: dict[str, Value]


class TimeCoefficients(StrictModel):
    """Time of a particle's prediction: a constant, and times of an operation and of a byte, in µs."""

    us_per_particle: Real
    us_per_flop: Real
    us_per_byte: Real


class CostModel(StrictModel):
    """The model that estimates times, and how far its estimates of measured models are off (µs a particle)."""

    time_model: TimeCoefficients
    measured: dict[Id, Real]
    predicted: dict[Id, Real]
    relative_errors: dict[Id, Real]
    median_relative_error: NonNegative
    rank_correlation: Real


class PassedRung(StrictModel):
    """How many trials were measured at a rung, and how many of them went on."""

    updates: Count
    trials: Count
    passed: Count


class Selected(StrictModel):
    """What the selection finds.

    Attributes:
        study: Name of the study.
        task: Its task.
        dataset: Its data.
        baseline: Id of the published network among the finalists.
        checks: What each check of stability looks at, by name; empty for a task without checks.
        mean_predictor: Error of predicting the mean.
        finalists: The finalists that were compared.
        budget: What the budget decided, in words; "" where it decided nothing.
        failed_finalists: What became of the others, by id.
        pareto_front: Ids of the finalists that none is both more accurate and faster than, fastest first.
        front: Uncertainty of that front.
        recommended: The finalist to use.
        selection: How it was chosen.
        search_points: Trials of the search; empty where too few models were timed.
        cost_model: What estimates their times; None where too few models were timed.
        analytic: Cost of the analytic field; None for a task without one.
        growth: How times grow with the scene.
        explained: Ids of the finalists whose filters and fields are in ``explanation/``.
        trials: Number of trainings, by stage and outcome.
        rungs: How many trials went on, by search and rung.
        wall_seconds: Duration of the study.
    """

    study: Name
    task: TaskFacts
    dataset: DatasetFacts
    baseline: Name
    checks: dict[Name, str]
    mean_predictor: MeanPredictor
    finalists: tuple[FinalistEntry, ...] = Field(min_length=1)
    budget: str
    failed_finalists: dict[Id, str]
    pareto_front: tuple[Id, ...]
    front: Front
    recommended: Recommended
    selection: Selection
    search_points: tuple[SearchPoint, ...]
    cost_model: CostModel | None
    analytic: AnalyticCost | None
    growth: Growth
    explained: tuple[Id, ...]
    trials: dict[Name, dict[str, Count]]
    rungs: dict[Name, tuple[PassedRung, ...]]
    wall_seconds: NonNegative


class Summary(Parts, Selected):
    """A finished study, in ``summary.json``: what the selection found, then what the stages before it found."""

    @model_validator(mode="after")
    def _a_finalist_is_recommended(self) -> "Summary":
        if self.finalist(self.recommended.id) is None:
            raise ValueError("`recommended.id` must be that of one of `finalists`")
        return self

    def finalist(self, name: str) -> FinalistEntry | None:
        """The finalist of an id; None if it was not compared."""
        return next((entry for entry in self.finalists if entry.id == name), None)

    @property
    def chosen(self) -> FinalistEntry:
        """The recommended finalist."""
        return next(entry for entry in self.finalists if entry.id == self.recommended.id)
