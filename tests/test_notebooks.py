"""Notebooks run from top to bottom on the committed run, and are committed without outputs."""

import shutil
from pathlib import Path

import nbformat
import numpy as np
import pytest
from matplotlib.figure import Figure
from nbclient import NotebookClient
from processes import PATIENCE
from summaries import explanation, rollouts, whole_summary

from cconv.study.records.rollouts import write_rollouts
from cconv.study.records.run_folder import RunFolder

ANALYSIS = Path(__file__).parents[1] / "analysis"
NOTEBOOKS = sorted(ANALYSIS.glob("*.ipynb"))
LOADED = "import sys; print(sorted({'ray', 'torch'} & set(sys.modules)))"


def execute(path):
    """Outputs of a notebook and the large packages that it loaded."""
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(LOADED))
    NotebookClient(notebook, timeout=PATIENCE, resources={"metadata": {"path": str(ANALYSIS)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return outputs[:-1], outputs[-1]["text"].strip()


def kinds(outputs):
    return [kind for output in outputs for kind in output.get("data", {})]


def code_cells(path):
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]


@pytest.fixture
def whole_run(tmp_path):
    """A copy of the committed run with everything that can be recorded."""
    run = RunFolder(shutil.copytree(ANALYSIS / "sample_run", tmp_path / "run"))
    summary = whole_summary(run.summary())
    run.write_summary(summary)
    for model in summary.explained:
        np.savez(run.path / "explanation" / f"{model}.npz", **explanation())
    for model in summary.rolled:
        write_rollouts(run, model, rollouts(ended="diverged: particles clumped"))
    return run


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_shows_charts_and_tables(path, monkeypatch):
    monkeypatch.delenv("CCONV_RUN", raising=False)
    outputs, loaded = execute(path)
    assert ("image/png" in kinds(outputs)) == (path.stem != "rollouts")  # of which a study of a field has none
    assert "text/html" in kinds(outputs)
    assert loaded == "[]"


@pytest.mark.parametrize(
    ("name", "charts"),
    [("search", 4), ("importance", 4), ("finalists", 5), ("stability", 2), ("cost", 2), ("rollouts", 3)],
)
def test_a_notebook_shows_all_that_was_recorded(name, charts, whole_run, monkeypatch):
    """Its cells in this process, which starts no kernel and draws nothing."""
    displayed = []
    monkeypatch.setattr("IPython.display.display", lambda *objects: displayed.extend(objects))
    monkeypatch.setenv("CCONV_RUN", str(whole_run.path))
    names = {}
    for cell in code_cells(ANALYSIS / f"{name}.ipynb"):
        exec(cell.source.replace("%matplotlib inline", ""), names)
    assert sum(isinstance(each, Figure) for each in displayed) == charts


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stripped_and_thin(path):
    cells = code_cells(path)
    assert all(not cell.outputs and cell.execution_count is None for cell in cells)
    assert len(cells) <= 12
    assert not any("def " in cell.source for cell in cells)
