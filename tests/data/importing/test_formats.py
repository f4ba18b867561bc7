"""Every format gives back what was written; files that are not what their ending says are refused in one line."""

import pickle
import zlib

import numpy as np
import pytest
from foreign_files import WRITERS, moving_lattice, write_appended, write_csv

from cconv.data.importing.fields import field_values, find_fields
from cconv.data.importing.formats import READERS, read_tables
from cconv.data.importing.series import find_series
from cconv.errors import DataError


def ending_of(kind):
    """Ending of the names of a kind of files."""
    return "." + kind.rpartition(".")[2]


@pytest.mark.parametrize("kind", WRITERS)
def test_what_was_written_is_found_by_its_usual_names(tmp_path, kind):
    frame = moving_lattice()[3]
    WRITERS[kind](tmp_path / kind, frame)
    (table,) = read_tables(tmp_path / kind)
    fields = find_fields(table, {})
    for name in ("velocity", "density", "id"):
        np.testing.assert_allclose(field_values(table, name, fields[name]), frame[name], rtol=1e-6)
    np.testing.assert_allclose(field_values(table, "position", fields["position"]), frame["positions"], rtol=1e-6)


def test_every_format_has_a_writer():
    made = {ending_of(kind) for kind in WRITERS}
    assert set(READERS) - made == {".dat", ".npy", ".hdf5"}  # other names, and positions alone


@pytest.mark.parametrize(
    ("kind", "ending"),
    [(kind, ending) for kind in WRITERS for ending in READERS if READERS[ending] != READERS[ending_of(kind)]],
)
def test_a_file_with_the_ending_of_another_format_is_refused(tmp_path, kind, ending):
    WRITERS[kind](tmp_path / kind, moving_lattice(1)[0])
    wrong = (tmp_path / kind).rename(tmp_path / f"wrong{ending}")
    with pytest.raises(DataError) as refusal:
        find_fields(*read_tables(wrong), {})
    assert str(refusal.value).startswith(f"{wrong}: ")
    assert "\n" not in str(refusal.value)


# Tables of text are shorter ones when they are cut off, and legacy VTK may end between two arrays.
@pytest.mark.parametrize(
    ("kind", "share"),
    [(kind, 0.0) for kind in WRITERS]
    + [(kind, 0.1) for kind in WRITERS if ending_of(kind) not in (".csv", ".txt")]
    + [(kind, share) for kind in WRITERS if ending_of(kind) not in (".csv", ".txt", ".vtk") for share in (0.5, 0.9)],
)
def test_what_is_cut_off_is_refused(tmp_path, kind, share):
    file = tmp_path / kind
    WRITERS[kind](file, moving_lattice(1)[0])
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match="^[^\n]*$"):
        find_fields(*read_tables(file), {})


def test_a_file_of_one_time_column_is_a_run(tmp_path):
    lines = ["time,x,y,vx,vy"] + [f"{t},{x},{2 * x},1,0" for t in (0.0, 0.5, 1.0) for x in (0, 1)]
    (tmp_path / "all.csv").write_text("\n".join(lines))
    tables = read_tables(tmp_path / "all.csv")
    assert [table.time for table in tables] == [0.0, 0.5, 1.0]
    assert [len(table.arrays["x"]) for table in tables] == [2, 2, 2]


def test_units_and_comment_signs_in_the_first_line_are_no_part_of_names(tmp_path):
    (tmp_path / "a.csv").write_text("# Pos.x [m];Pos.z [m];Rhop [kg/m^3]\n0;1;1000\n1;2;1000\n")
    (table,) = read_tables(tmp_path / "a.csv")
    assert list(table.arrays) == ["Pos.x", "Pos.z", "Rhop"]


