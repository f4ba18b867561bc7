"""`cconv train`, `cconv fit`, `cconv evaluate`, `cconv report`: one model, and the report of a run."""

import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cconv.cli.console import errors, print_findings, print_json, results, show_progress
from cconv.cli.live import TrainingBar
from cconv.cli.options import Force, FrameDt, Mass, Spacing, check_new, given_facts
from cconv.cli.study import DataPath, Device, Log, RunPath, Settings, StudyFile, declared_study
from cconv.errors import CConvError, ConfigError, DataError
from cconv.validation import Horizon, check_setting

if TYPE_CHECKING:
    from cconv.data.dataset import Dataset
    from cconv.data.trajectory import Scene
    from cconv.evaluation.objectives import Objective
    from cconv.models.model import Model, ModelConfig
    from cconv.study.declared.study_file import StudyConfig
    from cconv.study.running.problem import Problem

ModelDevice = Annotated[
    str,
    typer.Option(
        metavar="DEVICE",
        help="Where to compute: auto (the first NVIDIA GPU, or else the CPU), cpu, cuda, cuda:N or mps.",
    ),
]
TRAINED_AT = (
    ("particle_spacing", "particle spacing", 1e-6),
    ("frame_dt", "time between frames", 0.01),
)  # with tolerance


def train(
    study: StudyFile,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write; it must not exist yet.")],
    data: DataPath = None,
    log: Log = None,
    device: Device = None,
    settings: Settings = None,
) -> None:
    """Train the network of a study file, without a search.

    The tables task, network and training of the file describe the training; without a table network, the published
    ConvNet is trained. The checkpoint with the smallest validation error is in DIR/checkpoint, also after Ctrl-C.
    """
    from cconv.study.records.trials import TrialFolder
    from cconv.study.running.problem import provenance
    from cconv.study.running.trial import Trial, run_trial

    config = declared_study(study, data, settings, log, device)
    check_new(out)
    problem, dataset = _loaded_problem(config)
    folder = TrialFolder(out)
    seeds = {"init_seed": config.seeds.init, "data_seed": config.seeds.data}
    origin = provenance(config, dataset)
    trial = Trial(stage="train", parameters={}, provenance=origin, loggers=config.log, **seeds)
    try:
        with TrainingBar(errors, config.name) as bar:
            entries = list(run_trial(problem, trial, config.configuration, folder, on_update=bar.on_update))
    except CConvError:
        shutil.rmtree(out, ignore_errors=True)
        raise
    except KeyboardInterrupt:
        folder.finish("interrupted")
        errors.print(f"Interrupted; the best checkpoint so far is {folder.checkpoint}.", soft_wrap=True)
        raise
    if entries[-1]["diverged"]:
        folder.finish("diverged")
        errors.print(f"Diverged at update {entries[-1]['updates']}: a loss is not finite; lower the learning rate.")
        raise typer.Exit(1)
    folder.finish("completed")
    best = min(entry["valid_error"] for entry in entries)
    figures = f"{best:.4g} ({problem.objective.label})"
    results.print(f"Best validation error {figures}. Checkpoint: {folder.checkpoint}", soft_wrap=True)


def fit(
    study: StudyFile,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Checkpoint to write; it must not exist yet.")],
    data: DataPath = None,
    ridge: Annotated[
        float,
        typer.Option(
            help="Weight of the penalty on squared coefficients, relative to the mean square of a term of the layer."
        ),
    ] = 1e-10,
    device: Device = None,
    settings: Settings = None,
) -> None:
    """Fit a single layer to the data of a study by least squares, in seconds and without training.

    The table network of the file describes the layer, as in experiments/closed_form.toml: layers = 1, architecture =
    "radial_net" or "conv_net", message, relative_cutoff, window. The checkpoint evaluates like a trained one
    (`cconv evaluate DIR`).
    """
    from cconv.devices import home_of, name_of
    from cconv.models.checkpoint import save_model
    from cconv.study.declared.configuration import check_least_squares
    from cconv.study.declared.stage import Ridge
    from cconv.study.running.problem import device_of, provenance

    check_setting(Ridge, ridge, "--ridge")
    config = declared_study(study, data, settings, device=device)
    check_new(out)
    check_least_squares(config.training.loss, "a single layer")
    problem, dataset = _loaded_problem(config)
    placed = home_of(device_of(config))  # float64 is needed
    model = problem.build_model(config.configuration, config.seeds.init).to(placed)
    places = show_progress(range(len(problem.train_samples)), "fit")
    problem.solve_closed_form(model, config.training, places, ridge, config.seeds.data)
    error = problem.objective.error(model, show_progress(problem.valid_samples, "validate"))
    card = {
        "stage": "closed_form",
        "features": list(model.config.features),
        "network": config.network.model_dump(),
        "ridge": ridge,
        "data_seed": config.seeds.data,
        "device": name_of(placed),
        "num_parameters": model.num_parameters,
        "valid_error": error,
    }
    save_model(model, out, card | provenance(config, dataset))
    figures = f"{error:.4g} ({problem.objective.label}), {model.num_parameters:,} parameters"
    results.print(f"Validation error {figures}. Checkpoint: {out}", soft_wrap=True)


