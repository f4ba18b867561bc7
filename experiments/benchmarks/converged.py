"""Published sizes trained until more updates bring nothing, a training at a time, so that results add up over days.

    python experiments/benchmarks/converged.py --data FOLDER baseline:1 published_difference:1 thesis_best:1
    python experiments/benchmarks/converged.py

The trainings are those of the stage `converge` of experiments/dpi_converged.toml: model, seed, one budget. One that
was cut short goes on where it was; one that ended is a file in results/converged and is not trained again. Without
trainings, the table and the chart of all files are written.
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
import torch
from matplotlib.figure import Figure
from rich.progress import track

from cconv.evaluation.objectives import NormalizedMSE
from cconv.files import write_json
from cconv.models.checkpoint import load_model
from cconv.report.plots import budget_chart
from cconv.study.declared.search_space import load_space
from cconv.study.declared.stage import BASELINE
from cconv.study.declared.study_file import StudyConfig
from cconv.study.records.trials import TrialFolder
from cconv.study.running.problem import (
    load_problem,
    open_study_data,
    provenance,
    study_samples,
    study_task,
    with_data_path,
)
from cconv.study.running.trial import Trial, run_trial
from cconv.study.studies import load_study

STUDY = Path(__file__).parents[1] / "dpi_converged.toml"
RESULTS = Path(__file__).parent / "results" / "converged"


def hyperparameters(study: StudyConfig) -> dict[str, dict]:
    """Hyperparameters of the models that the stage `converge` trains, by name."""
    named = {BASELINE: load_space(study.search.space, study).baseline, **study.stages["finalists"].include}
    return {name: named[name] for name in study.stages["converge"].of}


def train(study: StudyConfig, model: str, seed: int, updates: int, place: Path) -> dict:
    """Train one model with one seed, and read its errors on the validation and the test split.

    Args:
        study: Study file with its data.
        model: Name among `hyperparameters`.
        seed: Seed of the initial weights.
        updates: Budget.
        place: Folder for its progress.

    Returns:
        "model", "seed", "updates", "parameters", "log" (updates, seconds, valid_error), and the normalized MSE
        of the best checkpoint, "valid" and "test", beside those of predicting the mean.
    """
    dataset = open_study_data(study.data, study.seeds.data)
    task = study_task(study, dataset.scene)
    problem = load_problem(study, dataset, task)
    training = study.training.model_copy(update={"updates": updates})
    folder = TrialFolder(place)
    trial = Trial(
        stage="train", parameters=hyperparameters(study)[model], init_seed=seed, data_seed=study.seeds.data,
        provenance=provenance(study, dataset),
    )  # fmt: skip
    entries = run_trial(problem, trial, study.configuration._replace(training=training), folder)
    for _ in track(entries, f"{model}, seed {seed}", total=updates // training.evaluate_every):
        pass
    best = load_model(folder.checkpoint)
    samples = {"valid": problem.valid_samples, "test": study_samples(study, dataset, "test", task)}
    objective = problem.objective
    errors = {split: objective.error(best, each) for split, each in samples.items()}
    mean = {split: objective.of_mean_predictor(each, problem.train_samples) for split, each in samples.items()}
    log = [{key: entry[key] for key in ("updates", "seconds", "valid_error")} for entry in folder.read().log]
    facts = {"model": model, "seed": seed, "updates": updates, "num_parameters": best.num_parameters, "log": log}
    return facts | errors | {"mean_predictor": mean}


def table(results: list[Mapping]) -> pd.DataFrame:
    """Mean errors over seeds, a row for each model and budget."""
    rows = pd.DataFrame([{key: each[key] for key in ("model", "updates", "seed", "valid", "test")} for each in results])
    groups = rows.groupby(["model", "updates"])
    spread = groups["test"].agg(["min", "max"]).add_prefix("test_")
    return groups[["valid", "test"]].mean().join([spread, groups["seed"].count().rename("seeds")]).reset_index()


def chart(results: list[Mapping]) -> Figure:
    """Validation error against updates and against training seconds, a line for each training."""
    facts = [{"name": each["model"], "seed": each["seed"], "retrained": True, "log": each["log"]} for each in results]
    curves = pd.DataFrame([{**fact, **entry} for fact in facts for entry in fact["log"]])
    return budget_chart(curves, list(dict.fromkeys(each["model"] for each in results)), NormalizedMSE.label)


def main() -> None:
    """Train what was asked for; without trainings, sum up."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trainings", nargs="*", metavar="MODEL:SEED")
    parser.add_argument("--data", help="folder of the DPI dam break")
    parser.add_argument("--updates", type=int, default=6000)
    parser.add_argument("--runs", type=Path, default=Path("runs/converged"), help="folder for what is being trained")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # so that several trainings may run side by side
    for name in arguments.trainings:
        model, seed = name.split(":")
        file = f"{model}_{arguments.updates}_seed_{int(seed)}"
        if not (RESULTS / f"{file}.json").exists():
            study = with_data_path(load_study(STUDY, []), arguments.data)
            found = train(study, model, int(seed), arguments.updates, arguments.runs / file)
            write_json(RESULTS / f"{file}.json", found)
            print(f"{file}: validation {found['valid']:.4g}, test {found['test']:.4g}")
    if not arguments.trainings:
        results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*_seed_*.json"))]
        print(table(results).to_string(index=False, float_format=lambda value: f"{value:.4g}"))
        chart(results).savefig(RESULTS / "curves.png", dpi=90)


if __name__ == "__main__":
    main()
