"""An import gives back what files hold, whatever their format, and says what it could not tell."""

import json

import numpy as np
import pytest
from foreign_files import DT, SPACING, WRITERS, moving_lattice, shuffled, write_appended, write_csv, write_series

from cconv.data.dataset import open_dataset
from cconv.data.importing.fields import parse_map
from cconv.data.importing.particles import parse_types
from cconv.data.importing.plan import plan_import
from cconv.data.importing.settings import ImportSettings
from cconv.data.trajectory import ParticleType
from cconv.errors import CConvError, ConfigError, DataError

CUT = 2  # frames between the splits of a single run


def imported(folder, patterns, *, phases=(), walls=(), **said):
    """The data set that an import makes of patterns."""
    plan = plan_import(patterns, ImportSettings(**said), phases=phases, walls=walls)
    plan.write(folder / "out", False, lambda items, label: items)
    return open_dataset(folder / "out"), plan


def positions_of(dataset):
    """All frames of a data set in the order of its splits, (T, N, D)."""
    return np.concatenate([part.positions.numpy() for split in dataset.splits for part in dataset.trajectories(split)])


def kept(frames, blocks=((0, 3), (5, 6), (8, 9))):
    """The frames that stay when nine are cut in time with a gap of two."""
    return [frame for start, stop in blocks for frame in frames[start:stop]]


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_gives_the_same_data_set(tmp_path, kind):
    frames = moving_lattice()
    pattern = write_series(tmp_path / "files", kind, [shuffled(frame, k) for k, frame in enumerate(frames)])
    dataset, plan = imported(tmp_path, [pattern], dt=DT)
    wanted = np.stack([frame["positions"][:, :2] for frame in kept(frames)])
    np.testing.assert_allclose(positions_of(dataset), wanted, rtol=1e-6)
    first = dataset.trajectory("train", 0)
    np.testing.assert_allclose(first.velocities[0], frames[0]["velocity"][:, :2], rtol=1e-6)
    np.testing.assert_allclose(first.masses, 1000 * SPACING**2, rtol=1e-6)
    assert (dataset.scene.particle_spacing, dataset.scene.frame_dt) == (SPACING, DT)
    assert plan.found["dimensions"] == "2 (x, y; z never differs and is dropped)"
    assert dataset.metadata["cconv"]["runs"] == dict.fromkeys(("train", "valid", "test"), [pattern])


def test_float64_stays(tmp_path):
    frames = [{name: values.astype(values.dtype.str.replace("f4", "f8")) for name, values in frame.items()}
              for frame in moving_lattice()]  # fmt: skip
    dataset, _ = imported(tmp_path, [write_series(tmp_path, "appended.vtu", frames)], dt=DT)
    assert dataset.trajectory("train", 0).positions.dtype.itemsize == 8


def test_a_frame_between_two_others_that_is_constant_along_y_keeps_x_and_z(tmp_path):
    frames = [frame | {"positions": frame["positions"][:, [0, 2, 1]]} for frame in moving_lattice()]
    frames = [frame | {"velocity": frame["velocity"][:, [0, 2, 1]]} for frame in frames]
    dataset, plan = imported(tmp_path, [write_series(tmp_path, "numpy.npz", frames)], dt=DT, force=(0.0, 0.0, -9.81))
    assert plan.found["dimensions"] == "2 (x, z; y never differs and is dropped)"
    assert dataset.scene.force.declaration()["acceleration"] == (0.0, -9.81)
    np.testing.assert_allclose(
        dataset.trajectory("train", 0).velocities[0, :, 1], moving_lattice()[0]["velocity"][:, 1]
    )


@pytest.mark.parametrize(("name", "said"), [("times in the files", {}), ("numbers in file names", {"name_time": DT})])
def test_times_are_those_of_files_or_of_their_names(tmp_path, name, said):
    for k, frame in enumerate(moving_lattice()):
        write_appended(tmp_path / f"a_{k}.vtu", frame, time=None if said else DT * k)
    dataset, plan = imported(tmp_path, [str(tmp_path / "a_*.vtu")], **said)
    assert dataset.scene.frame_dt == DT
    assert name in plan.found["time between frames"]


