"""Small particle files as other programs write them, made without the readers' own code."""

import base64
import gzip
import struct
import zlib

import h5py
import meshio
import numpy as np
import pandas as pd

DT, SPACING = 0.25, 0.1


def moving_lattice(frames=9, side=4):
    """Frames of a square of fluid in three components that turns and drifts, z never differing: a list of arrays."""
    ticks = SPACING * np.arange(side)
    start = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    made = []
    for k in range(frames):
        points = np.concatenate([start + [0.01 * k, 0.02 * k], np.full((len(start), 1), 0.5)], axis=1)
        velocities = np.tile([0.01 / DT, 0.02 / DT, 0.0], (len(start), 1)) * (1 + np.arange(len(start))[:, None])
        made.append(
            {
                "positions": points.astype("f4"),
                "velocity": velocities.astype("f4"),
                "density": np.full(len(start), 1000.0, "f4"),
                "id": np.arange(len(start), dtype="i4") * 3,
            }
        )
    return made


def shuffled(frame, seed):
    """The same particles in another order."""
    order = np.random.default_rng(seed).permutation(len(frame["id"]))
    return {name: values[order] for name, values in frame.items()}


def point_data(frame):
    """All fields but the positions."""
    return {name: values for name, values in frame.items() if name != "positions"}


def write_mesh(file, frame, **settings):
    """A .vtu or .vtk file by meshio."""
    cells = [("vertex", np.arange(len(frame["positions"]))[:, None])]
    meshio.Mesh(frame["positions"], cells, point_data=point_data(frame)).write(file, **settings)


def write_vtp(file, frame):
    """A .vtp file in text, its attributes spelled as SPHinXsys spells them."""
    arrays = "".join(
        f'<DataArray Name="{name}" type="{type_of(values)}"{components(values)} Format="ascii">'
        f"{text(values)}</DataArray>"
        for name, values in point_data(frame).items()
    )
    points = frame["positions"]
    file.write_text(
        '<?xml version="1.0"?><VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>'
        f'<Piece Name ="Water" NumberOfPoints="{len(points)}" NumberOfVerts="{len(points)}"><Points>'
        f'<DataArray Name="Position" type="Float32" NumberOfComponents="3" Format="ascii">{text(points)}</DataArray>'
        f"</Points><PointData Vectors='vector'>{arrays}</PointData></Piece></PolyData></VTKFile>"
    )


def write_appended(file, frame, time=None, as_text=False, is_compressed=True, byte_order="LittleEndian"):
    """A .vtu file whose arrays are appended, as TrixiParticles writes them: compressed, with headers of 64 bits."""
    header, content, elements = "<u8" if byte_order == "LittleEndian" else ">u8", b"", []
    arrays = {"Points": frame["positions"], **point_data(frame)}
    arrays |= {} if time is None else {"time": np.array([time])}
    for name, values in arrays.items():
        plain = np.ascontiguousarray(values, values.dtype.newbyteorder(header[0])).tobytes()
        packed = zlib.compress(plain) if is_compressed else plain
        sizes = [1, len(plain), 0, len(packed)] if is_compressed else [len(plain)]
        elements.append(
            f'<DataArray type="{type_of(values)}" Name="{name}"{components(values)} format="appended" '
            f'offset="{len(content)}"/>'
        )
        parts = [np.array(sizes, header).tobytes(), packed]
        if as_text:
            parts = [base64.b64encode(part) for part in (parts if is_compressed else [b"".join(parts)])]
        content += b"".join(parts)
    fields = f"<FieldData>{elements.pop()}</FieldData>" if time is not None else ""
    compressor = ' compressor="vtkZLibDataCompressor"' if is_compressed else ""
    head = (
        f'<VTKFile type="UnstructuredGrid" version="1.0" byte_order="{byte_order}" header_type="UInt64"{compressor}>'
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(frame["positions"])}" NumberOfCells="0"><Points>{elements[0]}'
        f"</Points><PointData>{''.join(elements[1:])}</PointData></Piece>{fields}</UnstructuredGrid>"
        f'<AppendedData encoding="{"base64" if as_text else "raw"}">_'
    )
    file.write_bytes(head.encode() + content + b"</AppendedData></VTKFile>")


def write_polydata(file, frame, is_binary):
    """A legacy .vtk file of poly data, as DualSPHysics writes them."""
    count = len(frame["positions"])

    def numbers(values, dtype):
        return np.asarray(values, dtype).tobytes() if is_binary else text(np.asarray(values)).encode()

    cells = np.stack([np.ones(count), np.arange(count)], axis=1)
    file.write_bytes(
        b"# vtk DataFile Version 3.0\nPartVTK\n"
        + (b"BINARY" if is_binary else b"ASCII")
        + f"\nDATASET POLYDATA\nPOINTS {count} float\n".encode()
        + numbers(frame["positions"], ">f4")
        + f"\nVERTICES {count} {2 * count}\n".encode()
        + numbers(cells.astype(int), ">i4")
        + f"\nPOINT_DATA {count}\nSCALARS Idp unsigned_int\nLOOKUP_TABLE default\n".encode()
        + numbers(frame["id"], ">u4")
        + b"\nVECTORS Vel float\n"
        + numbers(frame["velocity"], ">f4")
        + f"\nFIELD FieldData 1\nRhop 1 {count} float\n".encode()
        + numbers(frame["density"], ">f4")
        + b"\n"
    )


