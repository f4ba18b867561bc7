"""Particle data of strangers, of every kind that a file can hold: read or refused in one clear line, within limits.

Valid folders are changed at random: a member of HDF5, a value of a frame, bytes before or after compression; options
of the commands too. Each call ends with status 0 or 2 within its limits of processor time and memory, and where it
refuses, nothing was written.
"""

import contextlib
import json
import shutil

import h5py
import msgpack
import numpy as np
import pytest
import zstandard
from foreign_files import WRITERS, write_series
from fuzzing import changed, changed_bytes, changed_json, check_call, examples, numbers, strings
from hypothesis import assume, given
from hypothesis import strategies as st
from particle_files import METADATA, encode, record_frames, walls, write_hdf5, write_packed

pytestmark = pytest.mark.integration

SPLITS = ("train", "valid", "test")
MEMBERS = ("position", "particle_type", "velocity", "mass", "viscosity", "boundary_position", "boundary_normal")
GIVEN = ("--mass", "--particle-spacing", "--frame-dt", "--force")
COMMANDS = {
    "inspect": ("--cutoff", *GIVEN),
    "check": GIVEN,
    "convert": GIVEN,
    "show": ("--frames", "--every", "--split", "--trajectory", "--color", "--mass"),
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A LagrangeBench folder with all members and one of records."""
    place = tmp_path_factory.mktemp("fuzz_data")
    extra = {"boundary_position": np.zeros((3, 2), "f4"), "boundary_normal": np.tile(np.array([0, 1], "f4"), (3, 1))}
    motion = {"velocity": np.ones((6, 4, 2), "f4"), "mass": np.ones(4, "f4"), "viscosity": np.ones(4, "f4")}
    write_hdf5(place / "hdf5", **motion, **extra)
    write_packed(place / "records" / "sim_00.msgpack.zst", msgpack.packb(FRAMES))
    return place


def _frames():
    frames = record_frames(num_frames=9, num_particles=3, mass=0.1)
    frames[0]["box"], frames[0]["box_normals"] = walls()
    return [
        {key: value if isinstance(value, str) else encode(value) for key, value in frame.items()} for frame in frames
    ]


FRAMES = _frames()

arrays = st.sampled_from(
    [
        np.zeros((6, 4, 2), "f4"),
        np.zeros((6, 4, 3)),
        np.zeros((6, 5, 2)),
        np.zeros((1, 4, 2)),
        np.zeros((0, 4, 2)),
        np.full((6, 4, 2), np.nan),
        np.full((6, 4, 2), 1e300),
        np.full((6, 4, 2), -1e30, "f4"),
        np.arange(48.0).reshape(6, 4, 2),
        np.zeros((6, 4, 2), "g"),
        np.zeros((6, 4, 2), "f2"),
        np.zeros((6, 4, 2), ">f8"),
        np.zeros((6, 4, 2), "c8"),
        np.zeros((6, 4, 2), "i8"),
        np.full((6, 4, 2), b"text"),
        np.zeros(4),
        np.full(4, 7),
        np.full(4, -1),
        np.ones(4, bool),
        np.array([0, 1, 2, 3], "u8"),
        np.full(4, 2**63, "u8"),
        np.full(4, np.inf),
        np.float64(1.0),
        np.zeros((1,) * 20),
        h5py.Empty("f4"),
    ]
)


@st.composite
def stored_arrays(draw):
    """How a member of HDF5 is stored: its array, and in which way."""
    values = draw(arrays)
    options = draw(st.sampled_from([{}, {"compression": "gzip"}, {"fletcher32": True}, {"chunks": True}]))
    options = options if np.ndim(values) and np.size(values) else {}
    return {"data": values} | options


def replace_member(folder, data):
    split, key = data.draw(st.sampled_from(SPLITS)), data.draw(st.sampled_from(MEMBERS))
    with h5py.File(folder / f"{split}.h5", "r+") as file:
        del file[f"00000/{key}"]
        change = data.draw(st.sampled_from(["replace", "replace", "replace", "remove", "group", "allocate"]))
        if change == "replace":
            file["00000"].create_dataset(key, **data.draw(stored_arrays()))
        elif change == "group":
            file["00000"].create_group(key)
        elif change == "allocate":
            shape = data.draw(st.sampled_from([(6, 4, 2), (10**6, 10**6, 2), (10**9,), (4,), (2**40, 1, 1)]))
            file["00000"].create_dataset(key, shape, "f4", chunks=data.draw(st.sampled_from([None, (1,) * len(shape)])))


def change_hdf5(folder, data):
    """Change one file of a LagrangeBench folder."""
    kind = data.draw(st.sampled_from(["member", "member", "metadata", "bytes", "file"]))
    split = folder / f"{data.draw(st.sampled_from(SPLITS))}.h5"
    if kind == "member":
        replace_member(folder, data)
    elif kind == "metadata":
        (folder / "metadata.json").write_bytes(data.draw(changed_json(json.dumps(METADATA))))
    elif kind == "bytes":
        split.write_bytes(data.draw(changed_bytes(split.read_bytes())))
    else:
        split.unlink()
        data.draw(st.sampled_from([split.mkdir, split.touch, lambda: split.symlink_to("/dev/zero"), lambda: None]))()


def packed(frames):
    try:
        return msgpack.packb(frames, unicode_errors="surrogatepass")
    except (OverflowError, ValueError, TypeError):  # what msgpack cannot hold
        return None


BOMBS = (
    b"\xdd\x7f\xff\xff\xff",
    b"\xdd\xff\xff\xff\xff" + b"\x90" * 1000,
    b"\xdd\x00\x80\x00\x00" + b"\x90" * 2**23,
    b"\xdd\x00\x80\x00\x00" + b"\xa1x" * 2**23,
    b"\x91\xdf\x00\x20\x00\x00" + b"".join(b"\xce" + k.to_bytes(4, "big") + b"\x80" for k in range(2**21)),
    b"\x91" * 10**6,
    b"\x91\x81\xa3pos" * 10**5,
    b"\x91\xc6\xff\xff\xff\xff",
    bytes(2**26),
)


def change_records(folder, data):
    """Change the file of a folder of records."""
    file = folder / "sim_00.msgpack.zst"
    kind = data.draw(st.sampled_from(["frames", "frames", "frames", "packed", "bytes", "bomb"]))
    if kind == "frames":
        content = data.draw(changed(FRAMES).map(packed))
        assume(content is not None)
        write_packed(file, content)
    elif kind == "packed":
        write_packed(file, data.draw(changed_bytes(msgpack.packb(FRAMES))))
    elif kind == "bytes":
        change = changed_bytes(file.read_bytes()) | st.just(file.read_bytes() + bytes(512))
        file.write_bytes(data.draw(change))
    else:
        file.write_bytes(zstandard.ZstdCompressor().compress(data.draw(st.sampled_from(BOMBS))))


@st.composite
def options(draw, command):
    """Options of a command with values that may be anything."""
    names = draw(st.lists(st.sampled_from(COMMANDS[command]), max_size=2, unique=True))
    texts = numbers.map(str) | strings | st.sampled_from(["0,1", "0," * 5000, "9" * 5000, "0,0", "1,2,3", "test"])
    return [f"{name}={draw(texts)}".replace("\x00", "") for name in names]


@contextlib.contextmanager
def copied(folder):
    """A copy of a folder, gone afterwards."""
    place = folder.parent / "work"
    shutil.copytree(folder, place / folder.name)
    try:
        yield place / folder.name
    finally:
        shutil.rmtree(place)


def call(folder, data, command):
    """Run a command on a folder; what it writes appears only where it ends well."""
    outputs = {"convert": folder.parent / "out", "show": folder.parent / "out.png"}
    out = ["--out", outputs[command]] if command in outputs else []
    if check_call("data", command, folder, *out, *data.draw(options(command))) == 2:
        assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def try_data(folder, change, data, commands=tuple(COMMANDS)):
    with copied(folder) as copy:
        change(copy, data)
        call(copy, data, data.draw(st.sampled_from(commands)))


CHANGES = {"hdf5": change_hdf5, "records": change_records}
kinds = pytest.mark.parametrize("kind", CHANGES)


@kinds
@examples(40)
@given(data=st.data())
def test_a_changed_folder_is_read_or_refused_in_one_line(folders, kind, data):
    try_data(folders / kind, CHANGES[kind], data)


@kinds
@examples(15)
@given(data=st.data())
def test_any_option_is_taken_or_refused_in_one_line(folders, kind, data):
    try_data(folders / kind, lambda *_: None, data)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """Files of each kind that other programs write: pattern, and contents by file."""
    place = tmp_path_factory.mktemp("fuzz_foreign")
    patterns = {kind: write_series(place / kind.replace(".", "_"), kind) for kind in WRITERS}
    return place, {
        kind: (pattern, {file: file.read_bytes() for file in sorted((place / kind.replace(".", "_")).iterdir())})
        for kind, pattern in patterns.items()
    }


def try_files(foreign, kind, data):
    place, files = foreign
    pattern, contents = files[kind]
    file = data.draw(st.sampled_from(sorted(contents)))
    file.write_bytes(data.draw(changed_bytes(contents[file])))
    try:
        status = check_call("data", "import", pattern, "--dt", 0.25, "--out", place / "out")
        assert (place / "out").exists() == (status == 0)
    finally:
        shutil.rmtree(place / "out", ignore_errors=True)
        file.write_bytes(contents[file])


@pytest.mark.parametrize("kind", WRITERS)
@examples(4)
@given(data=st.data())
def test_a_changed_file_of_another_program_is_imported_or_refused_in_one_line(foreign, kind, data):
    try_files(foreign, kind, data)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", WRITERS)
@examples(200)
@given(data=st.data())
def test_hundreds_of_files_of_other_programs(foreign, kind, data):
    try_files(foreign, kind, data)


@pytest.mark.parametrize("content", BOMBS, ids=lambda content: repr(content[:6]))
def test_a_file_that_unpacks_to_far_more_is_refused_in_one_line(folders, content):
    with copied(folders / "records") as copy:
        write_packed(copy / "sim_00.msgpack.zst", content)
        assert check_call("data", "inspect", copy) == 2


@pytest.mark.slow
@pytest.mark.timeout(7200)
@kinds
@examples(400)
@given(data=st.data())
def test_hundreds_of_folders(folders, kind, data):
    try_data(folders / kind, CHANGES[kind], data)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@kinds
@examples(100)
@given(data=st.data())
def test_a_hundred_options(folders, kind, data):
    try_data(folders / kind, lambda *_: None, data)
