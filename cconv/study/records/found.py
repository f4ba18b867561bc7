"""What the stages of a study find, as typed values: each stage's part of ``stages/<name>.json`` and ``summary.json``.

Errors are those of the objective that the task names. A field that ends in ``ci95`` is a 95 % interval, None where
there is too little for one.
"""

from typing import Literal, NamedTuple

from cconv.study.records.forms import Count, NonNegative
from cconv.validation import Flag, Id, Name, Real, StrictModel, Value

Interval = tuple[Real, Real]


class SeedVariance(StrictModel):
    """Spread of the error over initial weights beside that over configurations, at a rung.

    Attributes:
        updates: Gradient updates of the rung.
        seeds: Trainings of one configuration that differ in the seed.
        configurations: Trainings with one seed that differ in the configuration.
        seed_spread: Standard deviation of log10 error over the seeds.
        configuration_spread: The same over the configurations.
        seed_share: Variance over seeds by that over configurations; None where the latter is 0.
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
    """How well the order of trials at a rung predicts their order at the full budget; measures of too few are None.

    Attributes:
        updates: Gradient updates of the rung.
        trials: Trials that nothing stopped, measured at the rung and at the end.
        top: How many of them count as the best.
        spearman: Rank correlation of the two orders.
        kendall: Kendall's rank correlation.
        crossing_rate: Share of the pairs of trials whose order turns.
        recall: Share of the best at the end among the best at the rung.
        survival: Share of the best at the end among those that go on from the rung.
        regret: Final error of the best at the rung by the smallest final error.
        spearman_ci95: Interval of the rank correlation.
        why_no_interval: The reason why there is none, or "".
        verdict: Whether trials can be stopped at the rung.
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
    """A search strategy replayed on trials that nothing stopped, drawn anew many times.

    Attributes:
        strategy: Its name.
        updates_each: Updates that "little_each" gives every trial; None for the others.
        keep: How many trials "little_each" then trains to the end; None for the others.
        share: Updates that it spends by those of training every trial to the end.
        regret: Best error that it finds by the best of all, geometric mean over the draws.
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
    """How much a hyperparameter decides; the tested values are None where the trials do not vary it.

    Attributes:
        share: Share of the variance of log10 error that it decides alone.
        low: Lower end of the 95 % interval of the share.
        high: Upper end.
        p_value: Of no influence, adjusted for the number of hyperparameters.
        decided: Whether that is below 5 %.
        f_anova: The share by a random forest.
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
    """Importance of all hyperparameters at a rung; without any, the measures are None and `why_none` says why.

    Attributes:
        updates: Gradient updates of the rung.
        trials: Trials that were measured there.
        clipped: How many count with the error of a useless model.
        censored: Whether trials that were stopped before are missing.
        why_none: The reason why no importance is given, or "".
        detectable_share: Smallest share that is found four times in five.
        surrogate_r2: R² of a random forest on unseen trials; None also where all errors are equal.
        best_share: Share of the trials that PED-ANOVA takes for the best.
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
        scale: How its values are spread.
        updates: Gradient updates of the errors.
        trials: Trials that were measured there.
        surrogate_r2: R² of the forest on unseen trials; None where all errors are equal.
        values: Values of the hyperparameter.
        error: Expected error at each value.
        low: Lower end of the middle 80 % of the trees there.
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
    """What a rule for stopping trials spent on a search and found.

    Attributes:
        updates: Gradient updates spent.
        best_valid: Smallest validation error of a completed trial; None without one.
        curve: (updates spent, smallest error so far), one entry a trial.
    """

    updates: Count
    best_valid: NonNegative | None
    curve: tuple[tuple[Count, NonNegative], ...]


class SpentUpdates(StrictModel):
    """Gradient updates that a search spent, what it would have spent had nothing been stopped, and their ratio."""

    updates: Count
    full_updates: Count
    share: NonNegative


class References(StrictModel):
    """ASHA beside another rule at the same budget.

    Attributes:
        strategies: What each rule found on each search, by a name for both.
        asha_share: What early stopping saved, by search.
    """

    strategies: dict[str, SearchStrategy]
    asha_share: dict[Name, SpentUpdates]


class AblationStep(StrictModel):
    """A model trained anew after one change; its errors and size are None where it was not trained or failed.

    Attributes:
        change: The hyperparameter or feature that changed.
        parameters: Hyperparameters after the change.
        valid_error: Validation error, mean over the seeds.
        low: Smallest error of a seed.
        high: Largest.
        flops_per_particle: Operations of one particle's prediction.
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
    """What each change brings.

    Attributes:
        of: The best finalist.
        error: Its validation error, mean over the seeds.
        path: From the baseline to the best trained finalist, one change after the other.
        branches: The best finalist with one feature left out or added, whose path is the `change`.
    """

    of: Id
    error: NonNegative
    path: tuple[AblationStep, ...]
    branches: tuple[AblationStep, ...]


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


class Parts(StrictModel):
    """Parts of the summary that stages before the selection find; one that no stage looked for is empty.

    Attributes:
        refined: What a narrowed space draws each hyperparameter from, in words.
        initialization: The luck of initial weights, by rung.
        rung_audit: Whether trials can be stopped at a rung.
        strategies: Search strategies replayed.
        references: ASHA beside another rule, by real trainings.
        importance: Importance of the hyperparameters, by rung.
        partial_dependence: How the error depends on the strongest of them.
        ablation: What each change between the baseline and the best model brings.
        convergence: Larger budgets, by finalist.
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

    def found(self) -> dict:
        """The parts that a stage looked for, by name."""
        return {name: getattr(self, name) for name in Parts.model_fields if name in self.model_fields_set}


class Found(Parts):
    """What a stage has found.

    Attributes:
        finalists: Hyperparameters of the finalists that it retrained, by id.
        recommended: Id of the finalist that it recommends.
    """

    finalists: dict[Id, dict[str, Value]] = {}
    recommended: Id | None = None


class StageResult(Found):
    """A stage that has ended, in ``stages/<name>.json``: its kind, its duration, and what it has found."""

    kind: str
    seconds: NonNegative
