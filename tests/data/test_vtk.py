import json
from dataclasses import replace

import meshio
import numpy as np
import pytest
from particle_files import write_parts
from systems import periodic_scene, periodic_trajectory

from cconv.data.dataset import open_dataset
from cconv.data.quantities import density_deviation
from cconv.data.vtk import write_vtk
from cconv.errors import ConfigError


def test_files_read_back_equal_the_trajectory(tmp_path, generator):
    trajectory, scene = periodic_trajectory(generator), periodic_scene()
    write_vtk(tmp_path / "a", trajectory, scene, range(3))
    for k, frame in enumerate(trajectory):
        mesh = meshio.read(tmp_path / "a" / f"square_{k:05d}.vtu")
        assert np.array_equal(mesh.points[:, :2], frame.positions)
        assert np.array_equal(mesh.point_data["velocity"][:, :2], frame.velocities)
        assert not mesh.points[:, 2].any()
        assert not mesh.point_data["velocity"][:, 2].any()
        assert np.array_equal(mesh.point_data["mass"], frame.masses)
        assert np.array_equal(mesh.point_data["particle_type"], frame.particle_types)
        assert np.array_equal(mesh.point_data["density_deviation"], density_deviation(frame, scene))
        assert np.allclose(mesh.point_data["speed"], np.linalg.norm(mesh.point_data["velocity"], axis=1))
        assert [cells.type for cells in mesh.cells] == ["vertex"]
        assert np.array_equal(mesh.cells[0].data[:, 0], np.arange(64))


def test_three_dimensions_are_kept(tmp_path):
    write_parts(tmp_path / "a")
    dataset = open_dataset(tmp_path / "a", particle_spacing=0.1)
    trajectory = dataset.trajectory("train", 0)
    series = write_vtk(tmp_path / "b", trajectory, dataset.scene, [1])
    mesh = meshio.read(series.with_name("a_00001.vtu"))
    assert np.array_equal(mesh.points, trajectory.positions[1])
    assert np.array_equal(mesh.point_data["velocity"], trajectory.velocities[1])


def test_series_gives_the_time_of_every_file(tmp_path, generator):
    trajectory = replace(periodic_trajectory(generator), first_frame=10)
    series = write_vtk(tmp_path / "a", trajectory, periodic_scene(), [0, 2])
    content = json.loads(series.read_text())
    assert series == tmp_path / "a" / "square.vtu.series"
    assert content["file-series-version"] == "1.0"
    assert [entry["name"] for entry in content["files"]] == ["square_00000.vtu", "square_00002.vtu"]
    assert [entry["time"] for entry in content["files"]] == pytest.approx([0.1, 0.12])
    assert all((tmp_path / "a" / entry["name"]).exists() for entry in content["files"])


def test_folder_appears_whole_or_not_at_all(tmp_path, generator):
    def stops(frames, label):
        yield 0
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_vtk(tmp_path / "a", periodic_trajectory(generator), periodic_scene(), range(3), progress=stops)
    assert list(tmp_path.iterdir()) == []


def test_older_files_are_replaced_only_when_told(tmp_path, generator):
    trajectory, scene = periodic_trajectory(generator), periodic_scene()
    write_vtk(tmp_path / "a", trajectory, scene, range(3))
    with pytest.raises(ConfigError, match="not empty"):
        write_vtk(tmp_path / "a", trajectory, scene, [1])
    write_vtk(tmp_path / "a", trajectory, scene, [1], overwrite=True)
    assert {file.name for file in (tmp_path / "a").iterdir()} == {"square_00001.vtu", "square.vtu.series"}


@pytest.mark.parametrize("frames", [[3], [-1], [0, 7], []])
def test_frames_out_of_range_are_refused(tmp_path, generator, frames):
    with pytest.raises(ConfigError, match="from 0 to 2"):
        write_vtk(tmp_path / "a", periodic_trajectory(generator), periodic_scene(), frames)
    assert list(tmp_path.iterdir()) == []
