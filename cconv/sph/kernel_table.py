"""SPH kernels as tables of cubic polynomials, for compiled pair loops that take any kernel."""

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from cconv.sph.kernels import AbstractKernel

_INTERVALS = 768  # divisible by the knots of every kernel; coefficients of a table (24 KB) stay in a core's first cache


def kernel_tables(kernel: AbstractKernel) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of W and dW/dr on equal intervals from 0 to the support radius, each (intervals + 1, 4), float64.

    Within an interval the value is a cubic in the distance from its start, counted in intervals, highest power first.
    They differ from the kernel by less than 1e-6 of its largest value. The last row is zero, for distances that
    rounding takes to the support itself.
    """
    last = np.nextafter(kernel.support_radius, 0)  # at the support itself W is 0, which for some kernels is a jump
    nodes = np.linspace(0, last, _INTERVALS + 1)
    powers = (kernel.support_radius / _INTERVALS) ** np.arange(3, -1, -1)
    values, slopes = (
        np.vstack([CubicSpline(nodes, function(torch.from_numpy(nodes)).numpy()).c.T * powers, np.zeros(4)])
        for function in (kernel.value, kernel.derivative)
    )
    return values, slopes
