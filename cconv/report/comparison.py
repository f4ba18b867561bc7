"""Several studies on one page: what each recommends, the speed-accuracy fronts, and how far the errors differ."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import ttest_ind

from cconv.errors import ConfigError
from cconv.evaluation.statistics import FEWEST
from cconv.files import read_json, write_text
from cconv.report.page import templates
from cconv.report.plots import new_figure
from cconv.report.tables import speed_accuracy_table
from cconv.study.records.forms import Count
from cconv.study.records.run_folder import RunFolder
from cconv.study.records.summary import FinalistEntry, Summary
from cconv.validation import Name, OpenModel, validated

NEEDED = 1.1  # ratio of errors from which on an input that was left out counts as needed


class _Inputs(OpenModel):
    """What a checkpoint's `config.json` says of the inputs of a model; nothing if the checkpoint is gone."""

    history: Count | None = None
    features: tuple[Name, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """A finished study among those that are compared.

    Attributes:
        label: Its name, with its folder where two studies have one name.
        summary: Its results.
        inputs: Inputs of the recommended model.
    """

    label: str
    summary: Summary
    inputs: _Inputs

    @property
    def chosen(self) -> FinalistEntry:
        """The recommended finalist."""
        return self.summary.chosen


def compared_runs(runs: Sequence[RunFolder]) -> list[ComparedRun]:
    """Read the results of finished studies.

    Raises:
        ConfigError: If there are fewer than two, one is given twice, or one has not finished.
    """
    if len(runs) < 2:
        raise ConfigError(f"a comparison needs at least two run folders, got {len(runs)}.")
    paths = [run.path.resolve() for run in runs]
    twice = [path for path in paths if paths.count(path) > 1]
    if twice:
        raise ConfigError(f"{twice[0]} is given twice; name each run folder once.")
    unfinished = [run.path for run in runs if not run.has_summary]
    if unfinished:
        raise ConfigError(
            f"{unfinished[0]}: the study has not finished, so it has no answer to compare; go on with it by "
            f"`cconv study resume {unfinished[0]}`."
        )
    summaries = [run.summary() for run in runs]
    names = [summary.study for summary in summaries]
    return [
        ComparedRun(
            label=summary.study if names.count(summary.study) == 1 else f"{summary.study} ({run.path})",
            summary=summary,
            inputs=_read_inputs(run.path / summary.chosen.checkpoint / "config.json"),
        )
        for run, summary in zip(runs, summaries, strict=True)
    ]


def _read_inputs(path: Path) -> _Inputs:
    return validated(_Inputs, read_json(path, error=ConfigError), path) if path.exists() else _Inputs()


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
    page = templates().get_template("comparison.html.j2")
    text = page.render(
        runs=runs,
        answers=answers_table(runs).to_dict("records"),
        differences=differences_table(runs).to_dict("records"),
        chart=fronts_chart(runs),
    )
    write_text(path, text)