def test_a_collection_gives_order_and_times(tmp_path):
    frames = moving_lattice()
    lines = []
    for k, name in enumerate("jihgfedcb"):
        write_csv(tmp_path / f"{name}.csv", frames[k])
        lines.append(f'<DataSet timestep="{k * DT}" file="{name}.csv"/>')
    (tmp_path / "run.pvd").write_text(f"<VTKFile><Collection>{''.join(lines)}</Collection></VTKFile>")
    dataset, _ = imported(tmp_path, [str(tmp_path / "run.pvd")])
    assert dataset.scene.frame_dt == DT
    np.testing.assert_allclose(positions_of(dataset)[0], frames[0]["positions"][:, :2])


def test_files_of_our_own_export_are_imported(tmp_path, cconv, flow_folder):
    cconv("data", "show", flow_folder, "--vtk", tmp_path / "vtk", "--out", tmp_path / "a.png", "--split", "train")
    series = next((tmp_path / "vtk").glob("*.series"))
    dataset, _ = imported(tmp_path, [str(series)], gap=0, bounds=((0, 1), (0, 1)), periodic="x,y")
    stored = open_dataset(flow_folder)
    np.testing.assert_allclose(positions_of(dataset), stored.trajectory("train", 0).positions, rtol=1e-6)
    assert dataset.scene.frame_dt == pytest.approx(stored.scene.frame_dt)
    assert dataset.scene.box == stored.scene.box


def test_folders_are_runs_and_each_is_in_one_split(tmp_path):
    for name in "abcde":
        write_series(tmp_path / name, "comma.csv", moving_lattice(3))
    dataset, _ = imported(tmp_path, [str(tmp_path / "*" / "*.csv")], dt=DT)
    runs = dataset.metadata["cconv"]["runs"]
    assert sorted(len(names) for names in runs.values()) == [1, 1, 3]
    assert len({name for names in runs.values() for name in names}) == 5
    assert [len(part) for part in dataset.trajectories("train")] == [3, 3, 3]


def test_a_file_with_several_frames_is_a_run(tmp_path):
    for name in ("one", "two", "three"):
        stacked = {key: np.stack([frame[key] for frame in moving_lattice()]) for key in ("positions", "velocity")}
        np.savez(tmp_path / f"{name}.npz", **stacked)
    dataset, _ = imported(tmp_path, [str(tmp_path / "*.npz")], dt=DT)
    assert [len(dataset.trajectory(split, 0)) for split in dataset.splits] == [9, 9, 9]


def test_missing_velocities_are_differences(tmp_path):
    frames = [{name: frame[name] for name in ("positions", "id")} for frame in moving_lattice()]
    dataset, plan = imported(tmp_path, [write_series(tmp_path, "numpy.npz", frames)], dt=DT)
    assert "differences" in dataset.scene.velocity_source
    np.testing.assert_allclose(dataset.trajectory("train", 0).velocities[1], [[0.04, 0.08]] * 16, rtol=1e-4)
    assert "masses" not in " ".join(plan.missing)  # the data set itself says so
    assert any(line.startswith("masses: not stored; rest density 1") for line in dataset.scene.missing)


def test_particles_enter_and_leave_in_frames_of_their_own(tmp_path):
    frames = moving_lattice()
    frames[4] = {name: values[:10] for name, values in frames[4].items()}
    pattern = write_series(tmp_path, "text.vtp", frames, [0, 1, 2, 5, 6, 7, 8, 9, 13])
    with pytest.raises(DataError, match="text_5.vtp: number 5 follows 2.*--separate-frames"):
        imported(tmp_path, [pattern], dt=DT)
    dataset, plan = imported(tmp_path, [pattern], separate_frames=True, gap=1)
    counts = [len(part.masses) for split in dataset.splits for part in dataset.trajectories(split)]
    assert counts == [16, 16, 16, 16, 10, 16, 16]
    assert {len(part) for part in dataset.trajectories("train")} == {1}
    assert "for fields, not for steps" in plan.found["written as"]


def test_single_frames_do_not_tell_velocities(tmp_path):
    frames = [{"positions": frame["positions"]} for frame in moving_lattice()]
    with pytest.raises(DataError, match="numpy_0.npz: has no velocities, and single frames do not tell them"):
        imported(tmp_path, [write_series(tmp_path, "numpy.npz", frames)], separate_frames=True)


