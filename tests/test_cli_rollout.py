"""A step is fitted, trained, evaluated and rolled out from the command line."""

import json
import resource
import shutil
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from conftest import run_main
from outcomes import assert_one_clear_line
from particle_files import record_frames, write_parts

from cconv.data.dataset import open_dataset
from cconv.data.trajectory import ParticleType
from cconv.forces import ConstantForce
from cconv.models.checkpoint import load_model, read_card, save_model
from cconv.models.relaxation import Relaxation
from cconv.report.particles import animation_suffixes

STUDY = """
name = "steps"
[task]
name = "acceleration"
history = 3
horizon = 5
[network]
architecture = "radial_net"
layers = {layers}
first_channels = 4
radial_terms = 6
message = "opposite"
relative_cutoff = 3.0
window = "none"
[training]
noise = 0.01
loss = "balanced_mse"
updates = 6
evaluate_every = 3
[search]
space = "none.toml"
grace_updates = 3
[stages.baseline]
"""
OWN = Relaxation(alpha=0.02, beta=0.3, loops=3)


@pytest.fixture(scope="module")
def fitted(steps_folder, tmp_path_factory):
    """Checkpoint of a closed form for steps."""
    place = tmp_path_factory.mktemp("fitted")
    (place / "study.toml").write_text(STUDY.format(layers=1))
    assert run_main("fit", place / "study.toml", "--data", steps_folder, "--out", place / "model") == 0
    return place / "model"


def test_a_closed_form_of_steps_is_better_than_going_on(fitted, cconv):
    code, printed, _ = cconv("evaluate", fitted, "--json")
    assert code == 0
    card = json.loads((fitted / "card.json").read_text())
    assert 0 < card["valid_error"] < 1e-4
    facts = json.loads(printed)
    assert facts["task"] == "acceleration"
    assert facts["diverged_rollouts"] == 0
    assert facts["rollout_mse"] < facts["mean_predictor_rollout_mse"]
    assert facts["frames"] == 2  # windows of 3 frames and rollouts of 5, as the study said, in 16 frames
    assert json.loads(cconv("evaluate", fitted, "--horizon", 10, "--json")[1])["frames"] == 1


def test_a_step_is_trained_and_rolled_out_on_deep_lagrangian_fluids(cconv, tmp_path):
    """Wall points with normals are walls, and what the files do not hold is given: force, spacing."""
    for seed in range(3):
        write_parts(tmp_path / "data", name=f"sim_{seed}", frames=record_frames(num_particles=12, seed=seed))
    (tmp_path / "study.toml").write_text(STUDY.format(layers=2))
    given = ["--set", "data.force=[0, -9.81, 0]", "--set", "data.particle_spacing=0.4"]
    code, _, _ = cconv(
        "train", tmp_path / "study.toml", "--data", tmp_path / "data", "--out", tmp_path / "model", *given
    )
    assert code == 0
    checkpoint = tmp_path / "model" / "checkpoint"
    config = json.loads((checkpoint / "config.json").read_text())
    assert {"force", "wall_distance", "wall_normal", "walls"} <= set(config["features"])
    assert config["wall_vectors"] == 1
    code, _, _ = cconv("rollout", checkpoint, "--frames", 3, "--out", tmp_path / "out")
    assert code == 0
    stored, rolled = (open_dataset(tmp_path / name).trajectory("test", 0).boundary for name in ("data", "out"))
    assert np.array_equal(rolled.positions, stored.positions)
    assert np.array_equal(rolled.normals, stored.normals)
    assert open_dataset(tmp_path / "out").scene.force == ConstantForce((0.0, -9.81, 0.0))


def test_a_rollout_is_a_data_set_with_its_metrics(fitted, steps_folder, cconv, tmp_path):
    code, printed, _ = cconv("rollout", fitted, "--out", tmp_path / "out", "--start", 2, "--frames", 7, "--vtk")
    assert code == 0
    assert "MSE_5: " in printed
    assert "ms per frame" in printed
    assert "The solver's 10 steps to the next frame take" in printed
    stored = open_dataset(steps_folder).trajectory("test", 0).positions[2:12]
    rolled = open_dataset(tmp_path / "out")
    found, reference = (rolled.trajectory(split, 0).positions for split in ("test", "valid"))
    assert np.array_equal(reference, stored)
    assert np.array_equal(found[:3], stored[:3])
    facts = json.loads((tmp_path / "out" / "metrics.json").read_text())
    box = rolled.scene.box
    errors = box.displacement(found[3:].double(), reference[3:].double()).square().mean(dim=(1, 2))
    assert facts["metrics"]["mse"] == pytest.approx(errors.tolist(), rel=1e-3, abs=1e-12)
    assert facts["mse_n"]["5"] == pytest.approx(float(errors[:5].mean()), rel=1e-3)
    assert facts["ended"] is None
    assert facts["solver"]["milliseconds_per_frame"] > 0
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "train.h5", "valid.h5", "test.h5", "metadata.json", "metrics.json", "rollout.gif", "vtk"
    } | {f"rollout{suffix}" for suffix in animation_suffixes()}  # fmt: skip
    with h5py.File(tmp_path / "out" / "test.h5") as file:
        assert file["00000/position"].shape == (10, 100, 2)


