"""Axes and units: a simulation comes out the same whichever way its files lie and whatever they count in."""

import numpy as np
import pytest
from foreign_files import DT, moving_lattice, write_appended, write_series
from outcomes import assert_one_clear_line

from cconv.data.dataset import open_dataset
from cconv.data.importing.conversion import Conversion, parse_axes, parse_units
from cconv.data.importing.plan import plan_import
from cconv.data.importing.settings import ImportSettings
from cconv.errors import ConfigError, DataError

VECTORS = ("positions", "velocity")


def imported(folder, pattern, **said):
    plan = plan_import([str(pattern)], ImportSettings(**said))
    plan.write(folder, False, lambda items, label: items)
    return open_dataset(folder), plan


def assert_same(found, wanted):
    assert found.scene.particle_spacing == pytest.approx(wanted.scene.particle_spacing)
    assert found.scene.frame_dt == pytest.approx(wanted.scene.frame_dt)
    for name in ("positions", "velocities", "masses"):
        stored, expected = (getattr(data.trajectory("train", 0), name) for data in (found, wanted))
        np.testing.assert_allclose(stored, expected, rtol=1e-5, atol=1e-6)
    for corner in ("lower", "upper"):
        np.testing.assert_allclose(getattr(found.scene.box, corner), getattr(wanted.scene.box, corner), atol=1e-6)


@pytest.fixture
def frames():
    """Nine frames in which y points up."""
    return moving_lattice()


@pytest.fixture
def usual(frames, tmp_path):
    """The data set of files with the usual axes and SI units."""
    return imported(tmp_path / "usual", write_series(tmp_path / "si", "numpy.npz", frames), dt=DT)[0]


def test_files_in_which_z_points_up_or_an_axis_is_mirrored(frames, usual, tmp_path):
    def lying(vectors):  # x stays, y becomes z, z becomes -y: undone by "x,z,-y"
        return vectors[:, [0, 2, 1]] * np.array([1, -1, 1], dtype=vectors.dtype)

    turned = [frame | {name: lying(frame[name]) for name in VECTORS} for frame in frames]
    pattern = write_series(tmp_path / "turned", "numpy.npz", turned)
    found, plan = imported(tmp_path / "out", pattern, dt=DT, conversion=Conversion(axes=parse_axes("x,z,-y")))
    assert_same(found, usual)
    assert plan.found["converted"] == "axes x, z, -y of the files"
    mirrored = [frame | {name: -frame[name][:, :2] for name in VECTORS} for frame in frames]
    pattern = write_series(tmp_path / "mirrored", "numpy.npz", mirrored)
    found, _ = imported(tmp_path / "again", pattern, dt=DT, conversion=Conversion(axes=parse_axes("-x,-y")))
    assert_same(found, usual)


def test_millimetres_milliseconds_and_grams_become_metres_seconds_and_kilograms(frames, usual, tmp_path):
    for k, frame in enumerate(frames):
        scaled = {"positions": frame["positions"] * 1e3, "velocity": frame["velocity"]}  # mm and mm/ms
        other = {name: values for name, values in frame.items() if name not in (*VECTORS, "density")}
        # Densities in grams per square millimetre, the files' own units in two dimensions.
        scaled["density"] = (frame["density"] * 1e3 / 1e6).astype(frame["density"].dtype)
        write_appended(tmp_path / f"a_{k}.vtu", other | scaled, time=1e3 * DT * k)
    conversion = Conversion(**parse_units("mm,ms,g"))
    found, plan = imported(tmp_path / "out", tmp_path / "a_*.vtu", conversion=conversion)
    assert_same(found, usual)
    assert plan.found["converted"] == "length times 0.001; time times 0.001; mass times 0.001"


def test_a_time_that_is_given_is_in_the_units_that_come_out(frames, tmp_path):
    pattern = write_series(tmp_path / "files", "numpy.npz", frames)
    found, _ = imported(tmp_path / "out", pattern, dt=DT, conversion=Conversion(**parse_units("ms")))
    assert found.scene.frame_dt == DT
    np.testing.assert_allclose(
        found.trajectory("train", 0).velocities[0], 1e3 * frames[0]["velocity"][:, :2], rtol=1e-5
    )


def test_a_factor_stands_for_a_unit():
    assert parse_units("length=0.05, time=2") == {"length": 0.05, "time": 2.0}
    assert parse_units("cm,h,t") == {"length": 0.01, "time": 3600.0, "mass": 1000.0}


@pytest.mark.parametrize("text", ["x,x,y", "x,z", "up", "", "x,--y", "x,y,z,w"])
def test_axes_that_are_not_each_named_once_are_refused(text):
    with pytest.raises(ConfigError, match="--axes"):
        parse_axes(text)


@pytest.mark.parametrize("text", ["parsec", "mm,cm", "length=-1", "length=nan", "length=", "colour=2", ""])
def test_units_that_are_none_are_refused(text):
    with pytest.raises(ConfigError, match="--units"):
        parse_units(text)


def test_axes_that_the_files_do_not_have_are_refused(frames, tmp_path):
    pattern = write_series(tmp_path / "files", "numpy.npz", frames)
    with pytest.raises(DataError, match="has 3 components, and `--axes` names 2"):
        imported(tmp_path / "out", pattern, dt=DT, conversion=Conversion(axes=parse_axes("y,x")))
    assert not (tmp_path / "out").exists()


def test_the_command_takes_both_and_refuses_in_one_line(cconv, frames, tmp_path):
    pattern = write_series(tmp_path / "files", "numpy.npz", frames)
    call = ("data", "import", pattern, "--dt", DT, "--out", tmp_path / "out")
    assert_one_clear_line(cconv(*call, "--axes", "x,q,z"), "--axes", "x,q,z")
    assert_one_clear_line(cconv(*call, "--units", "furlong"), "--units", "furlong")
    assert not (tmp_path / "out").exists()
    status, out, error = cconv(*call, "--axes", "y,x,z", "--units", "mm")
    assert (status, error) == (0, "")
    assert "length times 0.001; axes y, x, z of the files" in " ".join(out.split())
    assert open_dataset(tmp_path / "out").scene.particle_spacing == pytest.approx(1e-4)