def test_irregular_times_are_those_of_single_frames(tmp_path):
    for k, frame in enumerate(moving_lattice()):
        write_appended(tmp_path / f"a_{k}.vtu", frame, time=DT * k * k)
    with pytest.raises(DataError, match="a_2.vtu: time 1 follows 0.25.*--separate-frames"):
        imported(tmp_path, [str(tmp_path / "a_*.vtu")])
    dataset, plan = imported(tmp_path, [str(tmp_path / "a_*.vtu")], separate_frames=True)
    assert "irregular: the median" in plan.found["time between frames"]
    assert len(dataset.splits["train"]) == 3


def test_other_particles_of_the_same_number_are_no_sequence(tmp_path):
    frames = moving_lattice()
    frames[4] = frames[4] | {"id": frames[4]["id"] + 3}
    with pytest.raises(DataError, match="numpy_4.npz: has other particles than numpy_0.npz, by their ids"):
        imported(tmp_path, [write_series(tmp_path, "numpy.npz", frames)], dt=DT)


def wall(shift=0.0, normals=True):
    """Points of a wall below the fluid, in two components."""
    points = np.stack([np.linspace(0, 1, 5) + shift, np.full(5, -SPACING), np.full(5, 0.5)], axis=1)
    return {"positions": points} | ({"normal": np.tile([0.0, 2.0, 0.0], (5, 1))} if normals else {})


def test_still_walls_are_boundary_points_with_unit_normals(tmp_path):
    pattern = write_series(tmp_path / "fluid", "numpy.npz")
    np.savez(tmp_path / "wall.npz", **wall())
    dataset, plan = imported(tmp_path, [pattern], walls=[str(tmp_path / "wall.npz")], dt=DT)
    boundary = dataset.trajectory("test", 0).boundary
    np.testing.assert_allclose(boundary.positions, wall()["positions"][:, :2])
    np.testing.assert_allclose(boundary.normals, [[0.0, 1.0]] * 5)
    assert plan.found["boundary"] == "5 points, still, with normals"


def write_moving_walls(folder, told=True):
    """A wall in each of nine files that moves along x, and perhaps its velocity."""
    folder.mkdir()
    for k in range(9):
        velocity = {"velocity": np.tile([0.01 / DT, 0.0, 0.0], (5, 1))} if told else {}
        np.savez(folder / f"wall_{k}.npz", **wall(0.01 * k), **velocity)


def test_a_wall_that_grows_is_no_sequence(tmp_path):
    pattern = write_series(tmp_path / "fluid", "numpy.npz")
    write_moving_walls(tmp_path / "wall")
    np.savez(tmp_path / "wall" / "wall_5.npz", positions=np.zeros((3, 3)))
    with pytest.raises(DataError, match="wall_5.npz: has 3 particles, wall_0.npz has 5"):
        imported(tmp_path, [pattern], walls=[str(tmp_path / "wall" / "*.npz")], dt=DT)


@pytest.mark.parametrize("told", [True, False])
def test_moving_walls_are_particles_that_move(tmp_path, told):
    pattern = write_series(tmp_path / "fluid", "numpy.npz")
    write_moving_walls(tmp_path / "wall", told)
    dataset, _ = imported(tmp_path, [pattern], walls=[str(tmp_path / "wall" / "*.npz")], dt=DT)
    part = dataset.trajectory("train", 0)
    moving = part.particle_types == ParticleType.MOVING_WALL
    assert int(moving.sum()) == 5
    np.testing.assert_allclose(part.velocities[1, moving], [[0.01 / DT, 0.0]] * 5, rtol=1e-5)
    np.testing.assert_allclose(part.velocities[1, ~moving], moving_lattice()[1]["velocity"][:, :2])
    np.testing.assert_allclose(part.positions[2, moving], wall(0.02)["positions"][:, :2], rtol=1e-6)
    assert any(line.startswith("moving walls: ") for line in dataset.scene.missing)
    separate, _ = imported(
        tmp_path / "b", [pattern], walls=[str(tmp_path / "wall" / "*.npz")], separate_frames=True, dt=DT
    )
    last = separate.trajectory("test", 0)
    np.testing.assert_allclose(last.boundary.positions, wall(0.08)["positions"][:, :2])


