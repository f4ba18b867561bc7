import json

import pytest
from conftest import SMOKE
from foreign_files import moving_lattice, write_series
from outcomes import assert_one_clear_line
from particle_files import record_frames, write_hdf5, write_parts

from cconv.data.dataset import open_dataset
from cconv.forces import ConstantForce

SMALL = ["--size", "small", "--trajectories", "3", "--frames", "4", "--particle-spacing", "0.125", "--workers", "1"]


def test_generated_set_can_be_inspected(cconv, tmp_path):
    status, out, _ = cconv("data", "generate", "taylor_green_2d", "--out", tmp_path / "a", *SMALL, "--seed", 5)
    assert status == 0
    assert "3 trajectories" in out
    status, out, _ = cconv("data", "inspect", tmp_path / "a")
    assert status == 0
    assert "taylor_green_2d" in out
    assert "nothing" in out


def test_inspect_prints_json_for_programs(cconv, tmp_path):
    write_parts(tmp_path / "a")
    status, out, _ = cconv("data", "inspect", tmp_path / "a", "--json", "--cutoff", 0.5, "--force", "0,-9.81,0")
    facts = json.loads(out)
    assert status == 0
    assert facts["force"] == {"name": "constant", "acceleration": [0.0, -9.81, 0.0]}
    assert facts["neighbors"]["cutoff"] == 0.5
    assert facts["format"] == "DeepLagrangianFluids"


def test_inspect_says_what_is_missing(cconv, tmp_path):
    write_parts(tmp_path / "a")
    _, out, _ = cconv("data", "inspect", tmp_path / "a")
    for topic in ("particle spacing:", "frame dt:", "force:", "masses:"):
        assert topic in out


def test_convert_keeps_what_was_given(cconv, tmp_path):
    for name in ("s1", "s2", "s3"):
        write_parts(tmp_path / "a", name=name, frames=record_frames(seed=ord(name[1])))
    given = ["--mass", 0.5, "--particle-spacing", 0.1, "--frame-dt", 0.02, "--force", "0,-1,0"]
    status, _, _ = cconv("data", "convert", tmp_path / "a", "--out", tmp_path / "b", *given)
    scene = open_dataset(tmp_path / "b").scene
    assert status == 0
    assert (scene.particle_spacing, scene.frame_dt, scene.force) == (0.1, 0.02, ConstantForce((0.0, -1.0, 0.0)))
    assert open_dataset(tmp_path / "b").trajectory("train", 0).masses.tolist() == [0.5] * 5


def test_show_writes_picture_animation_and_files_for_paraview(cconv, tmp_path, flow_folder):
    outputs = ["--out", tmp_path / "a.png", "--animate", tmp_path / "a.gif", "--vtk", tmp_path / "vtk"]
    status, out, _ = cconv("data", "show", flow_folder, *outputs, "--every", 2, "--frames", "0,3", "--color", "density")
    assert status == 0
    assert "Picture of 2 frames" in out
    assert "Animation of 2 frames" in out
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.gif", "a.png", "vtk"]
    assert len(list((tmp_path / "vtk").glob("*.vtu"))) == 2
    assert len(list((tmp_path / "vtk").glob("*.vtu.series"))) == 1


