"""Summaries for tests of the report, with as little and with as much as a study may find. All go through the types."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from cconv.report.compared_runs import ComparedRun, Inputs
from cconv.study.records.found import (
    Ablation,
    AblationStep,
    BudgetPoint,
    Convergence,
    ParameterImportance,
    PartialDependence,
    References,
    Relaxed,
    RelaxedModel,
    ReplayedStrategy,
    RungAudit,
    RungImportance,
    SearchStrategy,
    SeedVariance,
    SpentUpdates,
    TrialPoint,
    TriedRelaxation,
)
from cconv.study.records.rollouts import FinalistRollouts, FlowSeries, RolledTrajectory, write_rollouts
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import (
    AnalyticCost,
    AttainmentStep,
    CheckedCounts,
    ComparedModel,
    CostModel,
    Errors,
    ExpectedError,
    FinalistConfig,
    FinalistEntry,
    Finding,
    Front,
    Growth,
    Hypervolume,
    MeanPredictor,
    ModelCost,
    SearchPoint,
    Selected,
    Selection,
    SizeTime,
    SolverComparison,
    SolverPoint,
    Stability,
    Summary,
    TimeCoefficients,
    Units,
)

SAMPLE = Path(__file__).parents[1] / "analysis" / "sample_run"  # the committed run folder


def changed(record: BaseModel, **values) -> BaseModel:
    """A record with other values, which must fit it."""
    return type(record)(**(dict(record) | values))


def minimal_summary(summary: Summary) -> Summary:
    """What every study that recommends a model finds, of a summary that may hold more."""
    selected = {name: getattr(summary, name) for name in Selected.model_fields}
    models = {entry.id: summary.growth.models[entry.id] for entry in summary.finalists}
    growth = changed(summary.growth, models=models, exponents={})
    nothing = {"checks": {}, "search_points": (), "cost_model": None, "analytic": None, "explained": (), "rolled": ()}
    nothing |= {"solver": None}
    return Summary(**selected | nothing | {"growth": growth})


def whole_summary(summary: Summary) -> Summary:
    """A summary with everything that a study may find, about the finalists of another."""
    ids = [entry.id for entry in summary.finalists]
    finalists = [changed(entry, stability=stability(entry.test.error)) for entry in summary.finalists]
    return changed(
        minimal_summary(summary),
        checks={name: f"Errors of {name}." for name in ("regimes", "stress", "precision")},
        finalists=finalists,
        search_points=_search_points(),
        cost_model=_cost_model(),
        analytic=AnalyticCost(
            ms_per_frame=2.2, ms_low=2.1, ms_high=2.35, geometry_ms=1.5, network_ms=0.7, turns_ms=(2.1, 2.2, 2.35)
        ),
        explained=list(dict.fromkeys([summary.recommended.id, summary.baseline])),
        rolled=ids,
        front=_front(),
        growth=Growth(
            sizes=(1000, 100_000),
            models={name: (_size(1000), _size(100_000)) for name in ids},
            exponents=dict.fromkeys(ids, 1.03),
            left_out={},
        ),
        mean_predictor=MeanPredictor(valid=4.5, test=1.58),
        selection=_selection(ids),
        **parts(summary.baseline) | {"relaxed": relaxations(summary.recommended.id)},
    )


def solver_comparison(*errors: float, network_error: float = 1e-4, slow: Sequence[float] = ()) -> SolverComparison:
    """Solvers of these errors, the first that of the data at 8 ms, each four times as fast as the one before.

    Those with slow sound have the errors `slow` and the same times.
    """
    points = [
        SolverPoint(
            factor=1.0 + place,
            sound_ratio=sound_ratio,
            num_particles=400 // (1 + place) ** 2,
            steps=100 // (1 + place),
            ms_per_frame=8 / 4**place,
            ms_low=7.5 / 4**place,
            ms_high=9 / 4**place,
            error=error,
            diverged=0.0,
        )
        for sound_ratio, series in ((10, errors), (5, slow))
        for place, error in enumerate(series)
    ]
    return SolverComparison(points=points, rollouts=4, network_error=network_error)


def parts(baseline: str) -> dict:
    """All parts of a summary that stages before the selection find, by name."""
    return {
        "refined": {"network.layers": "narrowed to 1 and 2: no better trial has more"},
        "initialization": [seed_variance(15), seed_variance(45)],
        "rung_audit": [_rung(15, None, "undecided"), _rung(45, 0.6, "unreliable"), _rung(135, 0.9, "reliable")],
        "strategies": [_replayed("asha"), _replayed("little_each", updates_each=15, keep=2), _replayed("no_stopping")],
        "references": _references(),
        "importance": importances(),
        "partial_dependence": [dependence("choice", ["poly6", "none"]), dependence("log", [1e-3, 1e-2])],
        "ablation": _ablation(),
        "convergence": {baseline: Convergence(points=[_budget(135), _budget(600)], still_falling=True)},
    }


def tried_relaxation(loops: int, quality: float, *, alpha: float = 0.02, reason: str = "") -> TriedRelaxation:
    """A relaxation whose measures are all of this quality; a reason is why a rollout diverged."""
    return TriedRelaxation(
        alpha=alpha if loops else 0.0,
        beta=0.3 if loops else 0.0,
        loops=loops,
        quality=quality,
        mse=1e-4 * quality,
        sinkhorn=1e-6 * quality,
        density=0.01 * quality,
        diverged=1 if reason else 0,
        reason=reason,
        seconds=2.0,
    )


def relaxations(name: str, checkpoint: str | None = "relaxed") -> Relaxed:
    """Relaxations of a finalist, of which the fourth is chosen, or none at all if no checkpoint is offered."""
    tried = [
        tried_relaxation(0, 1.0),
        tried_relaxation(1, 0.9, alpha=0.005),
        tried_relaxation(5, 0.2, alpha=0.03),
        tried_relaxation(3, 0.21),
        tried_relaxation(5, 30.0, alpha=0.1, reason="A relaxation shifted a particle by 2 particle spacings"),
    ]
    model = RelaxedModel(checkpoint=f"finalists/{name}/seed_1/checkpoint", frames=20, rollouts=2, tried=tried)
    return Relaxed(models={name: model}, chosen={name: 3 if checkpoint else 0}, checkpoint=checkpoint)


def finalist(name: str, *, updates: int = 81, fall_at_the_end: float | None = None, error: float = 0.01):
    """A finalist with one error everywhere."""
    errors = Errors(
        error=error,
        in_words=f"about {error:.3g} of the spread",
        measures={"relative RMSE": error**0.5},
        ci95=(error / 2, 2 * error),
        why_no_interval="",
        by_seed={"seed_1": error},
        units=Units(count=5, worst=2 * error),
    )
    times = {"ms_per_frame": 2.0, "ms_low": 1.9, "ms_high": 2.2, "geometry_ms": 1.2, "network_ms": 0.8}
    counted = {"us_per_particle": 5.0, "peak_mb": 60.0, "flops_per_particle": 900.0, "threads": 1, "num_particles": 400}
    return FinalistEntry(
        id=name,
        config=FinalistConfig(network={}, training={}, parameters={"network.layers": 1}),
        num_parameters=90,
        updates=updates,
        fall_at_the_end=fall_at_the_end,
        valid=errors,
        test=errors,
        cost=ModelCost(**times, **counted, turns_ms=(1.9, 2.0, 2.2)),
        stability=stability(error),
        checkpoint=f"finalists/{name}/seed_1/checkpoint",
        train_seconds=3.0,
    )


def stability(error: float) -> Stability:
    """Stability of a model that has this error everywhere."""
    failures = [] if error <= 0.05 else [f"error {error:.3g} on the frame clumped (limit 0.05)"]
    findings = [
        _finding("regimes", "bulk", error, 0.5, "90 % of particles"),
        _finding("regimes", "near_wall", error, 0.5, "10 % of particles"),
        _finding("stress", "clumped", error, 0.05, "trajectory 0, frame 3"),
        _finding("precision", "float32", 1e-6, 1e-3),
    ]
    counts = CheckedCounts(seeds=3, plain_frames=20, stressed_frames=3)
    return Stability(stable=not failures, findings=findings, failures=failures, counts=counts)


def _finding(check: str, label: str, value: float, limit: float, detail: str = "") -> Finding:
    return Finding(check=check, label=label, value=value, limit=limit, detail=detail)


def importances() -> list[RungImportance]:
    """Importances at three rungs, unknown at the first."""
    unknown = RungImportance(
        updates=15,
        trials=16,
        clipped=15,
        censored=False,
        why_none="15 of 16 trials are no better than predicting the mean",
        detectable_share=None,
        surrogate_r2=None,
        best_share=None,
        parameters={},
    )
    strong, weak = judged(0.4, decided=True), judged(0.1, decided=False)
    parameters = {"network.layers": strong, "network.window": weak, "network.message": unvaried()}
    return [unknown, importance(45, parameters), importance(135, parameters)]


def importance(updates: int, parameters: dict[str, ParameterImportance], censored: bool = True) -> RungImportance:
    """Importances of hyperparameters at a rung."""
    return RungImportance(
        updates=updates,
        trials=16,
        clipped=0,
        censored=censored,
        why_none="",
        detectable_share=0.62,
        surrogate_r2=0.7,
        best_share=0.3,
        parameters=parameters,
    )


def judged(share: float, *, decided: bool) -> ParameterImportance:
    """A hyperparameter that decides a share of the variance."""
    return ParameterImportance(
        share=share,
        low=share * 0.75 if decided else 0.0,
        high=share * 1.25,
        p_value=0.01 if decided else 0.6,
        decided=decided,
        f_anova=share / 3,
        ped_anova=share / 4,
    )


def unvaried() -> ParameterImportance:
    """A hyperparameter that the trials do not vary."""
    untested = dict.fromkeys(("share", "low", "high", "p_value"))
    return ParameterImportance(**untested, decided=False, f_anova=0.0, ped_anova=0.0)


def dependence(scale: str, values: list) -> PartialDependence:
    """Partial dependence of a hyperparameter with these values."""
    error = [0.1 * (position + 1) for position in range(len(values))]
    return PartialDependence(
        parameter=f"of {scale}",
        scale=scale,
        updates=1000,
        trials=3,
        surrogate_r2=None if scale == "linear" else 0.5,
        values=values,
        error=error,
        low=[each / 2 for each in error],
        high=[each * 2 for each in error],
        points=[TrialPoint(value=values[0], error=0.2), TrialPoint(value=values[-1], error=0.7)],
    )


def explanation(dim: int = 2, components: int = 1, particles: int = 60) -> dict[str, np.ndarray]:
    """Arrays as `cconv.evaluation.explanation` gives them, of an imaginary model."""
    rng = np.random.default_rng(0)
    line, radii = np.linspace(-0.2, 0.2, 21), np.linspace(0.01, 0.2, 10)
    filters = rng.normal(size=(dim, 21, dim + 2, components))
    return {
        "particle_spacing": np.array(0.1),
        "positions": rng.uniform(size=(particles, dim)),
        "target": rng.normal(size=(particles, components)),
        "prediction": rng.normal(size=(particles, components)),
        "error": rng.uniform(size=particles),
        "feature_names": np.array(["1", *(f"v_{axis}" for axis in "xyz"[:dim]), "ρ"]),
        "is_combined": np.array(False),
        "unexplained": np.array(0.0123),
        "cutoff": np.array(0.2),
        "support": np.array(0.2),
        "line": line,
        "learned_on_axes": filters,
        "analytic_on_axes": filters + 0.1,
        "radii": radii,
        "learned_radial": -radii,
        "learned_radial_low": -radii - 0.1,
        "learned_radial_high": -radii + 0.1,
        "analytic_radial": -radii,
        "error_bins": np.logspace(-8, 3, 56),
        "error_counts": np.bincount(rng.integers(10, 40, particles), minlength=55),
        "error_levels": np.array([0.5, 1.0]),
        "error_quantiles": np.array([0.01, 0.1]),
    }


def rollouts(ended: str = "") -> FinalistRollouts:
    """Rollouts of two trainings over two trajectories; the last of them may have ended early."""
    rolled = [_rolled(seed, name, 12, "") for seed in ("seed_1", "seed_2") for name in ("test/00000", "test/00001")]
    rolled[-1] = _rolled("seed_2", "test/00001", 7 if ended else 12, ended)
    return FinalistRollouts(rolled=rolled, lost=())


def _rolled(seed: str, trajectory: str, frames: int, ended: str) -> RolledTrajectory:
    looks = range(3, frames + 1, 3)
    return RolledTrajectory(
        seed=seed,
        trajectory=trajectory,
        stored=12,
        mse=[1e-6 * (frame + 1) ** 2 for frame in range(frames)],
        looked_at=looks,
        rollout=_flow(1.1, len(looks)),
        reference=_flow(1.0, len(looks)),
        beyond={"energy too high": 5} if ended else {},
        ended=ended,
    )


def _flow(energy: float, looks: int) -> FlowSeries:
    shares = [0.25, 0.5, 0.25, 0.0]
    return FlowSeries(e_kin=[energy * 0.9**look for look in range(looks)], neighbors=shares, speeds=shares)


def compared_steps(
    folder: str = "runs/data/2D_TGV_2500_10kevery100", horizon: int = 20, ended: str = ""
) -> ComparedRun:
    """A study of steps with two finalists, of which the second errs three times as much and may end early."""
    summary = RunFolder(SAMPLE).summary()
    models = [
        changed(finalist("large", error=3e-6), train_cpu_seconds=90.0),
        finalist(summary.recommended.id, error=1e-6),
    ]
    with_five = [changed(each, test=changed(each.test, measures={"MSE5": each.test.error / 9})) for each in models]
    summary = changed(
        summary,
        task=changed(summary.task, horizon=horizon),
        dataset=changed(summary.dataset, path=folder),
        finalists=with_five,
        solver=solver_comparison(1e-8, 1e-5),
        rolled=("large",),
    )
    return ComparedRun(label="s", summary=summary, inputs=Inputs(), rollouts={"large": rollouts(ended)})


def seed_variance(updates: int) -> SeedVariance:
    """Spreads at a rung, with an interval of their share."""
    return SeedVariance(
        updates=updates,
        seeds=8,
        configurations=16,
        seed_spread=0.1,
        configuration_spread=0.5,
        seed_share=0.04,
        seed_share_ci95=(0.01, 0.16),
    )


def _search_points() -> list[SearchPoint]:
    outcomes = ("completed", "stopped", "diverged")
    return [
        SearchPoint(
            id=f"{stage}_{number:04d}",
            stage=stage,
            valid_error=10.0 ** (number - 3),
            ms_per_frame=2.0 + number,
            measured=stage == "closed_form",
            num_parameters=100 * number + 7,
            outcome="completed" if stage == "closed_form" else outcomes[number % 3],
            parameters={"network.layers": 2, "network.window": "poly6", "training.learning_rate": 0.0012345},
        )
        for stage in ("closed_form", "random", "second_look")
        for number in range(5)
    ]


def _cost_model() -> CostModel:
    times = {f"random_{number:04d}": 2.0 + number for number in range(5)}
    return CostModel(
        time_model=TimeCoefficients(us_per_particle=1.0, us_per_flop=1e-5, us_per_byte=1e-4),
        measured=times,
        predicted=times,
        relative_errors=dict.fromkeys(times, 0.0),
        median_relative_error=0.0,
        rank_correlation=1.0,
    )


def _front() -> Front:
    steps = ((3.6, 2.3e-3, 2.0e-3, 2.8e-3), (4.2, 9.5e-4, 8.0e-4, 1.2e-3))
    return Front(
        attainment=[AttainmentStep(ms_per_frame=ms, median=mid, low=low, high=high) for ms, mid, low, high in steps],
        hypervolume=Hypervolume(value=7.52, ci95=(7.21, 7.93), why_no_interval="", reference=(10.0, 1.58)),
    )


def _size(num_particles: int) -> SizeTime:
    ms = num_particles / 1000
    parts_of_it = {"geometry_ms": 0.6 * ms, "network_ms": 0.4 * ms}
    return SizeTime(num_particles=num_particles, ms_per_frame=ms, ms_low=0.9 * ms, ms_high=1.1 * ms, **parts_of_it)


def _references() -> References:
    asha = SearchStrategy(updates=4000, best_valid=9e-4, curve=[(400, 0.01), (4000, 9e-4)])
    little = SearchStrategy(updates=3900, best_valid=1.2e-3, curve=[(3900, 1.2e-3)])
    return References(
        strategies={"random, ASHA": asha, "random, a little each": little},
        asha_share={"random": SpentUpdates(updates=4000, full_updates=17857, share=0.224)},
    )


def _ablation() -> Ablation:
    return Ablation(
        of="best",
        error=0.001,
        path=[_step("baseline", 0.016), _step("lost", None), _step("network.layers", 0.002)],
        toggled=[_toggled("walls", True, 0.00421), _toggled("density", False, None)],
    )


def _toggled(feature: str, is_taken: bool, error: float | None) -> AblationStep:
    change = f"task.features.{feature}"
    return _step(change, error, {change: is_taken})


def _step(change: str, error: float | None, parameters: dict | None = None) -> AblationStep:
    return AblationStep(
        change=change,
        parameters=parameters or {},
        valid_error=error,
        low=error and error / 2,
        high=error and error * 2,
        flops_per_particle=error and 900.0,
        num_parameters=error and 90,
    )


def _budget(updates: int) -> BudgetPoint:
    error = 1 / updates
    by_seed = {"seed_1": error}
    return BudgetPoint(
        id=f"baseline_after_{updates}",
        updates=updates,
        valid_error=error,
        by_seed=by_seed,
        train_seconds=updates / 10,
    )


def _replayed(strategy: str, **settings) -> ReplayedStrategy:
    settings = {"updates_each": None, "keep": None} | settings
    return ReplayedStrategy(strategy=strategy, share=0.5, regret=1.1, regret_range95=(1.0, 1.3), **settings)


def _rung(updates: int, value: float | None, verdict: str) -> RungAudit:
    measures = dict.fromkeys(("spearman", "kendall", "crossing_rate", "recall", "survival", "regret"), value)
    return RungAudit(
        updates=updates,
        trials=16,
        top=3,
        spearman_ci95=None if value is None else (value - 0.1, value + 0.1),
        why_no_interval="2 trials, and at least 12 are needed" if value is None else "",
        verdict=verdict,
        **measures,
    )


def _selection(ids: list[str]) -> Selection:
    return Selection(
        units=5,
        margin=0.05,
        best=ids[0],
        tied=ids[:2],
        by_rule={"one_standard_error": ids[0], "accurate_enough": None},
        comparisons=[_comparison(name, number) for number, name in enumerate(ids)],
        retrained=ExpectedError(error=0.0321, choices={ids[0]: 4, ids[1]: 1}),
    )


def _comparison(name: str, number: int) -> ComparedModel:
    worse = number > 0
    return ComparedModel(
        id=name,
        error=1e-3 * (number + 1),
        ms_per_frame=2.0 + number,
        ratio=1.0 + number,
        ci95=(0.8 + number, 1.3 + number) if worse else (1.0, 1.0),
        log_standard_error=0.12 * number,
        within_one_se=not worse,
        non_inferior=not worse,
        accurate_enough=False,
        stable=True,
        eligible=not worse,
        why_not="less accurate than the margin allows" if worse else "",
    )


def whole_run_in(folder):
    """A copy of the committed run with everything that a study may find."""
    run = RunFolder(shutil.copytree(SAMPLE, folder / "run"))
    summary = whole_summary(run.summary())
    run.write_summary(summary)
    for name in summary.explained:
        np.savez(run.path / "explanation" / f"{name}.npz", **explanation())
    for name in summary.rolled:
        write_rollouts(run, name, rollouts())
    return run