def test_further_phases_keep_masses_of_their_own(tmp_path):
    pattern = write_series(tmp_path, "numpy.npz")
    heavy = [frame | {"density": np.full(16, 3000.0), "positions": frame["positions"] + [1, 0, 0]}
             for frame in moving_lattice()]  # fmt: skip
    (tmp_path / "oil").mkdir()
    for k, frame in enumerate(heavy):
        np.savez(tmp_path / f"oil_{k}.npz", **frame)
    dataset, plan = imported(tmp_path, [pattern], phases=[str(tmp_path / "oil_*.npz")], dt=DT)
    masses = dataset.trajectory("train", 0).masses
    np.testing.assert_allclose(masses, [10.0] * 16 + [30.0] * 16)
    assert "density of each particle" in plan.found["masses"]


def test_types_tell_walls_and_what_is_left_out(tmp_path):
    kinds = np.array([3] * 10 + [0] * 4 + [9] * 2)
    frames = [frame | {"type": kinds} for frame in moving_lattice()]
    pattern = write_series(tmp_path, "numpy.npz", frames)
    with pytest.raises(DataError, match=r"numpy_0.npz: 'type' has the values 0 \(4\), 3 \(10\), 9 \(2\).*--types"):
        imported(tmp_path, [pattern], dt=DT)
    dataset, _ = imported(tmp_path, [pattern], dt=DT, types=parse_types("3=fluid,0=wall,9=drop"))
    types = dataset.trajectory("train", 0).particle_types
    assert types.tolist() == [ParticleType.FLUID] * 10 + [ParticleType.SOLID_WALL] * 4


def test_the_first_particles_may_be_the_fluid(tmp_path):
    dataset, _ = imported(tmp_path, [write_series(tmp_path, "dpi.h5")], dt=DT, fluid=12)
    assert dataset.trajectory("train", 0).particle_types.tolist() == [0] * 12 + [ParticleType.MOVING_WALL] * 4


def test_names_that_the_user_gives_come_first(tmp_path):
    frames = [
        {"a": frame["positions"][:, 0], "b": frame["positions"][:, 1], "speed": frame["velocity"], "id": frame["id"]}
        for frame in moving_lattice()
    ]
    pattern = write_series(tmp_path, "numpy.npz", frames)
    with pytest.raises(DataError, match="numpy_0.npz: has no positions among a, b, speed, id; .*--map position="):
        imported(tmp_path, [pattern], dt=DT)
    dataset, plan = imported(tmp_path, [pattern], dt=DT, mapping=parse_map("position=a+b,velocity=speed,id="))
    assert plan.found["position"] == "`a` + `b`"
    assert "id" not in plan.found
    np.testing.assert_allclose(positions_of(dataset)[0], moving_lattice()[0]["positions"][:, :2])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("velocity", "lacks a ="),
        ("speed=v", "is no field"),
        ("velocty=v", "Did you mean 'velocity'"),
        ("mass=a,mass=b", "twice"),
    ],
)
def test_a_map_that_cannot_be_is_refused(text, words):
    with pytest.raises(ConfigError, match=words):
        parse_map(text)


@pytest.mark.parametrize("text", ["0", "a=fluid", "0=water"])
def test_types_that_cannot_be_are_refused(text):
    with pytest.raises(ConfigError, match="NUMBER=KIND"):
        parse_types(text)


def blown_up(frames):
    frames[6]["velocity"][3, 1] = np.nan
    return r"numpy_6.npz: the velocity of particle 3 is a NaN"


def of_another_length(frames):
    frames[6]["velocity"] = frames[6]["velocity"][:10]
    return r"numpy_6.npz: the velocity has 10 rows, the position 16"


def lacking(frames):
    del frames[6]["velocity"]
    return r"numpy_6.npz: lacks|numpy_6.npz: has no velocity"


def of_other_dimensions(frames):
    frames[6]["positions"] = frames[6]["positions"][:, :2]
    return r"numpy_6.npz: has 2 dimensions, numpy_0.npz has 3"


def of_fewer_components(frames):
    for frame in frames:
        frame["positions"][:, 2] = frame["positions"][:, 0]
        frame["velocity"] = frame["velocity"][:, :2]
    return r"numpy_0.npz: vectors have 2 components, positions 3"


def of_another_spacing(frames):
    for k, frame in enumerate(frames):
        frame["particle_spacing"] = np.full(16, 0.1 if k != 6 else 0.2)
    return r"numpy_6.npz: has the particle spacing 0.2, numpy_0.npz has 0.1; it is of another simulation"


def with_other_types(frames):
    for k, frame in enumerate(frames):
        frame["particle_type"] = np.array([0] * 15 + [int(k == 6)])
    return r"numpy_6.npz: has other particle types"