def evaluate(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            metavar="CHECKPOINT",
            help="Checkpoint folder, e.g. runs/quick/finalists/baseline/seed_1/checkpoint, or a run folder: its "
            "recommended model.",
        ),
    ],
    data: DataPath = None,
    split: Annotated[str, typer.Option(help="Split to evaluate: train, valid or test.")] = "test",
    horizon: Annotated[
        int | None, typer.Option(help="Frames of each rollout of a step model; by default as in its study.")
    ] = None,
    task: Annotated[
        str | None, typer.Option(help="Required task of the model; an error if the model is for another.")
    ] = None,
    mass: Mass = None,
    particle_spacing: Spacing = None,
    frame_dt: FrameDt = None,
    force: Force = None,
    device: ModelDevice = "auto",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Report the error of a saved model on a split of a data set, by default the test split.

    A model works at any resolution, because it computes in particle spacings, rest densities and frame intervals.
    Masses, spacing and time step are read from the data or given here. Those in the checkpoint are only used for the
    data that it was trained on.
    """
    from cconv.data.plausibility import dataset_findings
    from cconv.devices import find_device, name_of
    from cconv.evaluation.objectives import objective_of
    from cconv.models.checkpoint import load_model, read_card
    from cconv.study.running.problem import open_card_data
    from cconv.tasks.samples import HORIZON, compared_samples
    from cconv.tasks.task import StepTask

    if horizon is not None:
        check_setting(Horizon, horizon, "--horizon")
    checkpoint = recommended_checkpoint(checkpoint)
    model, card = load_model(checkpoint, task, find_device(device)), read_card(checkpoint)
    if horizon is not None and not isinstance(model.task, StepTask):
        raise ConfigError(f"`--horizon` is for steps, and {model.task.name!r} is a field of one frame; leave it out.")
    given = given_facts(mass, particle_spacing, frame_dt, force)
    dataset, is_own = open_card_data(card, data, given)
    rolled = horizon or card.get("horizon") or HORIZON
    windows = replace(model.task, history=card.get("window") or model.task.history)  # as its study compared models

    def samples(split: str, verb: str) -> Sequence:
        label = f"{verb} {split}"
        return compared_samples(dataset, split, windows, rolled, lambda numbers: show_progress(numbers, label))

    asked, objective = samples(split, "read"), objective_of(model.task)
    training = samples("train", "read") if is_own and split != "train" else asked if is_own else None
    facts = {
        "checkpoint": str(checkpoint),
        "data": str(dataset.path),
        "task": model.config.task,
        "split": split,
        "frames": len(asked),
        "objective": objective.name,
        **_errors_by(objective, model, asked, training, show_progress(asked, f"evaluate {split}")),
        "num_parameters": model.num_parameters,
        "device": name_of(model.device),
        "relaxation": None if model.config.relaxation is None else model.config.relaxation.model_dump(),
        **scale_facts(dataset.scene, model.config),
    }
    if not math.isfinite(facts[objective.name]):
        raise ConfigError(f"{checkpoint}: its predictions on the {split} split are not finite; train the model again.")
    if not is_own:
        print_findings(dataset_findings(dataset, show_progress, [split]))
    if as_json:
        print_json(facts)
        return
    _print_evaluation(facts, objective)


def _errors_by(
    objective: "Objective", model: "Model", samples: Sequence, training: Sequence | None, progress: Iterable
) -> dict:
    """Errors of a model on samples, and of predicting the mean of the training split if that is known, by their names.

    Args:
        objective: The error of the model's task.
        model: The model.
        samples: The samples.
        training: Samples of the training split, or None.
        progress: The samples once more, whose reading shows the progress.
    """
    table = objective.table(model, progress, len(samples))
    mean = None if training is None else objective.of_mean_predictor(samples, training)
    return {
        objective.name: table.error,
        f"own_{objective.name}": objective.own_error(table.error, model, samples),
        f"mean_predictor_{objective.name}": mean,
        **{_key(measure): value for measure, value in table.measures.items()},
    }


def _key(measure: str) -> str:
    """Return the name of a measure in JSON."""
    return re.sub(r"\W", "_", measure.lower())


def _print_evaluation(facts: Mapping, objective: "Objective") -> None:
    """Print the error, the error relative to the variance of these data if it differs, and the mean predictor's."""
    error, own, mean = (facts[f"{prefix}{objective.name}"] for prefix in ("", "own_", "mean_predictor_"))
    beside = [(name, facts[_key(name)]) for name in objective.measures][:1]
    figures = [f"{objective.label} {error:.6g}"]
    figures += [f"{name} {value:.4g}" for name, value in beside if value is not None]
    lines = [
        f"{facts['split']}: {', '.join(figures)} over {facts['frames']} frames "
        f"({facts['task']}, {facts['num_parameters']:,} parameters)"
    ]
    if facts["relaxation"] is not None:
        lines.append(relaxation_words(facts["relaxation"], "Rollouts with relaxation: "))
    if own is not None and not math.isclose(own, error, rel_tol=0.005):
        lines.append(f"By the variance of these data instead of the training split's: {own:.6g}")
    if mean is not None:
        lines.append(f"Predicting the mean of the training split here: {mean:.4g}")
    for what, found, trained in other_scales(facts):
        lines.append(f"{what.capitalize()} {found:g}; the model was trained at {trained:g}")
    for line in lines:
        results.print(line, soft_wrap=True)