def write_bgeo(file, frame):
    """A .bgeo file, gzip-compressed, as SPlisHSPlasH writes them."""
    count = len(frame["positions"])
    content = b"BgeoV" + struct.pack(">9i", 5, count, 1, 0, 0, 3, 0, 0, 0)
    for name, size, kind in (("id", 1, 1), ("velocity", 3, 5), ("density", 1, 0)):
        content += struct.pack(">H", len(name)) + name.encode() + struct.pack(">Hi", size, kind) + bytes(4 * size)
    row = np.dtype([("p", ">f4", 3), ("w", ">f4"), ("id", ">i4"), ("v", ">f4", 3), ("density", ">f4")])
    rows = np.zeros(count, row)
    rows["p"], rows["w"], rows["id"] = frame["positions"], 1, frame["id"]
    rows["v"], rows["density"] = frame["velocity"], frame["density"]
    file.write_bytes(gzip.compress(content + rows.tobytes()))


def write_csv(file, frame, separator=","):
    """A .csv file with a column for each component."""
    columns = {f"pos_{axis}": frame["positions"][:, k] for k, axis in enumerate("xyz")}
    columns |= {f"v{axis}": frame["velocity"][:, k] for k, axis in enumerate("xyz")}
    pd.DataFrame(columns | {"rho": frame["density"], "Idp": frame["id"]}).to_csv(file, index=False, sep=separator)


def write_npz(file, frame):
    """A compressed .npz file of one frame, or of several where the arrays have an axis of time."""
    np.savez_compressed(file, **frame)


def write_h5(file, frame):
    """An .h5 file of one frame, with members of other lengths, as DPI-Net writes them."""
    with h5py.File(file, "w") as opened:
        opened["positions"], opened["velocities"] = frame["positions"], frame["velocity"]
        opened["ids"], opened["densities"] = frame["id"], frame["density"]
        opened["scene_params"] = np.arange(5.0)


WRITERS = {
    "mesh_ascii.vtu": lambda file, frame: write_mesh(file, frame, binary=False),
    "mesh_zlib.vtu": lambda file, frame: write_mesh(file, frame, binary=True, compression="zlib"),
    "mesh_plain.vtu": lambda file, frame: write_mesh(file, frame, binary=True, compression=None),
    "appended.vtu": write_appended,
    "appended_text.vtu": lambda file, frame: write_appended(file, frame, as_text=True),
    "appended_plain.vtu": lambda file, frame: write_appended(file, frame, as_text=True, is_compressed=False),
    "appended_big.vtu": lambda file, frame: write_appended(file, frame, byte_order="BigEndian", is_compressed=False),
    "text.vtp": write_vtp,
    "mesh_ascii.vtk": lambda file, frame: write_mesh(file, frame, binary=False, file_format="vtk42"),
    "mesh_binary.vtk": lambda file, frame: write_mesh(file, frame, binary=True, file_format="vtk42"),
    "mesh_51.vtk": lambda file, frame: write_mesh(file, frame, binary=True, file_format="vtk51"),
    "poly_text.vtk": lambda file, frame: write_polydata(file, frame, is_binary=False),
    "poly_binary.vtk": lambda file, frame: write_polydata(file, frame, is_binary=True),
    "houdini.bgeo": write_bgeo,
    "comma.csv": write_csv,
    "semicolon.csv": lambda file, frame: write_csv(file, frame, ";"),
    "space.txt": lambda file, frame: write_csv(file, frame, " "),
    "numpy.npz": write_npz,
    "dpi.h5": write_h5,
}


def write_series(folder, kind, frames=None, numbers=None):
    """Files NAME_0.ENDING, ... of frames, by one of `WRITERS`; a pattern that matches them."""
    frames = moving_lattice() if frames is None else frames
    name, _, ending = kind.partition(".")
    folder.mkdir(parents=True, exist_ok=True)
    for number, frame in zip(range(len(frames)) if numbers is None else numbers, frames, strict=True):
        WRITERS[kind](folder / f"{name}_{number}.{ending}", frame)
    return str(folder / f"{name}_*.{ending}")


def type_of(values):
    """VTK's name of a type of numbers."""
    return {"f": "Float", "i": "Int", "u": "UInt"}[values.dtype.kind] + str(8 * values.dtype.itemsize)


def components(values):
    """VTK's attribute for the components of a vector; none for a scalar."""
    return f' NumberOfComponents="{values.shape[1]}"' if values.ndim > 1 else ""


def text(values):
    """Numbers as text."""
    return " ".join(repr(value) for value in values.ravel().tolist())