def test_relaxation_spreads_the_particles_of_a_rollout_and_is_told(fitted, cconv):
    plain, relaxed = (
        json.loads(cconv("rollout", fitted, "--frames", 6, "--json", *options)[1])
        for options in ((), ("--relax", "0.02,0.3,3"))
    )
    assert plain["relaxation"] is None
    assert relaxed["relaxation"] == {"alpha": 0.02, "beta": 0.3, "loops": 3}
    off_rest = [facts["metrics"]["rollout"]["rho_mae_unclamped"][-1] for facts in (plain, relaxed)]
    assert off_rest[1] < off_rest[0]


@pytest.fixture(scope="module")
def relaxed_checkpoint(fitted, tmp_path_factory):
    """The same checkpoint with a relaxation of its own."""
    place = tmp_path_factory.mktemp("relaxed") / "model"
    save_model(load_model(fitted).relaxed_by(OWN), place, read_card(fitted))
    return place


def test_the_relaxation_of_a_checkpoint_is_applied_replaced_or_left_out(fitted, relaxed_checkpoint, cconv):
    def rolled(folder, *options):
        facts = json.loads(cconv("rollout", folder, "--frames", 6, "--json", *options)[1])
        return facts["relaxation"], facts["metrics"]["mse"]

    assert rolled(relaxed_checkpoint) == rolled(fitted, "--relax", "0.02,0.3,3")
    assert rolled(relaxed_checkpoint)[0] == OWN.model_dump()
    assert rolled(relaxed_checkpoint, "--no-relax") == rolled(fitted)
    assert rolled(relaxed_checkpoint, "--relax", "0.01,0,1") == rolled(fitted, "--relax", "0.01,0,1")
    assert rolled(relaxed_checkpoint)[1] != rolled(fitted)[1]
    said = cconv("rollout", relaxed_checkpoint, "--frames", 3)[1]
    assert "ms per frame, the relaxation included: alpha 0.02, beta 0.3, loops 3" in said


def test_an_evaluation_rolls_out_with_the_relaxation_of_the_checkpoint(fitted, relaxed_checkpoint, cconv):
    plain, relaxed = (json.loads(cconv("evaluate", each, "--json")[1]) for each in (fitted, relaxed_checkpoint))
    assert (plain["relaxation"], relaxed["relaxation"]) == (None, OWN.model_dump())
    assert plain["rollout_mse"] != relaxed["rollout_mse"]
    assert plain["first_frame_mse"] != relaxed["first_frame_mse"]
    assert "Rollouts with relaxation: alpha 0.02, beta 0.3, loops 3" in cconv("evaluate", relaxed_checkpoint)[1]


def test_a_shift_of_more_than_a_spacing_ends_the_rollout_with_one_line(fitted, cconv):
    code, printed, said = cconv("rollout", fitted, "--frames", 6, "--relax", "1000,0,1")
    assert (code, printed) == (1, "")
    assert "particle spacings in one loop, and at most 1 is allowed; take a smaller `alpha`" in said
    assert len(said.strip().splitlines()) == 1


