"""Studies on one page: what each recommends, fronts, how far errors differ, and networks of steps side by side."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import ttest_ind

from cconv.evaluation.statistics import FEWEST
from cconv.files import write_text
from cconv.report.compared_runs import ComparedRun
from cconv.report.page import templates
from cconv.report.plots import new_figure
from cconv.report.published import BUDGET
from cconv.report.scoreboard import OURS, matrix, scores_table
from cconv.report.scoreboard_plots import scoreboard_chart
from cconv.report.tables import speed_accuracy_table
from cconv.study.records.summary import Summary

NEEDED = 1.1  # ratio of errors from which on an input that was left out counts as needed


def answers_table(runs: Sequence[ComparedRun]) -> pd.DataFrame:
    """One row a study: the smallest sufficient model, what it is made of, its error on the test split and its cost.

    Columns: study, scene, task; model and in_words, what its network is; parameters; history, cutoff (particle
    spacings), layers, width (scalars and vectors of a hidden layer), terms, inputs; error with ci95_low and ci95_high,
    of_mean, its ratio to the error of predicting the mean; ms_per_frame; solver, the time of the solver's frame as a
    multiple; stable; dispensable, the inputs whose absence raised the validation error of the best model by less than a
    tenth. What does not apply is empty.
    """
    return pd.DataFrame([_answer(run) for run in runs])


def _answer(run: ComparedRun) -> dict:
    summary, chosen = run.summary, run.chosen
    low, high = chosen.test.ci95 or (math.nan, math.nan)
    network, mean = chosen.config.network, summary.mean_predictor.test
    solver = summary.solver.points[0].ms_per_frame if summary.solver and summary.solver.points else math.nan
    layers = network.get("layers")
    widths = [network[name] for name in ("first_channels", "hidden_channels") if name in network and (layers or 2) > 1]
    return {
        "study": run.label,
        "scene": summary.dataset.scene,
        "task": summary.task.name,
        "model": chosen.id,
        "in_words": chosen.in_words,
        "parameters": chosen.num_parameters,
        "history": run.inputs.history,
        "cutoff": network.get("relative_cutoff"),
        "layers": layers,
        "width": ", ".join(map(str, widths)),
        "terms": network.get("radial_terms", network.get("kernel_size")),
        "inputs": ", ".join(run.inputs.features),
        "error": chosen.test.error,
        "ci95_low": low,
        "ci95_high": high,
        "of_mean": chosen.test.error / mean if mean else math.nan,
        "ms_per_frame": chosen.cost.ms_per_frame,
        "solver": solver / chosen.cost.ms_per_frame,
        "stable": chosen.stability.stable,
        "dispensable": ", ".join(_dispensable(summary)),
    }


def _dispensable(summary: Summary) -> list[str]:
    """Inputs that the best model hardly misses when it is retrained without them."""
    ablation = summary.ablation
    if ablation is None or not ablation.error:
        return []
    return [
        row.change.rpartition(".")[2]
        for row in ablation.toggled
        if not row.parameters[row.change] and row.valid_error is not None and row.valid_error < NEEDED * ablation.error
    ]


def differences_table(runs: Sequence[ComparedRun]) -> pd.DataFrame:
    """One row a study that answers the same question of the same data as the first: the ratio of test errors.

    Columns: study, reference; ratio of the geometric means over trainings, with ci95_low and ci95_high by Welch's test
    on logarithms; why_none, the reason where there is no interval. It covers the chance of trainings, not of data:
    both models answer for the same test split.
    """
    reference, *others = runs
    alike = [run for run in others if _question(run) == _question(reference)]
    rows = [_difference(run, reference) for run in alike]
    return pd.DataFrame(rows, columns=["study", "reference", "ratio", "ci95_low", "ci95_high", "why_none"])


def _question(run: ComparedRun) -> tuple:
    facts = run.summary
    return facts.task.name, facts.task.error, facts.task.horizon, Path(facts.dataset.path).name, facts.dataset.frames


def _difference(run: ComparedRun, reference: ComparedRun) -> dict:
    errors = [list(each.chosen.test.by_seed.values()) for each in (run, reference)]
    row = {"study": run.label, "reference": reference.label, "ratio": math.nan, "why_none": ""}
    if not all(error > 0 for each in errors for error in each):
        return row | {"why_none": "an error is 0"}
    ours, theirs = (np.log(each) for each in errors)
    row["ratio"] = float(np.exp(ours.mean() - theirs.mean()))
    if min(len(ours), len(theirs)) < FEWEST:
        return row | {"why_none": f"fewer than {FEWEST} trainings of a model"}
    low, high = ttest_ind(ours, theirs, equal_var=False).confidence_interval()
    return row | {"ci95_low": math.exp(low), "ci95_high": math.exp(high)}


def fronts_chart(runs: Sequence[ComparedRun]) -> Figure:
    """Test error ÷ that of predicting the mean against time per frame, log axes: finalists and fronts of each study."""
    figure, axes = new_figure(8, 4.6)
    for run in runs:
        points = speed_accuracy_table(run.summary)
        finalists = points[points["kind"] == "finalist"].sort_values("ms")
        shown = finalists.assign(share=finalists["error"] / run.summary.mean_predictor.test)
        front = shown[shown["on_front"]]
        (line,) = axes.plot(front["ms"], front["share"], "-", lw=1, label=run.label)
        axes.plot(shown["ms"], shown["share"], "o", color=line.get_color(), markersize=5)
        chosen = shown[shown["name"] == run.chosen.id]
        axes.plot(chosen["ms"], chosen["share"], "*", color=line.get_color(), markersize=15)
    axes.set(xscale="log", yscale="log", xlabel="time per frame [ms]", ylabel="test error ÷ predicting the mean")
    axes.set_title("Finalists of each study; lines are fronts, stars are recommended")
    axes.legend(fontsize=8)
    return figure


def write_comparison(runs: Sequence[ComparedRun], path: Path) -> None:
    """Write the page that shows the tables and the chart; it opens without a network."""
    page, scores = templates().get_template("comparison.html.j2"), scores_table(runs)
    text = page.render(
        runs=runs,
        answers=answers_table(runs).to_dict("records"),
        differences=differences_table(runs).to_dict("records"),
        chart=fronts_chart(runs),
        scenes={scene: rows.to_dict("records") for scene, rows in scores.groupby("data", sort=False)},
        scoreboard=None if scores.empty else scoreboard_chart(scores),
        matrix=matrix(scores),
        has_published=bool((scores["source"] != OURS).any()),
        published_budget=BUDGET,
    )
    write_text(path, text)
