"""HDF5 files that reach beyond their folder, claim what they do not hold, or hold what no numbers are."""

import math
import shutil

import h5py
import numpy as np
import pytest

from cconv import open_dataset
from cconv.errors import DataError


@pytest.fixture
def folder(flow_folder, tmp_path):
    """A copy of a small data set, in a folder that has neighbours."""
    return shutil.copytree(flow_folder, tmp_path / "data")


def read(folder):
    dataset = open_dataset(folder)
    return [dataset.trajectory("train", k).positions for k in range(len(dataset.splits["train"]))]


def refused(folder, match):
    with pytest.raises(DataError, match=match) as caught:
        read(folder)
    assert "\n" not in str(caught.value)


def replace(folder, key, make):
    """Put what `make(group, values)` makes of it in the place of a member of the first trajectory."""
    with h5py.File(folder / "train.h5", "r+") as file:
        group = file["00000"]
        values = group[key][()]
        del group[key]
        make(group, values)


def test_an_external_link_within_the_folder_is_followed_and_one_out_of_it_is_refused(folder, tmp_path):
    whole = read(folder)
    (folder / "train.h5").rename(folder / "raw.h5")
    with h5py.File(folder / "train.h5", "w") as file:
        for name in ("00000", "00001"):
            file[name] = h5py.ExternalLink("raw.h5", name)
    assert all((ours == theirs).all() for ours, theirs in zip(read(folder), whole, strict=True))
    (folder / "raw.h5").rename(tmp_path / "raw.h5")
    refused(folder, "raw.h5.*which is not there")
    for outside in ("../raw.h5", str(tmp_path / "raw.h5")):
        with h5py.File(folder / "train.h5", "w") as file:
            file["00000"] = h5py.ExternalLink(outside, "00000")
        refused(folder, r"raw.h5'?, outside the data's folder")


def test_a_chain_of_links_out_of_the_folder_is_refused(folder, tmp_path):
    shutil.copy(folder / "train.h5", tmp_path / "outside.h5")
    with h5py.File(folder / "middle.h5", "w") as file:
        file["00000"] = h5py.ExternalLink("../outside.h5", "00000")
    with h5py.File(folder / "train.h5", "w") as file:
        file["there"] = h5py.ExternalLink("middle.h5", "00000")
        file["00000"] = h5py.SoftLink("/there")
    refused(folder, "outside the data's folder")


def test_a_link_that_leads_nowhere_or_to_itself_is_named(folder):
    with h5py.File(folder / "train.h5", "r+") as file:
        del file["00000"]
        file["00000"] = h5py.SoftLink("/nowhere")
    refused(folder, "'00000' is a link that leads nowhere|train.h5")
    with h5py.File(folder / "train.h5", "r+") as file:
        del file["00000"]
        file["00000"] = h5py.SoftLink("/00000")
    refused(folder, "train.h5")


def test_raw_external_storage_is_refused(folder, tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(10_000_000))

    def outside(group, values):
        group.create_dataset("position", values.shape, values.dtype, external=[(str(secret), 0, h5py.h5f.UNLIMITED)])

    replace(folder, "position", outside)
    refused(folder, "`position` keeps its values in other files.*secret")


@pytest.mark.parametrize("there", [True, False])
def test_a_virtual_array_is_read_from_the_folder_and_refused_without_its_source(folder, there):
    whole = read(folder)
    shutil.copy(folder / "train.h5", folder / "raw.h5")

    def virtual(group, values):
        layout = h5py.VirtualLayout(values.shape, values.dtype)
        layout[...] = h5py.VirtualSource("raw.h5", "00000/position", values.shape)
        group.create_virtual_dataset("position", layout)

    replace(folder, "position", virtual)
    if there:
        assert (read(folder)[0] == whole[0]).all()
    else:
        (folder / "raw.h5").unlink()
        refused(folder, "takes its values from.*raw.h5.*not there")


