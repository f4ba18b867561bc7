"""Open3D's continuous convolution (package `open3d-cpu`, extra `parity`), with the names that ours has."""

import torch
from open3d.ml.torch.layers import FixedRadiusSearch
from open3d.ml.torch.ops import continuous_conv

WINDOWS = {
    "none": None,
    "poly6": lambda squared: ((1 - squared) ** 3).clamp(0, 1),
    "gaussian": lambda squared: torch.exp(-squared),
    "cubic_spline": lambda squared: torch.where(
        squared < 0.25, 1 - 6 * squared + 6 * squared**1.5, 2 * (1 - squared.sqrt()) ** 3
    ),
}


def open3d_conv(
    features, filters, points, queries, radius, *, mapping, window, interpolation, align_corners, normalize,
    ignore_query=False,
):  # fmt: skip
    """Convolution (N, C_out), float32, 3D; the neighbours are Open3D's own search's."""
    search = FixedRadiusSearch(return_distances=True, ignore_query_point=ignore_query)
    found = search(points, queries=queries, radius=radius)
    function = WINDOWS[window]
    importance = torch.empty(0) if function is None else function(found.neighbors_distance / radius**2)
    return continuous_conv(
        filters=filters,
        out_positions=queries,
        extents=torch.tensor([[2 * radius]]),
        offset=torch.zeros(3),
        inp_positions=points,
        inp_features=features,
        inp_importance=torch.empty(0),
        neighbors_index=found.neighbors_index,
        neighbors_importance=importance,
        neighbors_row_splits=found.neighbors_row_splits,
        align_corners=align_corners,
        coordinate_mapping=mapping,
        normalize=normalize,
        interpolation=interpolation,
        max_temp_mem_MB=64,
    )