@pytest.mark.parametrize(
    "damage",
    [
        blown_up,
        of_another_length,
        lacking,
        of_other_dimensions,
        of_fewer_components,
        of_another_spacing,
        with_other_types,
    ],
)
def test_a_frame_that_does_not_fit_is_named(tmp_path, damage):
    frames = moving_lattice()
    words = damage(frames)
    with pytest.raises(DataError, match=words):
        imported(tmp_path, [write_series(tmp_path, "numpy.npz", frames)], dt=DT)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("numbers", "said", "words"),
    [
        ([0, 1, 2, 3, 5, 6, 7, 8, 9], {"dt": DT}, "comma_5.csv: number 5 follows 3.*add the missing files"),
        ([0, 1, 2, 3, 4, 5, 6, 7, 9], {"name_time": DT}, "comma_9.csv: time 2.25 follows 1.75"),
        (range(9), {}, "`--dt` must be given"),
        (range(9), {"dt": DT, "gap": 4}, "too few to cut into 3 blocks with a gap of 4"),
        (range(9), {"dt": DT, "periodic": "x"}, "`--bounds` must be given with --periodic"),
        (range(9), {"dt": DT, "periodic": "z"}, "`--periodic` must name axes of the data"),
        (range(9), {"dt": DT, "force": (1.0,)}, "`--force` must have a value for each of the 2 axes, got 1"),
        (range(9), {"dt": DT, "fluid": 17}, "has 16 particles, fewer than the 17"),
    ],
)
def test_what_files_do_not_tell_or_lack_is_asked_for(tmp_path, numbers, said, words):
    pattern = write_series(tmp_path, "comma.csv", numbers=numbers)
    with pytest.raises(CConvError, match=words):
        imported(tmp_path, [pattern], **said)


def test_two_files_for_one_time_are_refused(tmp_path):
    pattern = write_series(tmp_path, "comma.csv")
    write_csv(tmp_path / "comma_03.csv", moving_lattice()[3])
    with pytest.raises(DataError, match="comma_0?3.csv: has the number of comma_0?3.csv"):
        imported(tmp_path, [pattern], dt=DT)
    for k in range(9):
        write_appended(tmp_path / f"a_{k}.vtu", moving_lattice()[k], time=0.5 if k == 6 else 0.1 * k)
    with pytest.raises(DataError, match="a_6.vtu: has the same time as a_5.vtu"):
        imported(tmp_path, [str(tmp_path / "a_*.vtu")])


def test_series_that_lie_side_by_side_are_told_apart_by_the_user(tmp_path):
    write_series(tmp_path, "comma.csv")
    write_series(tmp_path, "semicolon.csv")
    with pytest.raises(DataError, match=r"semicolon_\*.csv: lies beside comma_\*.csv.*--phase.*--boundary"):
        imported(tmp_path, [str(tmp_path / "*.csv")], dt=DT)


def test_a_wall_without_the_frame_of_the_fluid_is_named(tmp_path):
    pattern = write_series(tmp_path, "comma.csv")
    for k in (0, 1, 2):
        np.savez(tmp_path / f"wall_{k}.npz", **wall(normals=False))
    with pytest.raises(DataError, match="comma_3.csv: has no file of the same time or number beside wall_0.npz"):
        imported(tmp_path, [pattern], walls=[str(tmp_path / "wall_*.npz")], dt=DT)


@pytest.mark.parametrize(
    ("name", "words"),
    [("*.csv", "no file matches"), ("a.csv", "no file matches"), ("", "is a folder.*cconv data inspect"),
     ("a.foam", "ending that is not read"), ("a.msgpack.zst", "needs? no import: cconv data inspect")],
)  # fmt: skip
def test_patterns_that_name_nothing_to_read_are_refused(tmp_path, name, words):
    (tmp_path / "a.foam").touch()
    (tmp_path / "a.msgpack.zst").touch()
    with pytest.raises(DataError, match=words):
        imported(tmp_path, [str(tmp_path / name)])


def test_the_plan_is_plain(tmp_path):
    plan = plan_import([write_series(tmp_path, "comma.csv")], ImportSettings(dt=DT))
    json.dumps({"found": plan.found, "missing": plan.missing}, allow_nan=False)
    assert plan.found["not used"] == "nothing"
    assert not list(tmp_path.glob("out*"))
