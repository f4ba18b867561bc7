"""The summary of a finished study as typed values: results of the selection, and the parts of the other stages.

Errors are those of the objective of the task, and times are those of one frame. ``ci95`` is a 95 % interval, or None if
there are too few values for one.
"""

from pydantic import Field, model_validator

from cconv.study.records.forms import Count, NonNegative
from cconv.study.records.found import Interval, Parts
from cconv.validation import Flag, Id, InnerPath, Name, PathText, Real, StrictModel, Text, Value


class TaskFacts(StrictModel):
    """The task of a study in words, for the report.

    Attributes:
        name: Name of the task.
        symbol: Symbol of the predicted quantity.
        meaning: Explanation of the predicted quantity.
        error: Name of the error.
        error_meaning: Explanation of the error.
        measures: Explanation of each further measure, by its name.
        mean_predictor: Explanation of the error of always predicting the mean.
        horizon: Frames of the rollouts behind the error; None for a field.
    """

    name: Name
    symbol: str
    meaning: str
    error: str
    error_meaning: str
    measures: dict[str, str]
    mean_predictor: str = ""
    horizon: Count | None = None


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
        in_words: Meaning of the error, as the end of a sentence.
        measures: Further measures by name; None if a measure is not defined.
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
        turns_ms: Time of each turn; in the same turn all models predict the same frame.
    """

    turns_ms: tuple[NonNegative, ...]


class ModelCost(AnalyticCost):
    """Cost of a finalist.

    Attributes:
        us_per_particle: Median time ÷ number of particles, µs.
        peak_mb: Memory that predictions add to a fresh process, MB.
        flops_per_particle: Operations of a prediction per particle.
        threads: Number of threads of the measurement.
        num_particles: Mean number of particles of a frame.
        device: Where it was timed; the analytic field and a solver always run on the CPU.
    """

    us_per_particle: NonNegative
    peak_mb: Real
    flops_per_particle: NonNegative
    threads: Count
    num_particles: NonNegative
    device: Text = "cpu"


class SizeTime(FrameTime):
    """Time of a frame with a given number of particles."""

    num_particles: Count


class Growth(StrictModel):
    """How times grow with the number of particles.

    Attributes:
        sizes: Numbers of particles.
        models: Times of each model.
        exponents: Slope of log time against log number of particles, for each model measured at several sizes.
        left_out: Sizes that would have taken too long, by model.
    """

    sizes: tuple[Count, ...]
    models: dict[str, tuple[SizeTime, ...]]
    exponents: dict[str, Real]
    left_out: dict[str, tuple[Count, ...]]


class FinalistConfig(StrictModel):
    """Settings of a finalist, and the hyperparameters that they come from."""

    network: dict
    training: dict
    parameters: dict[str, Value]


class Finding(StrictModel):
    """A value that a check of stability measured in the worst seed of a finalist.

    Attributes:
        check: Name of the check.
        label: The part of the check, e.g. a regime or a state.
        value: The measured value.
        limit: Largest value that passes.
        detail: Further facts for a reader.
    """

    check: Name
    label: str
    value: Real
    limit: Real
    detail: str

    @property
    def passes(self) -> bool:
        """True if the value does not exceed the limit."""
        return self.value <= self.limit


class CheckedCounts(StrictModel):
    """Numbers of checked seeds, of unchanged frames, and of frames in every perturbed state."""

    seeds: Count
    plain_frames: Count
    stressed_frames: Count


class Stability(StrictModel):
    """Whether a finalist passes every check of stability.

    Attributes:
        stable: Whether all seeds keep every limit.
        findings: Measured values; their checks and labels are the same for all finalists.
        failures: A line for each finding beyond its limit.
        counts: Numbers of checked seeds and frames.
    """

    stable: Flag
    findings: tuple[Finding, ...]
    failures: tuple[str, ...]
    counts: CheckedCounts


class FinalistEntry(StrictModel):
    """A finalist.

    Attributes:
        id: Its id.
        in_words: What its network is, e.g. "radial layer, 8 terms"; "" in records of earlier versions.
        config: Its settings.
        num_parameters: Learned parameters.
        updates: Gradient updates of a training, mean.
        fall_at_the_end: Relative fall of the error in the last quarter of the updates; None if it was not measured.
        valid: Errors on the validation split.
        test: Errors on the test split.
        cost: Cost of a prediction.
        stability: Checks of stability.
        checkpoint: Folder of the best model, relative to the run folder.
        train_seconds: Duration of a training, mean.
        train_cpu_seconds: CPU time of its updates, mean; None in records of earlier versions.
    """

    id: Id
    in_words: str = ""
    config: FinalistConfig
    num_parameters: Count
    updates: Count
    fall_at_the_end: Real | None
    valid: Errors
    test: Errors
    cost: ModelCost
    stability: Stability
    checkpoint: InnerPath
    train_seconds: NonNegative
    train_cpu_seconds: NonNegative | None = None


class AttainmentStep(StrictModel):
    """Test error that one random seed of each model attains at a time per frame: median and range of 8 of 10 draws."""

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
    """A finalist compared with the most accurate one by validation errors.

    Attributes:
        id: Its id.
        error: Its error.
        ms_per_frame: Its time.
        ratio: Its error ÷ error of the best, geometric mean over seeds and units.
        log_standard_error: Standard error of the logarithm of the ratio.
        ci95: Interval of the ratio.
        within_one_se: Whether it is within one standard error of the best.
        non_inferior: Whether the interval is below 1 plus the margin.
        accurate_enough: Whether the error is below the limit of the study.
        stable: Whether it passed every check of stability.
        eligible: Whether it may be recommended.
        why_not: The reason why it may not be recommended, or "".
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
    """Test error to expect of a new training of the chosen model, by leaving out one seed at a time.

    Attributes:
        error: Mean test error of the model chosen without a seed, trained with that seed.
        choices: How often each model is chosen.
    """

    error: NonNegative
    choices: dict[Id, Count]


