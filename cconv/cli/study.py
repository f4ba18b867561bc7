"""`cconv study`: run a study, continue it, add trials, show its state, compare several."""

import math
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from cconv.cli.console import errors, print_json, results, show_progress
from cconv.cli.live import StudyDisplay
from cconv.errors import CConvError, ConfigError

if TYPE_CHECKING:
    import pandas as pd

    from cconv.study.declared.study_file import StudyConfig
    from cconv.study.records.run_folder import RunFolder
    from cconv.study.records.summary import Summary

# Commands import what they run inside, as torch and ray take seconds to load and `--help` should not.

app = typer.Typer(
    help="Search for the smallest, fastest network that is accurate enough, and report it.", no_args_is_help=True
)

StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="Study file (TOML), e.g. experiments/dpi_density_rate.toml.")
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, e.g. runs/quick.")]
DataPath = Annotated[
    str | None, typer.Option("--data", metavar="DIR", help="Folder of the particle data; replaces data.path.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Replace a setting of the study file, e.g. training.updates=200. Repeatable."
    ),
]


Device = Annotated[
    str | None,
    typer.Option(
        metavar="DEVICE",
        help="Where to compute: auto (the first NVIDIA GPU, or else the CPU), cpu, cuda, cuda:N or mps; replaces "
        "training.device.",
    ),
]
Address = Annotated[
    str | None,
    typer.Option(
        "--address",
        metavar="HOST:PORT",
        help="Train on the Ray cluster there ('auto' for one on this machine); the run folder must be on storage that "
        "all nodes share. By default a private Ray uses the cores of this machine.",
    ),
]
Storage = Annotated[
    str | None,
    typer.Option(
        "--storage",
        metavar="URL",
        help="Database of the Optuna study, e.g. postgresql+psycopg://USER@HOST/DATABASE; by default a journal file in "
        "the run folder.",
    ),
]
Serial = Annotated[
    bool,
    typer.Option("--serial", help="Train one configuration after another in this process, without Ray."),
]


Log = Annotated[
    list[str] | None,
    typer.Option(
        "--log",
        metavar="mlflow|wandb",
        help="Log trainings for this program too, offline; replaces `log` of the study file. Repeatable.",
    ),
]


def declared_study(
    study: Path,
    data: str | None = None,
    settings: list[str] | None = None,
    log: list[str] | None = None,
    device: str | None = None,
) -> "StudyConfig":
    """The study of a file with what the options of a command replace in it, on a device that this machine has."""
    from cconv.study.running.problem import device_of, with_data_path, with_device
    from cconv.study.running.training_logs import with_loggers
    from cconv.study.studies import load_study

    config = load_study(study, settings or [])
    config = with_loggers(config, config.log if log is None else log)
    if data is not None:
        config = with_data_path(config, data)
    if device is not None:
        config = with_device(config, device)
    device_of(config)
    return config


@app.command()
def run(
    study: StudyFile,
    data: DataPath = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Run folder to write; by default runs/NAME with the name of the study."
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an older run in the folder.")] = False,
    address: Address = None,
    serial: Serial = False,
    storage: Storage = None,
    log: Log = None,
    device: Device = None,
    settings: Settings = None,
) -> None:
    """Run a whole study: every stage that its file declares, then the report.

    Trials run in parallel, one on each core, and stop early by ASHA; with --serial they run one after another, without
    Ray. The best configurations and the baseline are retrained with fresh seeds, timed in turn, and tested on frames
    that no stage has seen. Ctrl-C stops cleanly: records stay readable (`cconv study status`, `cconv report`), and
    `cconv study resume` continues, also after a kill. Watch it live: optuna-dashboard runs/STUDY/optuna.journal
    """
    from cconv.study.declared.search_space import study_space
    from cconv.study.pipeline import begin_study
    from cconv.study.records.run_folder import RunFolder
    from cconv.study.running.problem import open_study_data

    _check_place(address, serial)
    config = declared_study(study, data, settings, log, device)
    config.check_stages()
    space = study_space(config)
    open_study_data(config.data, config.seeds.data)
    folder = RunFolder.create(out or Path("runs") / config.name, overwrite)
    begin_study(config, space, folder)
    try:
        _run_stages(folder, address, storage, serial)
    except CConvError:
        if not folder.trials():
            folder.remove()  # nothing was trained, so the same command works once the input is corrected
        raise


