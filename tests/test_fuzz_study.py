"""Bad input of every kind that a person writes or a run folder holds: one clear line or success, never a traceback.

Valid files are changed at random: a value for a hostile one, a key, bytes. Each call of the command line ends with
status 0 or 2 within its limits of processor time and memory, and where it refuses, no run folder is left. What stays
valid does not start a study: loading is what is tried.
"""

import contextlib
import shutil
import tomllib
from unittest import mock

import pytest
import typer
from conftest import SMOKE
from fuzzing import changed_bytes, changed_json, changed_toml, check_call, examples, numbers, places, strings, values
from hypothesis import given
from hypothesis import strategies as st
from systems import configured, problem, untrained_step
from torch import Generator

from cconv.models.checkpoint import save_model
from cconv.study.declared.search_space import load_space
from cconv.study.pipeline import begin_study
from cconv.study.records.run_folder import RunFolder
from cconv.study.running.problem import provenance, with_data_path
from cconv.study.studies import load_study

pytestmark = pytest.mark.integration

REPOSITORY = SMOKE.parents[1]
STUDY = SMOKE.read_text()
SPACE = (REPOSITORY / "search_spaces" / "smoke.toml").read_text()
ENTRY = {"updates": 6, "train_loss": 1.0, "valid_error": 0.5, "learning_rate": 1e-3, "seconds": 1.0}


@st.composite
def overrides(draw):
    """What may follow `--set`."""
    paths = [".".join(map(str, path)) for path in places(tomllib.loads(STUDY)) if all(isinstance(k, str) for k in path)]
    key = draw(st.sampled_from([*paths, "stages.finalists.include.x", "a." * 5000, ""]) | st.text(max_size=6))
    value = draw(values.map(str) | st.text(max_size=8) | st.sampled_from(["[" * 5000, "1" * 5000, "0x" + "f" * 5000]))
    return draw(st.sampled_from([f"{key}={value}", key, f"{key}=\n{value}"])).replace("\x00", "")


@pytest.fixture(scope="module")
def material(tmp_path_factory, flow_folder, steps_folder):
    """A run folder with two trials, a checkpoint of a field and one of steps; all small."""
    folder = tmp_path_factory.mktemp("fuzz")
    study = with_data_path(load_study(SMOKE), str(flow_folder))
    run = RunFolder.create(folder / "run")
    begin_study(study, load_space(study.search.space, study), run)
    for number in range(2):
        trial = run.trial(f"random_000{number}")
        known = {"stage": "random", "parameters": {"kernel_size": 4}, "init_seed": 0, "num_parameters": 9}
        trial.start(known | {"flops_per_particle": 9.0})
        trial.append(ENTRY)
        trial.append(ENTRY | {"updates": 18})
        trial.finish("completed")
    run.write("rungs.json", {"random": [{"updates": 6, "recorded": {"random_0000": 0.5}}]})
    run.write("stages/random.json", {"kind": "random", "seconds": 1.0})
    given_problem = problem(Generator().manual_seed(0))
    model = given_problem.build_model(configured(layers=1, kernel_size=3, relative_cutoff=1.5), 0)
    save_model(model, folder / "checkpoint", provenance(study) | {"data_seed": 0})
    save_model(untrained_step(steps_folder), folder / "step", {"task": "acceleration", "data_seed": 0})
    return folder


@contextlib.contextmanager
def copied(material, name):
    """A copy of a folder of the material, gone afterwards; nothing else may have appeared beside it."""
    place = material / "work"
    shutil.copytree(material / name, place / name)
    try:
        yield place / name
        assert [path.name for path in place.iterdir()] == [name]
    finally:
        shutil.rmtree(place)


def run_up_to_the_start(material, *arguments):
    """`cconv study run`, which ends with success where it would begin."""
    out = material / "out"
    try:
        with mock.patch("cconv.study.pipeline.begin_study", side_effect=typer.Exit(0)):
            status = check_call("study", "run", *arguments, "--out", out)
        assert status == 0 or not out.exists()
    finally:
        shutil.rmtree(out, ignore_errors=True)


def try_study_file(material, flow_folder, content):
    path = material / "study.toml"
    path.write_bytes(content.replace(b"../search_spaces", str(REPOSITORY / "search_spaces").encode()))
    run_up_to_the_start(material, path, "--data", flow_folder)


def try_space(material, flow_folder, content):
    path = material / "space.toml"
    path.write_bytes(content)
    run_up_to_the_start(material, SMOKE, "--data", flow_folder, "--set", f"search.space={path}")


def try_override(material, flow_folder, override):
    run_up_to_the_start(material, SMOKE, "--data", flow_folder, "--set", override)


RECORDS = (
    "study.json", "space.json", "state.json", "rungs.json", "stages/random.json",
    *(f"trials/random_0000/{name}" for name in ("config.json", "outcome.json", "log.jsonl")),
)  # fmt: skip
COMMANDS = (
    ("study", "status"),
    ("study", "extend", "--stage", "random", "--trials", "1"),
    ("evaluate",),
    ("rollout",),
    ("report",),
)
OPTIONS = {
    "evaluate": ("--split", "--horizon", "--task", "--mass", "--particle-spacing", "--frame-dt", "--force"),
    "rollout": ("--split", "--trajectory", "--start", "--frames", "--mass", "--particle-spacing", "--frame-dt"),
}


