"""The results of the stages of a study as typed values, in ``stages/<name>.json`` and ``summary.json``.

Errors are those of the objective of the task. A field that ends in ``ci95`` is a 95 % interval, or None if there are
too few values for one.
"""

from typing import Literal, NamedTuple

from pydantic import Field, model_validator

from cconv.study.records.forms import Count, NonNegative
from cconv.validation import Flag, Id, InnerPath, Length, Name, Real, StrictModel, Value

Interval = tuple[Real, Real]


class SeedVariance(StrictModel):
    """Spread of the error over initial weights compared with the spread over configurations, at a rung.

    Attributes:
        updates: Gradient updates of the rung.
        seeds: Number of trainings of one configuration that differ in the seed.
        configurations: Number of trainings with one seed that differ in the configuration.
        seed_spread: Standard deviation of log10 error over the seeds.
        configuration_spread: The same over the configurations.
        seed_share: Variance over seeds ÷ variance over configurations; None if the latter is 0.
        seed_share_ci95: Its interval.
    """

    updates: Count
    seeds: Count
    configurations: Count
    seed_spread: NonNegative
    configuration_spread: NonNegative
    seed_share: NonNegative | None
    seed_share_ci95: Interval | None


class RungAudit(StrictModel):
    """How well the order of trials at a rung predicts their order at the full budget; None with too few trials.

    Attributes:
        updates: Gradient updates of the rung.
        trials: Number of trials without early stopping, measured at the rung and at the full budget.
        top: Number of trials that count as the best.
        spearman: Rank correlation of the two orders.
        kendall: Kendall's rank correlation.
        crossing_rate: Share of the pairs of trials whose order changes.
        recall: Share of the best at the end among the best at the rung.
        survival: Share of the best at the end among the trials that continue beyond the rung.
        regret: Final error of the best trial at the rung ÷ smallest final error.
        spearman_ci95: Interval of the rank correlation.
        why_no_interval: The reason why there is none, or "".
        verdict: Whether the rung is reliable for early stopping.
    """

    updates: Count
    trials: Count
    top: Count
    spearman: Real | None
    kendall: Real | None
    crossing_rate: NonNegative | None
    recall: NonNegative | None
    survival: NonNegative | None
    regret: NonNegative | None
    spearman_ci95: Interval | None
    why_no_interval: str
    verdict: Literal["reliable", "undecided", "unreliable"]


class ReplayedStrategy(StrictModel):
    """A stopping rule replayed on trials without early stopping, which are redrawn many times.

    Attributes:
        strategy: Its name.
        updates_each: Updates that "little_each" gives every trial; None for the others.
        keep: How many trials "little_each" then trains to the end; None for the others.
        share: Updates that it spends ÷ updates of training every trial to the full budget.
        regret: Best error that it finds ÷ best error of all trials, geometric mean over the draws.
        regret_range95: Range of that ratio in 95 % of the draws.
    """

    strategy: Literal["asha", "little_each", "no_stopping"]
    updates_each: Count | None
    keep: Count | None
    share: NonNegative
    regret: NonNegative
    regret_range95: Interval


class TestedShare(NamedTuple):
    """A share of the variance, and the ends of its 95 % interval."""

    share: float
    low: float
    high: float


class ParameterImportance(StrictModel):
    """Importance of a hyperparameter; the tested values are None if the trials do not vary it.

    Attributes:
        share: Share of the variance of log10 error that the hyperparameter alone explains.
        low: Lower end of the 95 % interval of the share.
        high: Upper end.
        p_value: p-value of the hypothesis of no influence, adjusted for the number of hyperparameters.
        decided: Whether the p-value is below 5 %.
        f_anova: The share estimated by a random forest.
        ped_anova: How much the best trials differ from all in it, as a share of the sum.
    """

    share: Real | None
    low: Real | None
    high: Real | None
    p_value: NonNegative | None
    decided: Flag
    f_anova: Real
    ped_anova: Real

    @property
    def tested(self) -> TestedShare | None:
        """The share with its interval; None where the trials do not vary the hyperparameter."""
        if self.share is None or self.low is None or self.high is None:
            return None
        return TestedShare(self.share, self.low, self.high)