def other_scales(facts: Mapping) -> Iterator[tuple[str, float, float]]:
    """Yield each scale of the data that differs from the training data's: its name, and both values.

    Args:
        facts: Each scale of `TRAINED_AT`, of the data and, as "trained_at_...", of the model, None if it is not known.
    """
    for name, what, tolerance in TRAINED_AT:
        found, trained = facts[name], facts[f"trained_at_{name}"]
        if trained is not None and not math.isclose(found, trained, rel_tol=tolerance):
            yield what, found, trained


def relaxation_words(relaxation: Mapping | None, lead: str) -> str:
    """Say which relaxation was applied, after a lead; nothing if none was."""
    if relaxation is None:
        return ""
    return f"{lead}alpha {relaxation['alpha']:g}, beta {relaxation['beta']:g}, loops {relaxation['loops']}"


def scale_facts(scene: "Scene", config: "ModelConfig") -> dict[str, float | None]:
    """Give the scales of data and of a model as `other_scales` compares them."""
    found = {name: getattr(scene, name) for name, *_ in TRAINED_AT}
    return found | {f"trained_at_{name}": getattr(config, name) for name, *_ in TRAINED_AT}


def recommended_checkpoint(path: Path) -> Path:
    """Return the checkpoint of the recommended model of a run folder; another folder as it is.

    Raises:
        ConfigError: If the run has not recommended a model.
        DataError: If its records are damaged.
    """
    from cconv.study.records.run_folder import RunFolder

    if not (path / "study.json").is_file():
        return path
    run = RunFolder.open(path)
    if not run.has_summary:
        raise ConfigError(
            f"{path}: the run has not recommended a model yet; continue it (`cconv study resume`), or name a "
            "checkpoint in it."
        )
    return path / run.summary().offered_checkpoint


def report(
    path: RunPath,
    tables: Annotated[
        Path | None,
        typer.Option(
            "--tables",
            metavar="DIR",
            help="Folder to write tables to: trials, curves, finalists and others as CSV, and as Parquet where pyarrow "
            "is installed.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace older tables in DIR.")] = False,
) -> None:
    """Write report.html of a run again, also for an interrupted run; with --tables also its records as tables."""
    from jinja2 import TemplateError

    from cconv.report.page import write_report
    from cconv.report.table_files import write_tables
    from cconv.study.records.run_folder import RunFolder
    from cconv.study.studies import recorded_space, recorded_study

    run = RunFolder.open(path)
    recorded_study(run), recorded_space(run)  # checks them, because the page may show every key
    try:
        written = write_report(run)
        files = [] if tables is None else write_tables(run, tables, overwrite)
    except CConvError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, TemplateError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise DataError(
            f"{path}: summary.json or another record lacks what the report shows, or holds something else there "
            f"({reason}); restore it, or run the study again."
        ) from error
    results.print(f"Report: {written}", soft_wrap=True)
    if files:
        results.print(f"Tables: {len(files)} files in {tables}", soft_wrap=True)


def _loaded_problem(config: "StudyConfig") -> tuple["Problem", "Dataset"]:
    """Return the samples of a study, with its predictor if it has one, and its data."""
    from cconv.data.plausibility import dataset_findings
    from cconv.study.running.predictor import with_predictor
    from cconv.study.running.problem import load_problem, open_study_data, study_task

    dataset = open_study_data(config.data, config.seeds.data)
    print_findings(dataset_findings(dataset, show_progress))
    problem = load_problem(config, dataset, study_task(config, dataset.scene), show_progress)
    return with_predictor(problem, config, progress=show_progress), dataset