def test_show_names_the_picture_after_the_folder(cconv, tmp_path, flow_folder, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, _ = cconv("data", "show", flow_folder, "--split", "train")
    assert status == 0
    assert "Picture of 4 frames" in out
    assert [entry.name for entry in tmp_path.iterdir()] == ["flow.png"]


def test_show_draws_what_lacks_mass_and_spacing(cconv, tmp_path):
    write_parts(tmp_path / "a")
    given = ["--mass", 0.5, "--particle-spacing", 0.1, "--frame-dt", 0.5]
    status, _, _ = cconv("data", "show", tmp_path / "a", *given, "--color", "density", "--out", tmp_path / "a.png")
    assert status == 0
    assert (tmp_path / "a.png").stat().st_size > 0


def test_show_refuses_in_one_line_and_writes_nothing(cconv, tmp_path, flow_folder):
    outputs = ["--out", tmp_path / "a.png", "--animate", tmp_path / "a.gif", "--vtk", tmp_path / "vtk"]
    for wrong, *words in (
        (["--split", "tests"], "'tests'", "Did you mean 'test'"),
        (["--trajectory", 9], "trajectories", "got 9"),
        (["--frames", "0,4"], "frames", "from 0 to 3", "got 4"),
        (["--frames", "first"], "--frames", "'first'"),
        (["--color", "pressure"], "color", "speed, density, type", "'pressure'"),
        (["--every", 0], "--every", "got 0"),
        (["--out", tmp_path / "a.pdf"], "a.pdf", ".png"),
        (["--animate", tmp_path / "a.webm"], "a.webm", ".gif or .mp4"),
        (["--vtk", flow_folder], "not empty"),
    ):
        assert_one_clear_line(cconv("data", "show", flow_folder, *outputs, *wrong), *words)
    assert list(tmp_path.iterdir()) == []


def test_bad_data_ends_in_one_line(cconv, tmp_path):
    assert_one_clear_line(cconv("data", "inspect", tmp_path / "nowhere"), "nowhere", "does not exist")
    assert_one_clear_line(cconv("data", "inspect", tmp_path), "looked for")
    write_hdf5(tmp_path / "a")
    (tmp_path / "a" / "train.h5").write_bytes(b"")
    assert_one_clear_line(cconv("data", "inspect", tmp_path / "a", "--json"), "train.h5", "is empty", "copy it again")
    assert_one_clear_line(cconv("data", "convert", tmp_path / "a", "--out", tmp_path / "b"), "train.h5")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a"]


def test_bad_settings_end_in_one_line(cconv, tmp_path):
    write_parts(tmp_path / "a")
    assert_one_clear_line(cconv("data", "inspect", tmp_path / "a", "--force", "down"), "--force", "'down'")
    assert_one_clear_line(cconv("data", "inspect", tmp_path / "a", "--force", "0,-1"), "force", "axis (3)")
    assert_one_clear_line(cconv("data", "inspect", tmp_path / "a", "--mass", "-1"), "mass", "positive")
    outcome = cconv("data", "generate", "taylor_green_2d", "--out", tmp_path / "b", "--trajectories", 2)
    assert_one_clear_line(outcome, "num_trajectories")
    outcome = cconv("data", "generate", "taylor_green_2d", "--out", tmp_path / "b", "--time-step", 1)
    assert_one_clear_line(outcome, "time_step", "speed of sound")
    outcome = cconv("data", "generate", "taylor_gren_2d", "--out", tmp_path / "b")
    assert_one_clear_line(outcome, "scene", "Did you mean 'taylor_green_2d'?")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a"]


def test_existing_folder_is_kept_unless_overwritten(cconv, tmp_path):
    command = ["data", "generate", "taylor_green_2d", "--out", tmp_path / "a", *SMALL]
    assert cconv(*command)[0] == 0
    before = open_dataset(tmp_path / "a").fingerprint()
    assert_one_clear_line(cconv(*command, "--seed", 1), "not empty", "overwrite")
    assert open_dataset(tmp_path / "a").fingerprint() == before
    assert cconv(*command, "--seed", 1, "--overwrite")[0] == 0
    assert open_dataset(tmp_path / "a").fingerprint() != before


def test_unknown_command_and_option_end_with_status_2(cconv, tmp_path):
    for arguments in (["dta"], ["data", "inspekt"], ["data", "inspect"], ["data", "inspect", tmp_path, "--yaml"]):
        status, out, error = cconv(*arguments)
        assert status == 2
        assert "Traceback" not in error


def test_scenes_are_listed_with_what_they_have(cconv):
    status, out, _ = cconv("data", "scenes")
    assert status == 0
    assert "lid_driven_cavity_3d" in out
    facts = json.loads(cconv("data", "scenes", "--json")[1])
    dam = next(fact for fact in facts if fact["scene"] == "dam_break_2d")
    assert dam["features"]["free_surface"]
    assert dam["sizes"]["published"]["frames"] == 401


def test_interruption_ends_with_status_130_and_leaves_no_data_set(cconv, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("cconv.sph.solver.WeaklyCompressibleSPH.step", interrupt)
    status, _, error = cconv("data", "generate", "taylor_green_2d", "--out", tmp_path / "a", *SMALL)
    assert status == 130
    assert "Traceback" not in error
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.unfinished"]


@pytest.mark.parametrize("command", [[], ["data"], ["data", "generate"], ["data", "inspect"], ["data", "show"]])
def test_help_is_given(cconv, command):
    status, out, _ = cconv(*command, "--help")
    assert status == 0
    assert "Usage" in out


def test_files_are_imported_and_what_they_were_taken_for_is_said(cconv, tmp_path):
    pattern = write_series(tmp_path, "semicolon.csv")
    status, out, error = cconv("data", "import", pattern, "--out", tmp_path / "a", "--dt", 0.25, "--force", "0,-9.81,0")
    assert (status, error) == (0, "")
    for words in ("`vx` + `vy` + `vz`", "`rho`", "z never differs", "0.25 (given)", "boundary: no walls found"):
        assert words in out
    scene = open_dataset(tmp_path / "a").scene
    assert (scene.dim, scene.force) == (2, ConstantForce((0.0, -9.81)))
    status, out, _ = cconv("data", "inspect", tmp_path / "a", "--json")
    assert json.loads(out)["splits"]["train"]["frames"] == 3


def test_an_import_tells_programs_what_it_found(cconv, tmp_path):
    pattern = write_series(tmp_path, "numpy.npz")
    said = ["--separate-frames", "--gap", 0, "--bounds", "-1:2,-1:2,0:1", "--periodic", "x", "--types", "0=fluid"]
    status, out, _ = cconv("data", "import", pattern, "--out", tmp_path / "a", *said, "--json")
    assert status == 0
    assert json.loads(out)["found"]["velocity"] == "`velocity`"
    assert open_dataset(tmp_path / "a").scene.box.periodic == (True, False)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ([], ["--dt", "--name-time"]),
        (["--dt", 0.25, "--map", "velocity=vel"], ["semicolon_0.csv: has no 'vel' for the velocity"]),
        (["--dt", 0.25, "--types", "1"], ["--types"]),
        (["--dt", 0.25, "--bounds", "0-1"], ["`--bounds` must be LOW:HIGH"]),
        (["--dt", 0.25, "--bounds", "1:0,0:1"], ["lower bound below the upper"]),
        (["--dt", -1], ["`frame_dt` must be positive"]),
        (["--dt", 0.25, "--particle-spacing", 0], ["`particle_spacing` must be positive"]),
        (["--dt", 0.25, "--boundary", "none*.vtp"], ["none*.vtp: no file matches"]),
    ],
)
def test_import_refuses_in_one_line_and_writes_nothing(cconv, tmp_path, said, words):
    pattern = write_series(tmp_path / "files", "semicolon.csv")
    assert_one_clear_line(cconv("data", "import", pattern, "--out", tmp_path / "a", *said), *words)
    assert [entry.name for entry in tmp_path.iterdir()] == ["files"]


