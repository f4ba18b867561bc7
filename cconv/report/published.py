"""Published errors of networks on LagrangeBench's data sets, drawn beside those of a study."""

from pathlib import PurePath

from cconv.study.records.summary import Summary

HORIZON = 20  # frames behind the published errors

# MSE_20 of the pretrained checkpoints on the test split with 6 frames of input, by how the names of data sets begin.
# Source: LagrangeBench (Toshev et al., 2023), README of its repository, table of pretrained models.
MSE_20 = {
    "2D_TGV_2500": {"GNS-10-128": 5.9e-6, "SEGNN-10-64": 4.4e-6},
    "2D_RPF_3200": {"GNS-10-128": 4.0e-6, "SEGNN-10-64": 3.4e-6},
    "2D_LDC_2708": {"GNS-10-128": 1.5e-5, "SEGNN-10-64": 2.1e-5},
    "2D_DAM_5740": {"GNS-10-128": 3.1e-5, "SEGNN-10-64": 4.1e-5},
    "3D_TGV_8000": {"GNS-10-128": 5.8e-3, "SEGNN-10-64": 5.0e-3},
    "3D_RPF_8000": {"GNS-10-128": 2.1e-5, "SEGNN-10-64": 1.7e-5},
    "3D_LDC_8160": {"GNS-10-128": 4.1e-5, "SEGNN-10-64": 4.1e-5},
}


def published_errors(summary: Summary) -> dict[str, float]:
    """Published errors by network, if the data have the name of LagrangeBench's and rollouts are as long; else none."""
    folder = PurePath(summary.dataset.path).name
    if summary.task.horizon != HORIZON:
        return {}
    return next((errors for name, errors in MSE_20.items() if folder.startswith(name)), {})
