"""Write `open3d_conv.safetensors`: outputs of Open3D's continuous convolution for every setting.

Run with the extra `parity` installed: ``PYTHONPATH=tests python tests/data/record_open3d_conv.py``.
"""

import itertools
from pathlib import Path

import open3d
import torch
from oracles.open3d_conv import WINDOWS, open3d_conv
from safetensors.torch import save_file

MAPPINGS = ("identity", "ball_to_cube_radial", "ball_to_cube_volume_preserving")
INTERPOLATIONS = ("linear", "nearest_neighbor", "linear_border")
RADIUS = 0.5

if __name__ == "__main__":
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(40, 3, generator=generator)
    points[1] = points[0]  # two points at one place
    # Queries at points and elsewhere; the last has no neighbours.
    queries = torch.cat([points[:6], torch.rand(5, 3, generator=generator), torch.full((1, 3), 9.0)])
    tensors = {
        "points": points,
        "queries": queries,
        "features": torch.randn(40, 3, generator=generator),
        "filters": torch.randn(3, 4, 2, 3, 2, generator=generator),
    }
    outputs = {}
    for setting in itertools.product(MAPPINGS, WINDOWS, INTERPOLATIONS, (True, False), (True, False)):
        mapping, window, interpolation, align_corners, normalize = setting
        outputs["|".join(map(str, setting))] = open3d_conv(
            tensors["features"], tensors["filters"], points, queries, RADIUS, mapping=mapping, window=window,
            interpolation=interpolation, align_corners=align_corners, normalize=normalize,
        )  # fmt: skip
    source = {"source": f"Open3D {open3d.__version__} ({Path(__file__).name})", "radius": str(RADIUS)}
    tensors |= {"outputs": torch.stack(list(outputs.values()))}
    path = Path(__file__).with_name("open3d_conv.safetensors")
    save_file(tensors, path, metadata=source | {"settings": ";".join(outputs)})
