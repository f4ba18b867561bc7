"""What the command line prints: its version, and every foreign string as it is."""

import json
import os
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
from conftest import SCRIPT, SMOKE
from outcomes import assert_one_clear_line
from processes import PATIENCE
from rich.table import Table
from rich.text import Text

from cconv.cli.console import PlainConsole, plain_column
from cconv.cli.live import StudyDisplay, TrainingBar
from cconv.evaluation.objectives import OBJECTIVES, ErrorTable, Objective
from cconv.study.declared.configuration import TrainingConfig
from cconv.study.records.run_folder import FORMAT, RunFolder
from cconv.tasks.task import FieldTask

HOSTILE = "[/red][bold]x[/bold] :smile: \x1b[2J\x07 r[0-9]*"
SHOWN = r"[/red][bold]x[/bold] :smile: \x1b[2J\x07 r[0-9]*"


@pytest.fixture
def console(tmp_path):
    """A console on a terminal that is a file; gives it and what it has printed."""
    with (tmp_path / "terminal").open("w") as file:
        shown = PlainConsole(file=file, force_terminal=True, color_system=None, width=400, _environ={})

        def printed():
            file.flush()
            return (tmp_path / "terminal").read_text()

        yield shown, printed


def test_the_version_is_printed(cconv):
    assert cconv("--version") == (0, f"cconv {version('cconv')}\n", "")


@pytest.mark.integration
def test_the_package_runs_as_a_module():
    command = [sys.executable, "-m", "cconv", "--version"]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (finished.returncode, finished.stdout) == (0, f"cconv {version('cconv')}\n")


def test_the_commands_are_listed_with_what_they_are_for(cconv):
    status, out, _ = cconv("--help")
    assert status == 0
    assert "Find the smallest, fastest continuous-convolution network" in out
    assert all(command in out for command in ("train", "fit", "evaluate", "report", "data", "study", "--version"))