def test_without_a_folder_the_metrics_are_printed_as_json(fitted, cconv):
    code, printed, _ = cconv("rollout", fitted, "--json")
    facts = json.loads(printed)
    assert code == 0
    assert facts["frames"] == 13  # all that follow the first window
    metrics = facts["metrics"]
    assert (metrics["frames"], metrics["sinkhorn_frames"]) == ([10], [10])
    assert set(metrics["rollout"]) == set(metrics["reference"]) > {"e_kin", "momentum_drift", "rho_mae", "dirichlet"}


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--frames", 40], "has 16 frames, and a window of 3 up to frame 2 and 40 after it needs frames 0 to 42"),
        (["--start", 14], "a window of 3 up to frame 16"),
        (["--start", -1], "needs frames -1 to"),
        (["--frames", 0], "`--frames` must be at least 1, got 0"),
        (["--trajectory", 3], "has 1 trajectories, counted from 0; got 3"),
        (["--split", "tset"], "has no split 'tset'"),
        (["--relax", "0.02,a"], "`--relax` must be three numbers ALPHA,BETA,LOOPS"),
        (["--relax", "-1,0,3"], "alpha"),
        (["--relax", "0.02,0,3", "--no-relax"], "`--relax` and `--no-relax` exclude each other"),
        (["--vtk"], "`--vtk` writes to DIR/vtk and needs `--out DIR`"),
    ],
)
def test_what_cannot_be_rolled_out_is_one_line(options, reason, fitted, cconv):
    code, _, printed = cconv("rollout", fitted, *options)
    assert code == 2
    assert reason in printed
    assert len(printed.strip().splitlines()) == 1


@pytest.mark.parametrize(("key", "what"), [("dx", "particle spacing"), ("dt", "time between frames")])
def test_what_a_step_was_not_trained_at_is_told_with_both_values(key, what, fitted, steps_folder, cconv, tmp_path):
    scene = open_dataset(steps_folder).scene
    trained = {"dx": scene.particle_spacing, "dt": scene.frame_dt}[key]
    shutil.copytree(steps_folder, tmp_path / "data")
    metadata = json.loads((steps_folder / "metadata.json").read_text())
    (tmp_path / "data" / "metadata.json").write_text(json.dumps(metadata | {key: 1.1 * metadata[key]}))
    code, _, printed = cconv("rollout", fitted, "--data", tmp_path / "data", "--frames", 3)
    assert code == 0
    assert f"a {what} of {1.1 * trained:g}, and the model was trained at {trained:g}; a step" in printed
    code, printed, _ = cconv("evaluate", fitted, "--data", tmp_path / "data")
    assert f"{what.capitalize()} {1.1 * trained:g}; the model was trained at {trained:g}" in printed
    same = cconv("rollout", fitted, "--frames", 3), cconv("evaluate", fitted)
    assert not [outcome for outcome in same if "trained at" in outcome[1] + outcome[2]]


def test_suspicious_other_data_are_told(fitted, steps_folder, cconv, tmp_path):
    shutil.copytree(steps_folder, tmp_path / "data")
    with h5py.File(tmp_path / "data" / "test.h5", "r+") as file:
        file["00000/position"][12] = file["00000/position"][11]
    for command in ("rollout", "evaluate"):
        status, _, error = cconv(command, fitted, "--data", tmp_path / "data", "--json")
        assert status == 0
        assert error.startswith("cconv: suspicious data: trajectory test/00000, frame 12: ")
        assert cconv(command, fitted, "--json")[2] == ""


def test_a_solver_that_would_take_hours_is_not_timed(fitted, steps_folder, cconv, tmp_path):
    shutil.copytree(steps_folder, tmp_path / "data")
    metadata = json.loads((steps_folder / "metadata.json").read_text())
    finer = {"dt": 1e-5 * metadata["dt"], "write_every": 10**5 * metadata["write_every"]}
    (tmp_path / "data" / "metadata.json").write_text(json.dumps(metadata | finer))
    code, printed, _ = cconv("rollout", fitted, "--data", tmp_path / "data", "--frames", 3)
    assert code == 0
    assert "The solver was not timed: a frame is 100,000,000 steps of a particle, more than 10,000,000" in printed


