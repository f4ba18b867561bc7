"""The pages of the documentation: their code blocks run as they stand, and every command is one that exists."""

import re
import runpy
import shlex
import shutil
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
import typer.main
from systems import untrained_step

import cconv
from cconv.cli import app
from cconv.models.checkpoint import save_model
from cconv.models.exported import export_model

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
READMES = [ROOT / "README.md", *sorted(ROOT.glob("experiments/**/README.md")), ROOT / "search_spaces" / "README.md"]
WITH_CODE = [page for page in PAGES if "```python" in page.read_text() and page.name != "python.md"]  # test_readme.py
TAKES_LONG = re.compile(r"cconv (study|report|evaluate RUN|data generate)")


def commands(page):
    """Lines of the blocks of a page that call `cconv`, without comments."""
    blocks = re.findall(r"^```\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.split(" #")[0].strip() for line in lines if line.startswith("cconv ")]


def parsed(arguments):
    """The context in which a command would run, after all of its arguments and options have been understood."""
    command, name, context = typer.main.get_command(app), "cconv", None
    while True:
        context = command.make_context(name, list(arguments), parent=context)
        if not hasattr(command, "resolve_command"):
            return context
        name, command, arguments = command.resolve_command(context, [*context._protected_args, *context.args])


@pytest.fixture
def working_folder(tmp_path, monkeypatch):
    """A working folder in which the study files and search spaces stand as in a clone."""
    for name in ("experiments", "search_spaces"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", [*PAGES, *READMES], ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_exists_with_its_options_and_study_file(page):
    for line in commands(page):
        context = parsed(shlex.split(line)[1:])
        study = context.params.get("study")
        assert study is None or Path(study).stem.isupper() or (ROOT / study).is_file(), line


def test_a_command_with_an_option_that_does_not_exist_is_found():
    with pytest.raises(typer.TyperException):
        parsed(["data", "inspect", "FOLDER", "--no-such-option"])


def check_other_program(names):
    """The program answers what analytic SPH does, and nothing is in the disc after any frame of the loop."""
    edges = cconv.radius_graph(torch.tensor(names["positions"]), 0.2, cconv.Box([0, 0], [1, 1], (True, True)))
    masses, velocities = torch.full((100,), 0.01, dtype=torch.float64), torch.tensor(names["velocities"])
    rates = cconv.sph.density_rate(masses, velocities, edges, cconv.sph.CubicSpline(0.1, 2))
    off = (names["rates"][:, 0].double() - rates).square().mean() / rates.var()
    assert off < 1e-2  # a layer of sixteen terms, fitted to other frames
    for positions in names["frames"][-5:]:
        assert np.linalg.norm(positions - 0.5, axis=1).min() >= 0.1 - 1e-6


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.stem)
def test_the_code_blocks_of_a_page_run(page, flow_folder, steps_folder, working_folder):
    text = page.read_text()
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    make = {
        "FOLDER": lambda path: path.symlink_to(flow_folder),
        "VORTICES": lambda path: path.symlink_to(steps_folder),
        "LAYER": lambda path: save_model(cconv.fit_closed_form(cconv.open_dataset(flow_folder)), path, {}),
        "STEP": lambda path: save_model(untrained_step(steps_folder), path, {}),
        "model.pt2": lambda path: export_model(cconv.fit_closed_form(cconv.open_dataset(flow_folder)), path),
    }
    for name, made in make.items():
        if f'"{name}"' in code:
            made(working_folder / name)
    names = {"__name__": page.stem}
    exec(compile(code, page.name, "exec"), names)
    expected = {"rates": (100, 1), "divergence": (100, 1), "answers": (50, 1)}
    assert all(names[name].shape == shape for name, shape in expected.items() if name in names)
    if "beyond_disc" in names:
        check_other_program(names)
    for written in ("MINE", "SQUARE"):
        if f'"{written}"' in code:
            assert list(cconv.open_dataset(written).splits) == ["train", "valid", "test"]


@pytest.mark.integration
def test_the_commands_of_the_tutorial_run_one_after_another(cconv, flow_folder, working_folder):
    (working_folder / "FOLDER").symlink_to(flow_folder)
    tried = [line for line in commands(DOCS / "tutorial.md") if not TAKES_LONG.match(line)]
    assert len(tried) == 5
    for line in tried:
        status, _, error = cconv(*shlex.split(line)[1:])
        assert status == 0, (line, error)
    assert {"CONVERTED", "LAYER", "frames.png", "flow.gif"} <= {path.name for path in working_folder.iterdir()}


@pytest.mark.integration
@pytest.mark.parametrize("page", ["tutorial.md", "howto/watch.md"])
def test_the_commands_on_a_finished_run_print_it(page, cconv, finished_run, working_folder):
    shutil.copytree(finished_run, working_folder / "RUN")
    tried = [line for line in commands(DOCS / page) if re.match("cconv (study status|report|evaluate RUN)", line)]
    assert tried
    for line in tried:
        status, out, error = cconv(*shlex.split(line)[1:])
        assert (status, bool(out)) == (0, True), (line, error)


def test_every_local_link_of_the_pages_leads_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("http") or (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_page_is_in_the_navigation():
    listed = {line.strip() for line in (DOCS / "index.md").read_text().splitlines()}
    assert {str(page.relative_to(DOCS).with_suffix("")) for page in PAGES} - {"index"} <= listed


def test_the_figures_of_the_concepts_are_drawn_from_the_sample_run(tmp_path):
    drawn = runpy.run_path(str(DOCS / "draw_figures.py"))["draw"](tmp_path)
    assert {path.stem for path in drawn} == {page.stem for page in (DOCS / "concepts").glob("*.md")}
    for path in drawn:
        committed = matplotlib.image.imread(DOCS / "figures" / path.name)
        assert matplotlib.image.imread(path).shape[:1] == committed.shape[:1]