@pytest.mark.integration
def test_a_shell_is_told_how_to_complete_and_what(tmp_path):
    def run(*arguments, **variables):
        known = os.environ | {"HOME": str(tmp_path), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
        command = [SCRIPT, *arguments]
        return subprocess.run(command, env=known | variables, capture_output=True, text=True, timeout=PATIENCE)

    assert run("--install-completion", "bash").returncode == 0
    assert "_CCONV_COMPLETE" in (tmp_path / ".bash_completions" / "cconv.sh").read_text()
    asked = {"_CCONV_COMPLETE": "complete_bash", "COMP_WORDS": "cconv data ins", "COMP_CWORD": "2"}
    assert run(**asked).stdout.split() == ["inspect"]
    refused = run("--install-completion", "nosuch")
    assert_one_clear_line((refused.returncode, refused.stdout, refused.stderr), "nosuch")


def test_foreign_strings_are_printed_as_they_are(console):
    shown, printed = console
    shown.print(HOSTILE)
    assert printed() == f"{SHOWN}\n"


def test_foreign_strings_are_shown_as_they_are_in_tables(console):
    shown, printed = console
    table = Table(title=HOSTILE, caption=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    shown.print(table)
    assert printed().count(SHOWN) == 4


def test_a_style_is_asked_for_with_a_text(console):
    shown, printed = console
    shown.print(Text("bold", style="bold"), style="red")
    assert "bold" in printed()


def test_the_live_table_shows_foreign_strings_as_they_are(console):
    shown, printed = console
    with StudyDisplay(shown) as display:
        display.on_data([HOSTILE])
        display.on_stage(HOSTILE, 2, TrainingConfig(updates=10))
        display.on_trial_start(HOSTILE, {HOSTILE: HOSTILE})
        display.on_trial_end(HOSTILE, "failed", HOSTILE)
        shown.print(display._draw())
    assert printed().count(SHOWN) >= 7
    assert "\x1b[2J" not in printed()


def test_progress_shows_foreign_strings_as_they_are(console):
    shown, printed = console
    with TrainingBar(shown, "[/red]"):
        pass
    assert "[/red]" in printed()
    assert plain_column("{task.description}").markup is False


@pytest.mark.parametrize("name", ["[/red]", "\x1b[2J", "a\nb"])
def test_a_run_folder_with_hostile_strings_is_shown_or_refused(name, cconv, tmp_path):
    run = RunFolder(tmp_path)
    run.write("study.json", {"format": FORMAT, "stages": {"random": {"kind": "random"}}})
    run.write("state.json", {"state": "running", "stage": "random"})
    trial = run.trial("random_0000")
    known = {"stage": "random", "init_seed": 0, "num_parameters": 1, "flops_per_particle": 1.0}
    trial.start(known | {"parameters": {"window": "[/red]", name: 1}})
    trial.append({"updates": 1, "valid_error": 0.5, "seconds": 1.0})
    trial.finish("completed", name)
    status, out, error = cconv("study", "status", tmp_path)
    assert (status, error) == (0, "")
    assert "window=[/red]" in out
    assert "\x1b" not in out
    run.write("state.json", {"state": "running", "stage": name})
    assert_one_clear_line(cconv("study", "status", tmp_path), "state.json", "a name must match")


def test_no_option_takes_a_number_that_makes_no_sense(cconv, tmp_path):
    for ridge in ("nan", "inf", "-1", "1e300"):
        outcome = cconv("fit", tmp_path / "study.toml", "--out", tmp_path / "out", "--ridge", ridge)
        assert_one_clear_line(outcome, "`--ridge`")
    for trials in ("0", "-3", "1000000000", "9" * 5000, "true"):
        status, out, _ = cconv("study", "extend", tmp_path, "--stage", "random", "--trials", trials)
        assert (status, out) == (2, "")
    assert json.dumps([path.name for path in tmp_path.iterdir()]) == "[]"


class Largest(Objective):
    """An error of other tasks: it has no measure of fields, and none relative to the variance of the samples."""

    name, label, meaning = "largest", "largest error", "The largest error of a component."
    measures = {"step-20 error": "Not defined for a field.", "frame count": "Number of frames."}

    def error(self, model, samples, geometry=None):
        return 0.5

    def table(self, model, samples, frames_per_block):
        measures = {"step-20 error": None, "frame count": float(len([*samples]))}
        return ErrorTable(error=0.5, units=np.zeros(1), measures=measures)

    def own_error(self, error, model, samples):
        return None

    def in_words(self, error):
        return f"at most {error}"

    def of_mean_predictor(self, samples, train_samples):
        return 7.25


@pytest.fixture
def fitted(cconv, flow_folder, tmp_path):
    """Checkpoint of a single layer, fitted in a second."""
    layer = ("layers=1", "architecture=radial_net", "message=difference", "relative_cutoff=2.0")
    settings = [part for value in layer for part in ("--set", f"network.{value}")]
    assert cconv("fit", SMOKE, "--data", flow_folder, "--out", tmp_path / "one", *settings)[0] == 0
    return tmp_path / "one"


def test_a_model_is_evaluated_by_the_error_that_its_card_reports(cconv, fitted):
    status, out, _ = cconv("evaluate", fitted, "--split", "valid", "--json")
    facts, card = json.loads(out), json.loads((fitted / "card.json").read_text())
    assert (status, facts["objective"]) == (0, "normalized_mse")
    assert facts["normalized_mse"] == pytest.approx(card["valid_error"], rel=1e-6)
    assert facts["relative_rmse"] == pytest.approx(facts["normalized_mse"] ** 0.5)
    assert facts["per_frame_normalized_mse"] > 0
    assert facts["own_normalized_mse"] > 0
    assert facts["mean_predictor_normalized_mse"] > facts["normalized_mse"]
    status, out, _ = cconv("evaluate", fitted, "--split", "valid")
    figures = f"normalized MSE {facts['normalized_mse']:.6g}, relative RMSE {facts['relative_rmse']:.4g} over 4 frames "
    assert out.startswith(f"valid: {figures}(density_gradient, ")


def test_a_task_with_another_objective_is_evaluated_by_it(cconv, fitted, monkeypatch):
    monkeypatch.setitem(OBJECTIVES, "largest", Largest())
    monkeypatch.setattr(FieldTask, "objective", "largest")
    status, out, _ = cconv("evaluate", fitted, "--split", "valid", "--json")
    facts = json.loads(out)
    assert (status, facts["objective"]) == (0, "largest")
    assert (facts["step_20_error"], facts["frame_count"]) == (None, 4)
    assert (facts["largest"], facts["own_largest"], facts["mean_predictor_largest"]) == (0.5, None, 7.25)
    assert "normalized_mse" not in facts
    status, out, _ = cconv("evaluate", fitted, "--split", "valid")
    assert out.startswith("valid: largest error 0.5 over 4 frames (density_gradient, ")
    assert "Predicting the mean of the training split here: 7.25" in out