def test_data_without_masses_are_refused_before_the_rollout(steps_folder, cconv, tmp_path):
    """Densities relative to that of rest would be no numbers, which no JSON holds."""
    settings = ("--set", 'task.features=["velocity", "accelerations"]')
    (tmp_path / "study.toml").write_text(STUDY.format(layers=1))
    fit = ("fit", tmp_path / "study.toml", "--data", steps_folder, "--out", tmp_path / "model", *settings)
    assert cconv(*fit)[0] == 0
    shutil.copytree(steps_folder, tmp_path / "data")
    with h5py.File(tmp_path / "data" / "test.h5", "r+") as file:
        file["00000/mass"][:] = 0
    outcome = cconv("rollout", tmp_path / "model", "--data", tmp_path / "data", "--out", tmp_path / "out")
    assert_one_clear_line(outcome, "mean mass of the fluid must be positive, got 0", "--mass")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_is_left_alone(fitted, cconv, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    code, _, printed = cconv("rollout", fitted, "--out", tmp_path)
    assert (code, len(printed.strip().splitlines())) == (2, 1)
    assert "exists and is not empty" in printed
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_a_model_of_a_field_is_refused(flow_folder, cconv, tmp_path):
    text = STUDY.format(layers=1).replace("acceleration", "density_rate").replace("noise = 0.01", "")
    (tmp_path / "study.toml").write_text(text.replace("history = 3", "").replace("horizon = 5", ""))
    assert cconv("fit", tmp_path / "study.toml", "--data", flow_folder, "--out", tmp_path / "model")[0] == 0
    code, _, printed = cconv("rollout", tmp_path / "model")
    assert code == 2
    assert "the task 'density_rate' is a field, and only steps are possible here" in printed
    code, _, printed = cconv("evaluate", tmp_path / "model", "--horizon", 5)
    assert code == 2
    assert "`--horizon` is for steps, and 'density_rate' is a field" in printed


def test_what_ends_the_metrics_loses_no_frame(fitted, cconv, tmp_path, monkeypatch):
    from cconv.evaluation.rollout_comparison import RolloutMeter

    def stops(meter):
        raise KeyboardInterrupt

    monkeypatch.setattr(RolloutMeter, "metrics", stops)
    assert cconv("rollout", fitted, "--out", tmp_path / "out")[0] == 130
    assert len(open_dataset(tmp_path / "out").trajectory("test", 0)) == 16


def test_ctrl_c_keeps_the_frames_so_far(fitted, cconv, tmp_path, monkeypatch):
    from cconv.models.model import Model

    predict, answers = Model.predict_frame, SimpleNamespace(count=0)

    def stops(self, frame, scene):
        answers.count += 1
        if answers.count > 4:
            raise KeyboardInterrupt
        return predict(self, frame, scene)

    monkeypatch.setattr(Model, "predict_frame", stops)
    code, printed, _ = cconv("rollout", fitted, "--out", tmp_path / "out")
    assert code == 130
    assert "4 frames from frame 3 on; it interrupted" in printed or "interrupted" in printed
    assert len(open_dataset(tmp_path / "out").trajectory("test", 0)) == 7


@pytest.mark.parametrize("last", [0, 5])
def test_a_disk_that_is_full_is_one_line_and_keeps_the_frames_so_far(last, fitted, cconv, tmp_path, monkeypatch):
    """A limit of the system for the size of files, which ends writing as a full disk does."""
    from cconv.models.model import Model

    predict, answers, limits = Model.predict_frame, SimpleNamespace(count=0), resource.getrlimit(resource.RLIMIT_FSIZE)

    def fills(self, frame, scene):
        answers.count += 1
        if answers.count == last + 1:
            (partial,) = tmp_path.glob(".out.*/test.h5")
            resource.setrlimit(resource.RLIMIT_FSIZE, (partial.stat().st_size, limits[1]))
        return predict(self, frame, scene)

    monkeypatch.setattr(Model, "predict_frame", fills)
    try:
        outcome = cconv("rollout", fitted, "--out", tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert_one_clear_line(outcome, str(tmp_path / "out"), "cannot be written", "File too large")
    assert answers.count == last + 1
    if last == 0:
        assert list(tmp_path.iterdir()) == []
    else:
        assert "the 5 frames so far are kept" in outcome[2]
        assert [file.name for file in tmp_path.iterdir()] == ["out"]
        assert {len(open_dataset(tmp_path / "out").trajectory(split, 0)) for split in ("train", "valid", "test")} == {8}


def test_a_folder_that_cannot_be_made_is_told_before_anything_is_predicted(fitted, cconv, tmp_path, monkeypatch):
    from cconv.models.model import Model

    monkeypatch.setattr(Model, "predict_frame", lambda *_: pytest.fail("a frame was predicted"))
    (tmp_path / "file").write_text("")
    outcome = cconv("rollout", fitted, "--out", tmp_path / "file" / "out")
    assert_one_clear_line(outcome, str(tmp_path / "file" / "out"), "cannot be written")


def test_a_damaged_stored_frame_is_told_before_anything_is_predicted(
    fitted, steps_folder, cconv, tmp_path, monkeypatch
):
    from cconv.models.model import Model

    monkeypatch.setattr(Model, "predict_frame", lambda *_: pytest.fail("a frame was predicted"))
    shutil.copytree(steps_folder, tmp_path / "data")
    with h5py.File(tmp_path / "data" / "test.h5", "r+") as file:
        file["00000/position"][9, 3] = np.nan
    outcome = cconv("rollout", fitted, "--data", tmp_path / "data", "--out", tmp_path / "out")
    assert_one_clear_line(outcome, "trajectory test/00000, frame 9: `position` has a NaN")
    assert [file.name for file in tmp_path.iterdir()] == ["data"]


def test_data_without_the_lid_of_the_training_data_are_refused(steps_folder, cconv, tmp_path):
    shutil.copytree(steps_folder, tmp_path / "lid")
    for split in ("train", "valid", "test"):
        with h5py.File(tmp_path / "lid" / f"{split}.h5", "r+") as file:
            for group in file.values():
                group["particle_type"][:9] = ParticleType.MOVING_WALL
    (tmp_path / "study.toml").write_text(STUDY.format(layers=1))
    assert cconv("fit", tmp_path / "study.toml", "--data", tmp_path / "lid", "--out", tmp_path / "model")[0] == 0
    assert cconv("rollout", tmp_path / "model", "--frames", 2)[0] == 0
    outcome = cconv("rollout", tmp_path / "model", "--data", steps_folder, "--out", tmp_path / "out")
    assert_one_clear_line(outcome, "trained beside particles of type moving wall (2), and the data have none")
    assert not (tmp_path / "out").exists()


def test_the_integrator_adds_the_force_of_data_that_say_one_and_is_refused_where_there_is_none(
    steps_folder, cconv, tmp_path
):
    text = STUDY.format(layers=1).replace("horizon = 5", 'horizon = 5\nexternal_force = "integrator"')
    (tmp_path / "study.toml").write_text(text)
    fit = ("fit", tmp_path / "study.toml", "--data", steps_folder)
    outcome = cconv(*fit, "--out", tmp_path / "no")
    assert_one_clear_line(outcome, "there is no external force, and an integrator is to add it")
    assert not (tmp_path / "no").exists()
    assert cconv(*fit, "--out", tmp_path / "model", "--set", "data.force=[0, -0.5]")[0] == 0
    config = json.loads((tmp_path / "model" / "config.json").read_text())
    assert config["force_travel"] > 0
    assert cconv("evaluate", tmp_path / "model", "--json")[0] == 0
    assert cconv("rollout", tmp_path / "model", "--frames", 3)[0] == 0
    field = text.replace('"acceleration"', '"density_rate"').replace("history = 3", "").replace("horizon = 5", "")
    (tmp_path / "study.toml").write_text(field.replace("noise = 0.01", ""))
    outcome = cconv(*fit, "--out", tmp_path / "no")
    assert_one_clear_line(outcome, "task.external_force: is for steps, and 'density_rate' is a field of one frame")


def test_a_film_is_written_where_ffmpeg_is_found(fitted, cconv, tmp_path, monkeypatch):
    from matplotlib.animation import FFMpegWriter

    assert cconv("rollout", fitted, "--frames", 2, "--out", tmp_path / "out")[0] == 0
    assert (tmp_path / "out" / "rollout.mp4").exists() == FFMpegWriter.isAvailable()
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    code, _, said = cconv("rollout", fitted, "--frames", 2, "--out", tmp_path / "other")
    assert (code, said) == (0, "")
    assert [file.name for file in (tmp_path / "other").glob("rollout*")] == ["rollout.gif"]


def test_a_run_that_has_recommended_nothing_is_one_line(fitted, cconv, tmp_path):
    (tmp_path / "study.json").write_text(
        json.dumps({"format": 4, "name": "a", "stages": {"select": {"kind": "select"}}})
    )
    for command in ("evaluate", "rollout"):
        assert_one_clear_line(cconv(command, tmp_path), str(tmp_path), "has not recommended a model yet")


def test_a_rollout_without_a_frame_ends_with_1_and_leaves_nothing(fitted, cconv, tmp_path, monkeypatch):
    from cconv.models.model import Model

    predict = Model.predict_frame
    monkeypatch.setattr(Model, "predict_frame", lambda *given: predict(*given) * float("nan"))
    code, printed, said = cconv("rollout", fitted, "--out", tmp_path / "out")
    assert (code, printed) == (1, "")
    assert "the rollout diverged at frame 3: positions are not finite" in said
    assert list(tmp_path.iterdir()) == []


def test_a_rollout_that_diverges_says_so_and_ends_with_1(fitted, cconv, monkeypatch):
    from cconv.models.model import Model

    predict, answers = Model.predict_frame, SimpleNamespace(count=0)

    def breaks(self, frame, scene):
        answers.count += 1
        return predict(self, frame, scene) * (float("nan") if answers.count > 2 else 1.0)

    monkeypatch.setattr(Model, "predict_frame", breaks)
    code, printed, _ = cconv("rollout", fitted)
    assert code == 1
    assert "2 frames from frame 3 on; it diverged: positions are not finite" in printed


def test_a_network_of_several_layers_is_trained_on_noisy_windows(steps_folder, cconv, tmp_path):
    (tmp_path / "study.toml").write_text(STUDY.format(layers=2))
    code, printed, _ = cconv("train", tmp_path / "study.toml", "--data", steps_folder, "--out", tmp_path / "run")
    assert code == 0
    assert "(rollout MSE)" in printed
    lines = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["updates"] for line in lines] == [3, 6]


PREDICTOR = """
[predictor]
noise = 0.0
[predictor.network]
architecture = "radial_net"
layers = 1
radial_terms = 6
message = "mixed"
"""


def test_a_network_that_corrects_a_fitted_layer_is_trained_and_rolled_out(steps_folder, cconv, tmp_path):
    (tmp_path / "study.toml").write_text(STUDY.format(layers=2) + PREDICTOR)
    moved = ["training.pushforward=1", "training.pushforward_from=0", "training.unroll=2", "training.unroll_from=0"]
    settings = [argument for setting in moved for argument in ("--set", setting)]
    code, _, _ = cconv("train", tmp_path / "study.toml", "--data", steps_folder, "--out", tmp_path / "run", *settings)
    assert code == 0
    checkpoint = tmp_path / "run" / "checkpoint"
    assert json.loads((checkpoint / "config.json").read_text())["predictor"]["network"]["layers"] == 1
    assert cconv("rollout", checkpoint, "--frames", 1, "--out", tmp_path / "rolled")[0] == 0


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ("layers = 1", "layers = 2", "`predictor.network`: must have `layers = 1`"),
        ('"acceleration"', '"density_rate"', "`predictor` is for steps, and 'density_rate' is a field"),
    ],
)
def test_a_predictor_that_cannot_be_is_told(before, after, reason, steps_folder, cconv, tmp_path):
    study = STUDY.format(layers=2).replace("history = 3\nhorizon = 5\n", "").replace("noise = ", "# ") + PREDICTOR
    (tmp_path / "study.toml").write_text(study.replace(before, after))
    outcome = cconv("train", tmp_path / "study.toml", "--data", steps_folder, "--out", tmp_path / "run")
    assert_one_clear_line(outcome, reason)
    assert not (tmp_path / "run").exists()