def test_a_separator_may_end_the_lines(tmp_path):
    (tmp_path / "a.csv").write_text("x;y;\n0;1;\n1;2;\n")
    (table,) = read_tables(tmp_path / "a.csv")
    assert table.arrays["y"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y\n0,1,2\n1,2,3\n", "more values in a row"),
        ("x,y\n0,1\n1,2,3\n", "line 3"),
        ("0,1\n1,2\n", "first line must name the columns"),
        ("x,x\n0,1\n", "each once"),
        ("x,y\n", "no rows"),
        ("x,t\n0,a\n", "`t` must be a number in every row"),
    ],
)
def test_tables_that_do_not_fit_their_first_line_are_refused(tmp_path, text, words):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=words):
        read_tables(tmp_path / "a.csv")


def test_arrays_with_an_axis_of_time_are_frames(tmp_path):
    positions = np.random.default_rng(0).random((5, 7, 2))
    np.savez(tmp_path / "run.npz", positions=positions, time=0.1 * np.arange(5), mass=np.ones(7))
    np.save(tmp_path / "run.npy", positions)
    tables = read_tables(tmp_path / "run.npz")
    assert [table.time for table in tables] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert np.array_equal(tables[3].arrays["positions"], positions[3])
    assert tables[3].arrays["mass"].shape == (7,)
    assert np.array_equal(read_tables(tmp_path / "run.npy")[4].arrays["positions"], positions[4])


class Harmful:
    def __reduce__(self):
        return print, ("code ran",)


def test_pickles_are_never_read(tmp_path, capsys):
    np.savez(tmp_path / "a.npz", positions=np.array([Harmful()], dtype=object))
    (tmp_path / "a.npy").write_bytes(pickle.dumps(Harmful()))
    for name in ("a.npz", "a.npy"):
        with pytest.raises(DataError):
            read_tables(tmp_path / name)
    assert capsys.readouterr().out == ""


def test_xml_that_grows_is_refused(tmp_path):
    entities = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10 if k else "x" * 10}">' for k in range(10))
    (tmp_path / "bomb.vtu").write_text(f"<!DOCTYPE VTKFile [{entities}]><VTKFile>&e9;</VTKFile>")
    with pytest.raises(DataError, match="no XML of VTK"):
        read_tables(tmp_path / "bomb.vtu")


def test_an_array_that_claims_to_be_huge_is_refused_before_it_is_made(tmp_path):
    write_appended(tmp_path / "a.vtu", moving_lattice(1)[0])
    content = (tmp_path / "a.vtu").read_bytes()
    size = np.array([4 * 3 * 16], "<u8").tobytes()
    assert size in content
    (tmp_path / "a.vtu").write_bytes(content.replace(size, np.array([2**50], "<u8").tobytes()))
    with pytest.raises(DataError, match="takes 1.13e\\+03 TB|takes .*TB"):
        read_tables(tmp_path / "a.vtu")


def test_fewer_bytes_than_an_array_says_are_refused(tmp_path):
    write_appended(tmp_path / "a.vtu", moving_lattice(1)[0])
    content = (tmp_path / "a.vtu").read_bytes()
    points = moving_lattice(1)[0]["positions"].tobytes()
    short = zlib.compress(points[:-40]).ljust(len(zlib.compress(points)), b"\0")
    (tmp_path / "a.vtu").write_bytes(content.replace(zlib.compress(points), short))
    with pytest.raises(DataError, match="ends too early"):
        read_tables(tmp_path / "a.vtu")


def test_collections_name_files_beside_them_alone(tmp_path):
    write_csv(tmp_path / "a.csv", moving_lattice(1)[0])
    for name, words in (("a.csv", None), ("../a.csv", "outside"), ("/etc/passwd", "outside"), ("b.csv", "missing")):
        (tmp_path / "run.pvd").write_text(
            f'<VTKFile type="Collection"><Collection><DataSet timestep="0.5" file="{name}"/></Collection></VTKFile>'
        )
        if words is None:
            (series,) = find_series([str(tmp_path / "run.pvd")])
            assert [(entry.file.name, entry.time) for entry in series.entries] == [("a.csv", 0.5)]
        else:
            with pytest.raises(DataError, match=words):
                find_series([str(tmp_path / "run.pvd")])