class Selection(StrictModel):
    """How the recommended finalist was chosen.

    Attributes:
        units: Units of the validation split.
        margin: Margin of non-inferiority, as a share.
        best: The most accurate finalist.
        tied: Finalists whose times cannot be told apart from the fastest's.
        by_rule: The model that each rule alone would choose.
        comparisons: Every finalist compared with the best.
        retrained: Error to expect of a new training; None with a single seed.
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
    """Coefficients of the time of a prediction per particle: a constant, and times per operation and byte, in µs."""

    us_per_particle: Real
    us_per_flop: Real
    us_per_byte: Real


class CostModel(StrictModel):
    """The model that estimates times, and the errors of its estimates for measured models (µs per particle)."""

    time_model: TimeCoefficients
    measured: dict[Id, Real]
    predicted: dict[Id, Real]
    relative_errors: dict[Id, Real]
    median_relative_error: NonNegative
    rank_correlation: Real


class PassedRung(StrictModel):
    """Numbers of trials that were measured at a rung and that continued beyond it."""

    updates: Count
    trials: Count
    passed: Count


class SolverPoint(StrictModel):
    """The solver at one resolution, restarted from the starts of rollouts.

    Attributes:
        factor: Its particle spacing ÷ that of the data; 1 for the solver that made them.
        sound_ratio: Its speed of sound ÷ the largest speed that its scene expects.
        num_particles: Number of its fluid particles.
        steps: Its steps of a frame.
        ms_per_frame: Median time of a frame, ms.
        ms_low: Lower quartile.
        ms_high: Upper quartile.
        error: Error of its rollouts.
        diverged: Share of the rollouts that it did not finish.
    """

    factor: NonNegative
    sound_ratio: NonNegative
    num_particles: Count
    steps: Count
    ms_per_frame: NonNegative
    ms_low: NonNegative
    ms_high: NonNegative
    error: NonNegative
    diverged: NonNegative


class SolverComparison(StrictModel):
    """The solver that made the data beside the recommended model of a step.

    Attributes:
        points: The solver itself, then cheaper forms, the usual speed of sound first; empty if it was not measured.
        rollouts: Number of rollouts of the test split that it was measured on.
        network_error: Error of the recommended model on the same rollouts, mean over its seeds; None without points.
        why_none: The reason why it was not measured, or "".
    """

    points: tuple[SolverPoint, ...] = ()
    rollouts: Count = 0
    network_error: NonNegative | None = None
    why_none: str = ""


class Selected(StrictModel):
    """The results of the selection.

    Attributes:
        study: Name of the study.
        task: Its task.
        dataset: Its data.
        baseline: Id of the published network among the finalists.
        checks: Description of each check of stability, by name; empty for a task without checks.
        mean_predictor: Error of predicting the mean.
        finalists: The finalists that were compared.
        budget: Influence of the training budget on the result, in words; "" if there is none.
        failed_finalists: Outcome of the finalists that were not compared, by id.
        pareto_front: Ids of the finalists on the Pareto front of validation error and time, fastest first.
        front: Uncertainty of that front.
        recommended: The finalist to use.
        selection: The comparison behind the choice.
        search_points: Trials of the search; empty if too few models were timed.
        cost_model: The model that estimates their times; None if too few models were timed.
        analytic: Cost of the analytic field; None for a task without one.
        solver: The solver beside the recommended model; None for a field.
        growth: Growth of the times with the number of particles.
        explained: Ids of the finalists whose filters and fields are in ``explanation/``.
        rolled: Ids of the finalists whose rollouts over test trajectories are in ``rollouts/``; empty for a field.
        trials: Number of trainings, by stage and outcome.
        rungs: Numbers of trials that continued, by search and rung.
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
    solver: SolverComparison | None = None
    growth: Growth
    explained: tuple[Id, ...]
    rolled: tuple[Id, ...] = ()
    trials: dict[Name, dict[str, Count]]
    rungs: dict[Name, tuple[PassedRung, ...]]
    wall_seconds: NonNegative


class Summary(Parts, Selected):
    """A finished study, ``summary.json``: the results of the selection and of the stages before it."""

    @model_validator(mode="after")
    def _a_finalist_is_recommended(self) -> "Summary":
        if self.finalist(self.recommended.id) is None:
            raise ValueError("`recommended.id` must be that of one of `finalists`")
        return self

    def finalist(self, name: str) -> FinalistEntry | None:
        """Return the finalist with an id; None if it was not compared."""
        return next((entry for entry in self.finalists if entry.id == name), None)

    @property
    def chosen(self) -> FinalistEntry:
        """The recommended finalist."""
        return next(entry for entry in self.finalists if entry.id == self.recommended.id)

    @property
    def offered_checkpoint(self) -> str:
        """Folder of the recommended model, with its relaxation if it has one, relative to the run folder."""
        return (self.relaxed and self.relaxed.checkpoint) or self.chosen.checkpoint