class RungImportance(StrictModel):
    """Importance of all hyperparameters at a rung; if none is given, the measures are None and `why_none` says why.

    Attributes:
        updates: Gradient updates of the rung.
        trials: Trials that were measured there.
        clipped: Number of trials whose error is replaced by the error of a useless model.
        censored: Whether trials are missing because they were stopped before the rung.
        why_none: The reason why no importance is given, or "".
        detectable_share: Smallest share that is detected with a probability of 80 %.
        surrogate_r2: R² of a random forest on unseen trials; None also if all errors are equal.
        best_share: Share of the trials that PED-ANOVA counts as the best.
        parameters: Importance of each hyperparameter.
    """

    updates: Count
    trials: Count
    clipped: Count
    censored: Flag
    why_none: str
    detectable_share: NonNegative | None
    surrogate_r2: Real | None
    best_share: NonNegative | None
    parameters: dict[str, ParameterImportance]


class TrialPoint(StrictModel):
    """Value of a hyperparameter in a trial, and the trial's error."""

    value: Value
    error: NonNegative


class PartialDependence(StrictModel):
    """How the error depends on one hyperparameter while the others are as they were drawn, by a random forest.

    Attributes:
        parameter: The hyperparameter.
        scale: Scale of its values.
        updates: Gradient updates at which the errors were measured.
        trials: Number of trials that were measured there.
        surrogate_r2: R² of the forest on unseen trials; None if all errors are equal.
        values: Values of the hyperparameter.
        error: Expected error at each value.
        low: Lower end of the middle 80 % of the trees at each value.
        high: Upper end.
        points: The trials themselves.
    """

    parameter: str
    scale: Literal["linear", "log", "choice"]
    updates: Count
    trials: Count
    surrogate_r2: Real | None
    values: tuple[Value, ...]
    error: tuple[NonNegative, ...]
    low: tuple[NonNegative, ...]
    high: tuple[NonNegative, ...]
    points: tuple[TrialPoint, ...]


class SearchStrategy(StrictModel):
    """Cost and result of a stopping rule in a search.

    Attributes:
        updates: Gradient updates spent.
        best_valid: Smallest validation error of a completed trial; None without one.
        curve: (updates spent, smallest error so far), one entry for each trial.
    """

    updates: Count
    best_valid: NonNegative | None
    curve: tuple[tuple[Count, NonNegative], ...]


class SpentUpdates(StrictModel):
    """Gradient updates that a search spent, those that it would have spent without early stopping, and their ratio."""

    updates: Count
    full_updates: Count
    share: NonNegative


class References(StrictModel):
    """ASHA compared with another stopping rule at the same budget.

    Attributes:
        strategies: Result of each rule in each search, by a name for both.
        asha_share: Updates spent with early stopping, by search.
    """

    strategies: dict[str, SearchStrategy]
    asha_share: dict[Name, SpentUpdates]


class AblationStep(StrictModel):
    """A model retrained after one change; its errors and size are None if it was not trained or failed.

    Attributes:
        change: The hyperparameter or feature that changed.
        parameters: Hyperparameters after the change.
        valid_error: Validation error, mean over the seeds.
        low: Smallest error of a seed.
        high: Largest.
        flops_per_particle: Operations of a prediction per particle.
        num_parameters: Learned parameters.
    """

    change: str
    parameters: dict[str, Value]
    valid_error: NonNegative | None
    low: NonNegative | None
    high: NonNegative | None
    flops_per_particle: NonNegative | None
    num_parameters: Count | None


class Ablation(StrictModel):
    """The error after each change between the baseline and the best model.

    Attributes:
        of: The best finalist.
        error: Its validation error, mean over the seeds.
        path: From the baseline to the best trained finalist, one change after the other.
        toggled: The best finalist with one optional feature removed or added; its path is the `change`.
    """

    of: Id
    error: NonNegative
    path: tuple[AblationStep, ...]
    toggled: tuple[AblationStep, ...]


class BudgetPoint(StrictModel):
    """A finalist trained with one budget.

    Attributes:
        id: Name of its trainings.
        updates: Gradient updates of each.
        valid_error: Validation error, mean over the seeds.
        by_seed: Validation error of each training.
        train_seconds: Duration of a training, mean.
    """

    id: Id
    updates: Count
    valid_error: NonNegative
    by_seed: dict[str, NonNegative]
    train_seconds: NonNegative