def test_a_test_split_too_short_for_rollouts_is_told_before_anything_is_trained(steps_folder, cconv, tmp_path):
    shutil.copytree(steps_folder, tmp_path / "data")
    with h5py.File(tmp_path / "data" / "test.h5", "r+") as file:
        for name in ("position", "velocity"):
            first = file["00000"][name][:7]
            del file["00000"][name]
            file["00000"][name] = first
    space = Path(__file__).parents[1] / "search_spaces" / "rollout.toml"
    (tmp_path / "study.toml").write_text(STUDY.format(layers=1).replace("none.toml", str(space)))
    outcome = cconv("study", "run", tmp_path / "study.toml", "--data", tmp_path / "data", "--out", tmp_path / "run")
    assert_one_clear_line(outcome, "trajectory test/00000: has 7 frames, too few for a window of 6 and 5 after it")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ("history = 3", "history = 1", "`history` must be 2 to 20"),
        ("horizon = 5", "horizon = 0", "task.horizon"),
        ("horizon = 5", "horizon = 50", "too few for a window of 3 and 50 after it"),
        ("noise = 0.01", "noise = -1.0", "training.noise"),
        ('"acceleration"', '"density_rate"', "`history` must be 1 for the task 'density_rate', got 3"),
        (
            "relative_cutoff",
            "conserves_momentum = true\nnormalize = true\nrelative_cutoff",
            "needs `normalize = false`",
        ),
    ],
)
def test_settings_that_make_no_sense_are_one_line(before, after, reason, steps_folder, cconv, tmp_path):
    (tmp_path / "study.toml").write_text(STUDY.format(layers=1).replace(before, after))
    code, _, printed = cconv("fit", tmp_path / "study.toml", "--data", steps_folder, "--out", tmp_path / "out")
    assert code == 2
    assert reason in printed
    assert len(printed.strip().splitlines()) == 1