def changed_record(data, folder):
    """Change a record of a folder."""
    name = data.draw(st.sampled_from([name for name in RECORDS if (folder / name).is_file()]))
    text = (folder / name).read_text()
    if not name.endswith(".jsonl"):
        return name, data.draw(changed_json(text))
    first, *others = text.splitlines()
    changed_line = changed_json(first).map(lambda line: b"\n".join([line, *map(str.encode, others), b""]))
    return name, data.draw(changed_line)


def try_record(material, data, commands=COMMANDS):
    name, content = changed_record(data, material / "run")
    command = data.draw(st.sampled_from(commands))
    with copied(material, "run") as run:
        (run / name).write_bytes(content)
        with mock.patch("cconv.cli.study._run_stages"):
            check_call(*command, run)


def try_checkpoint(material, flow_folder, data):
    name = data.draw(st.sampled_from(["config.json", "card.json", "model.safetensors"]))
    content = (material / "checkpoint" / name).read_bytes()
    change = changed_bytes(content) if name.endswith("tensors") else changed_json(content.decode())
    with copied(material, "checkpoint") as checkpoint:
        (checkpoint / name).write_bytes(data.draw(change))
        check_call("evaluate", checkpoint, "--data", flow_folder, "--split", "valid", "--json")


def try_step(material, steps_folder, data):
    """A changed checkpoint of steps, rolled out; it may diverge."""
    name = data.draw(st.sampled_from(["config.json", "card.json"]))
    content = (material / "step" / name).read_text()
    with copied(material, "step") as checkpoint:
        (checkpoint / name).write_bytes(data.draw(changed_json(content)))
        check_call("rollout", checkpoint, "--data", steps_folder, "--frames", 2, "--json", statuses=(0, 1, 2))


def try_options(material, steps_folder, data):
    """Options of commands on a checkpoint of steps, with values that may be anything."""
    command = data.draw(st.sampled_from(tuple(OPTIONS)))
    names = data.draw(st.lists(st.sampled_from(OPTIONS[command]), min_size=1, max_size=2, unique=True))
    given = [f"{name}={data.draw(numbers.map(str) | strings)}".replace("\x00", "") for name in names]
    out = ["--out", material / "out"] if command == "rollout" else []
    try:
        call = (command, material / "step", "--data", steps_folder, "--json", *out, *given)
        refused = check_call(*call, statuses=(0, 1, 2)) == 2
        assert not (refused and (material / "out").exists())
    finally:
        shutil.rmtree(material / "out", ignore_errors=True)


@examples(40)
@given(content=changed_toml(STUDY))
def test_a_changed_study_file_loads_or_is_refused_in_one_line(material, flow_folder, content):
    try_study_file(material, flow_folder, content)


@examples(30)
@given(content=changed_toml(SPACE))
def test_a_changed_space_loads_or_is_refused_in_one_line(material, flow_folder, content):
    try_space(material, flow_folder, content)


@examples(30)
@given(override=overrides())
def test_any_setting_is_taken_or_refused_in_one_line(material, flow_folder, override):
    try_override(material, flow_folder, override)


@examples(30)
@given(data=st.data())
def test_a_changed_record_is_read_or_refused_in_one_line(material, data):
    try_record(material, data, COMMANDS[:-1])


@examples(5)
@given(data=st.data())
def test_a_report_of_changed_records_is_written_or_refused_in_one_line(material, data):
    try_record(material, data, COMMANDS[-1:])


@examples(20)
@given(data=st.data())
def test_a_changed_checkpoint_evaluates_or_is_refused_in_one_line(material, flow_folder, data):
    try_checkpoint(material, flow_folder, data)


@examples(10)
@given(data=st.data())
def test_a_changed_step_is_rolled_out_or_refused_in_one_line(material, steps_folder, data):
    try_step(material, steps_folder, data)


@examples(10)
@given(data=st.data())
def test_any_option_of_a_checkpoint_is_taken_or_refused_in_one_line(material, steps_folder, data):
    try_options(material, steps_folder, data)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@examples(300)
@given(content=changed_toml(STUDY))
def test_hundreds_of_study_files(material, flow_folder, content):
    try_study_file(material, flow_folder, content)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@examples(200)
@given(content=changed_toml(SPACE))
def test_hundreds_of_spaces(material, flow_folder, content):
    try_space(material, flow_folder, content)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@examples(200)
@given(override=overrides())
def test_hundreds_of_settings(material, flow_folder, override):
    try_override(material, flow_folder, override)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@examples(200)
@given(data=st.data())
def test_hundreds_of_records(material, data):
    try_record(material, data)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@examples(100)
@given(data=st.data())
def test_a_hundred_checkpoints(material, flow_folder, data):
    try_checkpoint(material, flow_folder, data)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@examples(100)
@given(data=st.data())
def test_a_hundred_steps(material, steps_folder, data):
    try_step(material, steps_folder, data)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@examples(200)
@given(data=st.data())
def test_hundreds_of_options(material, steps_folder, data):
    try_options(material, steps_folder, data)