class Convergence(StrictModel):
    """A finalist trained with larger and larger budgets, and whether the last one still lowered its error."""

    points: tuple[BudgetPoint, ...]
    still_falling: Flag


class TriedRelaxation(StrictModel):
    """A relaxation that was tried on validation rollouts; one without loops is none.

    Attributes:
        alpha: Size of a shift.
        beta: Viscosity relative to the pressure.
        loops: Shifts in a frame, the cost.
        quality: Geometric mean of the three measures ÷ those without relaxation; below 1 it makes rollouts better.
        mse: Mean squared error of the positions.
        sinkhorn: Sinkhorn divergence from the stored particles in the last frame.
        density: Mean |ρ - 1| in the last frame.
        diverged: Number of rollouts that did not reach their last frame.
        reason: Why the first of these ended, or "".
        seconds: Duration of the rollouts.
    """

    alpha: NonNegative
    beta: NonNegative
    loops: Count
    quality: Length
    mse: NonNegative
    sinkhorn: NonNegative
    density: NonNegative
    diverged: Count
    reason: str
    seconds: NonNegative


class RelaxedModel(StrictModel):
    """The relaxations that were tried with a finalist, in order; the first is none.

    Attributes:
        checkpoint: Folder of its model, relative to the run folder.
        frames: Frames of each rollout.
        rollouts: Number of validation rollouts of each.
        tried: What was tried.
    """

    checkpoint: InnerPath
    frames: Count
    rollouts: Count
    tried: tuple[TriedRelaxation, ...] = Field(min_length=1)


class Relaxed(StrictModel):
    """Relaxations of the rollouts of finalists, chosen by validation rollouts.

    Attributes:
        models: What was tried, by finalist.
        chosen: Number of the chosen one of these, by finalist; 0 is none.
        checkpoint: Folder of the recommended model with its relaxation, relative to the run folder; None without one.
        failures: A line for each check of stability that this model fails; None if it was not checked.
    """

    models: dict[Id, RelaxedModel]
    chosen: dict[Id, Count]
    checkpoint: InnerPath | None
    failures: tuple[str, ...] | None = None

    @model_validator(mode="after")
    def _the_chosen_were_tried(self) -> "Relaxed":
        if self.chosen.keys() != self.models.keys():
            raise ValueError("`chosen` must name the same finalists as `models`")
        for name, number in self.chosen.items():
            if number >= len(self.models[name].tried):
                raise ValueError(f"`chosen.{name}` must be the number of a relaxation that was tried")
        return self


class Parts(StrictModel):
    """Parts of the summary that come from other stages than the selection; a part without its stage is empty.

    Attributes:
        refined: Domain of each hyperparameter in the narrowed space and the reason, in words.
        initialization: Seed variance, by rung.
        rung_audit: Reliability of early stopping, by rung.
        strategies: Stopping rules replayed on trials without early stopping.
        references: ASHA compared with another stopping rule, by real trainings.
        importance: Importance of the hyperparameters, by rung.
        partial_dependence: Dependence of the error on the strongest of them.
        ablation: Error after each change between the baseline and the best model.
        convergence: Errors with larger budgets, by finalist.
        relaxed: Relaxations of the rollouts of the recommended model and of the most accurate one.
    """

    refined: dict[str, str] = {}
    initialization: tuple[SeedVariance, ...] = ()
    rung_audit: tuple[RungAudit, ...] = ()
    strategies: tuple[ReplayedStrategy, ...] = ()
    references: References | None = None
    importance: tuple[RungImportance, ...] = ()
    partial_dependence: tuple[PartialDependence, ...] = ()
    ablation: Ablation | None = None
    convergence: dict[Id, Convergence] = {}
    relaxed: Relaxed | None = None

    def found(self) -> dict:
        """Return the parts that were set by a stage, by name."""
        return {name: getattr(self, name) for name in Parts.model_fields if name in self.model_fields_set}


class Found(Parts):
    """The result of a stage.

    Attributes:
        finalists: Hyperparameters of the finalists that it retrained, by id.
        recommended: Id of the finalist that it recommends.
    """

    finalists: dict[Id, dict[str, Value]] = {}
    recommended: Id | None = None


class StageResult(Found):
    """The record of a finished stage, ``stages/<name>.json``: its kind, its duration and its result."""

    kind: str
    seconds: NonNegative