@app.command()
def resume(
    path: RunPath,
    data: DataPath = None,
    address: Address = None,
    serial: Serial = False,
    storage: Storage = None,
    device: Device = None,
) -> None:
    """Continue a study that was interrupted or killed.

    Finished stages and finished trials are kept. Every other training continues from its last evaluation, and earlier
    decisions of ASHA are kept.
    """
    from cconv.study.pipeline import change_device, move_data
    from cconv.study.records.run_folder import RunFolder

    _check_place(address, serial)
    folder = RunFolder.open(path)
    if data is not None:
        move_data(folder, data)
    if device is not None:
        change_device(folder, device)
    _run_stages(folder, address, storage, serial)


@app.command()
def extend(
    path: RunPath,
    stage: Annotated[str, typer.Option("--stage", help="Search to extend: the name of its stage in the study file.")],
    trials: Annotated[int, typer.Option("--trials", min=1, max=100_000, help="Number of trials to add.")],
    address: Address = None,
    serial: Serial = False,
    storage: Storage = None,
    device: Device = None,
) -> None:
    """Add trials to a search of a study, then rerun the stages that read it; existing trainings are used again."""
    from cconv.study.pipeline import change_device, extend_study
    from cconv.study.records.run_folder import RunFolder

    _check_place(address, serial)
    folder = RunFolder.open(path)
    if device is not None:
        change_device(folder, device)
    extend_study(folder, stage, trials)
    _run_stages(folder, address, storage, serial)


def _check_place(address: str | None, serial: bool) -> None:
    if serial and address is not None:
        raise ConfigError("--serial trains in this process and --address on a cluster; give one of them.")


def _run_stages(folder: "RunFolder", address: str | None, storage: str | None, serial: bool) -> None:
    """Run the remaining stages of a study, write its report and print its answer."""
    from cconv.report.page import write_report
    from cconv.study.pipeline import run_study

    with StudyDisplay(errors) as display:
        try:
            summary = run_study(folder, display, show_progress, address=address, storage=storage, serial=serial)
        except KeyboardInterrupt:
            write_report(folder)
            errors.print(
                f"\nInterrupted; everything so far is in {folder.path}. Resume: cconv study resume {folder.path}",
                soft_wrap=True,
            )
            raise
    report = write_report(folder)
    if summary is not None:
        results.print(_finalists_table(summary))
        results.print(summary.recommended.reason)
        if summary.budget:
            results.print(summary.budget)
        results.print(f"Study finished in {summary.wall_seconds / 60:.1f} minutes.")
    results.print(f"Report: {report}", soft_wrap=True)


@app.command()
def status(
    path: RunPath, as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False
) -> None:
    """Show how far a study has come: its state, its trials by outcome, the best so far."""
    from cconv.study.records.run_folder import RunFolder
    from cconv.study.records.trials import count_outcomes

    folder = RunFolder.open(path)
    records = folder.trials()
    completed: list[dict] = [
        {"trial": record.id, "valid_error": record.final_error, "parameters": record.parameters}
        for record in records
        if record.final_error is not None
    ]
    best = min(completed, key=itemgetter("valid_error"), default=None)
    facts = {**folder.read("state.json"), "trials": count_outcomes(records), "best": best}
    if as_json:
        print_json(facts)
        return
    results.print(f"{path}: {facts['state']}, stage {facts['stage']}")
    for stage, counts in facts["trials"].items():
        results.print(f"{stage}: " + ", ".join(f"{number} {name}" for name, number in counts.items() if number))
    if best is not None:
        settings = " ".join(f"{key}={value}" for key, value in best["parameters"].items())
        results.print(f"best: {best['trial']}, validation error {best['valid_error']:.4g} ({settings})")