def test_a_virtual_array_out_of_the_folder_is_refused(folder, tmp_path):
    shutil.copy(folder / "train.h5", tmp_path / "raw.h5")

    def virtual(group, values):
        layout = h5py.VirtualLayout(values.shape, values.dtype)
        layout[...] = h5py.VirtualSource("../raw.h5", "00000/position", values.shape)
        group.create_virtual_dataset("position", layout)

    replace(folder, "position", virtual)
    refused(folder, "outside the data's folder")


def test_what_was_allocated_and_never_written_is_named_with_its_frame(folder):
    def half(group, values):
        stored = group.create_dataset("position", values.shape, values.dtype, chunks=(1, *values.shape[1:]))
        stored[: len(values) // 2] = values[: len(values) // 2]

    frames = len(read(folder)[0])
    replace(folder, "position", half)
    refused(folder, f"`position` was never written at frame {frames // 2}")


@pytest.mark.parametrize("chunks", [None, (1, 1000, 2)], ids=["in one piece", "chunked"])
def test_a_size_that_the_file_does_not_hold_is_refused_before_it_is_allocated(folder, chunks):
    def huge(group, values):
        shape = (10**6, 10**5, 2)  # 0.8 TB
        group.create_dataset("position", shape, "f4", chunks=chunks)

    replace(folder, "position", huge)
    refused(folder, "`position` of shape .* claims 800,000,000,000 bytes|never written")


def test_a_sparse_file_is_refused_before_its_zeros_are_read(folder):
    def sparse(group, values):
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((600, 10**6, values.shape[2]))
        h5py.h5d.create(group.id, b"position", h5py.h5t.IEEE_F32LE, space, properties)

    replace(folder, "position", sparse)
    refused(folder, "`position` of shape .* claims 4,800,000,000 bytes")


KINDS = {
    "texts": np.array(["a", "b"], dtype="S1"),
    "objects": np.array(["a", "b"], dtype=object),
    "complex numbers": np.ones((2, 2, 2), dtype=complex),
    "long doubles": np.ones((2, 2, 2), dtype=np.longdouble),
    "truth values": np.ones((2, 2, 2), dtype=bool),
    "records": np.zeros(3, dtype=[("x", "f4")]),
}


@pytest.mark.parametrize("values", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("key", ["position", "velocity"])
def test_what_are_no_numbers_is_refused(folder, key, values):
    def others(group, _):
        kind = h5py.string_dtype() if values.dtype == object else values.dtype
        group.create_dataset(key, data=values, dtype=kind)

    replace(folder, key, others)
    refused(folder, f"`{key}` must hold numbers of at most 64 bits")


@pytest.mark.parametrize("space", [h5py.Empty("f4"), 1.0], ids=["empty", "a single number"])
def test_an_array_without_axes_is_refused(folder, space):
    replace(folder, "position", lambda group, values: group.create_dataset("position", data=space))
    refused(folder, "`position`")


def test_a_filter_that_is_not_installed_is_named(folder):
    def unknown(group, values):
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((1, *values.shape[1:]))
        properties.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple(values.shape)
        stored = h5py.h5d.create(group.id, b"position", h5py.h5t.IEEE_F32LE, space, properties)
        for frame in range(len(values)):
            stored.write_direct_chunk((frame, 0, 0), values[frame].astype("<f4").tobytes(), filter_mask=0)

    replace(folder, "position", unknown)
    refused(folder, "compressed by filter 32001.*not installed")


def test_zeros_that_gzip_made_small_are_read(folder):
    def zeros(group, values):
        shape = (40, *values.shape[1:])
        chunks = tuple(min(length, 10_000) for length in shape)
        group.create_dataset("velocity", data=np.zeros(values.shape), compression="gzip", chunks=True)
        assert math.prod(chunks) > 0

    replace(folder, "velocity", zeros)
    assert open_dataset(folder).trajectory("train", 0).velocities.abs().max() == 0
