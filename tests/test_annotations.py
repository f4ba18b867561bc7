"""Shapes in annotations hold: in the tests they are checked, elsewhere they cost nothing."""

import subprocess
import sys

import pytest
import torch
from jaxtyping import TypeCheckError

from cconv.domain import Box
from cconv.errors import ShapeError
from cconv.neighbors import radius_graph
from cconv.nn.kinds import Kinds, split_kinds
from cconv.sph import CubicSpline


def test_a_result_of_another_shape_than_annotated_is_found(monkeypatch):
    monkeypatch.setattr(CubicSpline, "_profile", lambda kernel, q: q.T)
    with pytest.raises(TypeCheckError):
        CubicSpline(0.1, 2).value(torch.ones(3, 1))


def test_arguments_of_another_type_than_annotated_are_found():
    with pytest.raises(TypeCheckError):
        split_kinds(torch.ones(3, 4, dtype=torch.int64), Kinds(1, 1), 3)


def test_functions_refuse_bad_arguments_with_their_own_message():
    with pytest.raises(ShapeError, match="dim 1 to 3"):
        radius_graph(torch.ones(3, 2, 2), 0.1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_precisions_fit(dtype):
    assert Box([0, 0], [1, 1], True).wrap(torch.ones(3, 2, dtype=dtype)).dtype == dtype


@pytest.mark.integration
def test_nothing_is_checked_outside_the_tests():
    code = (
        "import sys, torch, cconv.models.model; from cconv.nn.kinds import Kinds, split_kinds; "
        "split_kinds(torch.ones(2, 3, dtype=int), Kinds(1, 1), 2); print({'beartype', 'jax'} & {*sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "set()\n"