@app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders of finished studies.")],
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Also write the page to FILE.html.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE if it exists.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Compare what studies recommend: scene by scene the smallest sufficient model, its error, cost and inputs.

    Studies that ask the same of the same data as the first are compared by the ratio of their errors. Of studies of
    steps there is a scoreboard, too: every finalist, its errors, times and training, beside what others report.
    """
    from cconv.report.compared_runs import compared_runs
    from cconv.report.comparison import answers_table, differences_table, write_comparison
    from cconv.report.scoreboard import scores_table
    from cconv.study.records.run_folder import RunFolder

    if out is not None and out.suffix != ".html":
        raise ConfigError(f"`--out` must name an .html file, got {out}.")
    if out is not None and out.exists() and not overwrite:
        raise ConfigError(f"{out} exists; name another file, or give --overwrite.")
    compared = compared_runs([RunFolder.open(path) for path in runs])
    answers, differences, scores = answers_table(compared), differences_table(compared), scores_table(compared)
    if out is not None:
        write_comparison(compared, out)
    if as_json:
        tables = {"answers": answers, "differences": differences, "scores": scores}
        print_json({name: _records(table) for name, table in tables.items()})
        return
    results.print(_answers_table(answers))
    for row in differences.itertuples():
        interval = row.why_none or f"95 %: {row.ci95_low:.3g} to {row.ci95_high:.3g}"
        results.print(f"error of {row.study} ÷ {row.reference}: {row.ratio:.3g} ({interval})", soft_wrap=True)
    for data, rows in scores.groupby("data", sort=False):
        results.print(_scores_table(str(data), rows))
    if out is not None:
        results.print(f"Page: {out}", soft_wrap=True)


def _records(table: "pd.DataFrame") -> list[dict]:
    """The rows of a table for JSON; what is not known is null."""
    return table.astype(object).where(table.notna(), None).to_dict("records")


def _answers_table(answers: "pd.DataFrame") -> Table:
    from cconv.report.tables import error_interval

    table = Table(
        title="Recommended models: test error, ms per frame, the solver's frame as a multiple",
        title_justify="left",
        padding=(0, 0),
    )
    table.add_column("study", overflow="fold", min_width=16)
    for name in ("parameters", "error", "95 %", "ms", "solver ÷", "stable"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in answers.itertuples():
        table.add_row(
            row.study,
            f"{row.parameters:,}",
            f"{row.error:.3g}",
            "none" if math.isnan(row.ci95_low) else error_interval(row.ci95_low, row.ci95_high, digits=2),
            f"{row.ms_per_frame:.3g}",
            "–" if math.isnan(row.solver) else f"{row.solver:.2f}",
            "yes" if row.stable else "no",
        )
    return table


def _scores_table(data: str, scores: "pd.DataFrame") -> Table:
    """The networks of a scene, those that others report at the end."""
    table = Table(title=f"Scoreboard, {data}", title_justify="left", padding=(0, 0))
    table.add_column("network", overflow="fold", min_width=16)
    for name in ("parameters", "ms", "MSE5", f"MSE{scores['horizon'].iloc[0]}", "all frames", "updates", "CPU min"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in scores.itertuples():
        where = "" if row.source == "measured" else f", published ({row.source})"
        whole = _figure(row.mse) if math.isnan(row.ended) else f"ends at {row.ended:.0f}"
        figures = (row.ms, row.mse5, row.error)
        counts = [_count(row.parameters), *map(_figure, figures), whole, _count(row.updates), _figure(row.cpu_minutes)]
        table.add_row(f"{row.network}{where}", *counts)
    return table


def _figure(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"


def _count(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:,.0f}"


def _finalists_table(summary: "Summary") -> Table:
    from cconv.report.tables import error_interval

    table = Table(
        title=f"{summary.study}: test error ({summary.task.error}) and cost of the finalists",
        title_justify="left",
        padding=(0, 0),
    )
    table.add_column("model", overflow="fold")
    for name in ("error", "95 % interval", "ms per frame", "parameters", "stable"):
        table.add_column(name, justify="right", no_wrap=True)
    for entry in sorted(summary.finalists, key=lambda entry: entry.test.error):
        mark = " *" if entry.id == summary.recommended.id else ""
        table.add_row(
            entry.id + mark,
            f"{entry.test.error:.4g}",
            "none" if entry.test.ci95 is None else error_interval(*entry.test.ci95),
            f"{entry.cost.ms_per_frame:.2f}",
            f"{entry.num_parameters:,}",
            "yes" if entry.stability.stable else "no",
        )
    table.add_row("predicting the mean", f"{summary.mean_predictor.test:.4g}")
    if summary.analytic is not None:
        table.add_row("analytic SPH", "0", "", f"{summary.analytic.ms_per_frame:.2f}")
    return table