def test_import_does_not_replace_what_is_there(cconv, tmp_path):
    pattern = write_series(tmp_path / "files", "semicolon.csv")
    arguments = ["data", "import", pattern, "--out", tmp_path / "a", "--dt", 0.25]
    assert cconv(*arguments)[0] == 0
    assert_one_clear_line(cconv(*arguments), "exists and is not empty")
    assert cconv(*arguments, "--overwrite")[0] == 0


def test_names_in_files_are_shown_as_they_are(cconv, tmp_path):
    frames = [frame | {"[red]\x1b[31m": frame["id"]} for frame in moving_lattice()]
    pattern = write_series(tmp_path, "numpy.npz", frames)
    status, out, _ = cconv("data", "import", pattern, "--out", tmp_path / "a", "--dt", 0.25)
    assert status == 0
    assert "[red]" in out
    assert "\x1b" not in out


def test_check_finds_nothing_in_a_simulation(cconv, flow_folder):
    assert cconv("data", "check", flow_folder) == (0, "nothing suspicious found\n", "")


def test_check_warns_of_what_is_suspicious(cconv, flow_folder):
    status, out, error = cconv("data", "check", flow_folder, "--particle-spacing", 0.08)
    assert status == 0
    assert out == f"{error.count('cconv: suspicious data: trajectory train/0000')} suspicious found\n"
    assert "1 suspicious" in out or "2 suspicious" in out
    status, out, _ = cconv("data", "check", flow_folder, "--particle-spacing", 0.08, "--json")
    assert "number_density" in [finding["check"] for finding in json.loads(out)]


def test_check_and_study_refuse_what_makes_no_sense(cconv, flow_folder, tmp_path):
    wrong = ["--particle-spacing", 0.001]
    words = ["the data make no sense: trajectory train/0000", "have no neighbour within 0.002", "--particle-spacing"]
    assert_one_clear_line(cconv("data", "check", flow_folder, *wrong), *words)
    study = SMOKE.read_text().replace("../search_spaces", str(SMOKE.parents[1] / "search_spaces"))
    (tmp_path / "study.toml").write_text(f"{study}\n[data]\nparticle_spacing = 0.001\n")
    out = tmp_path / "run"
    run = cconv("study", "run", tmp_path / "study.toml", "--data", flow_folder, "--out", out, "--serial")
    assert_one_clear_line(run, *words)
    assert not list((out / "trials").glob("*"))
