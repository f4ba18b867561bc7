"""What a particle carries: scalars and vectors, the irreducible representations of rotations of degree 0 and 1."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Kinds(NamedTuple):
    """Numbers of scalars and of vectors that a particle carries."""

    scalars: int
    vectors: int

    def num_values(self, dim: int) -> int:
        """Numbers that hold them in D dimensions: the scalars first, then the D components of each vector."""
        return self.scalars + self.vectors * dim


def split_kinds(
    values: Float[Tensor, "N C"], kinds: Kinds, dim: int
) -> tuple[Float[Tensor, "N {kinds.scalars}"], Float[Tensor, "N {kinds.vectors} {dim}"]]:
    """Scalars (N, S) and vectors (N, V, D) of values (N, S + V · D)."""
    scalars, vectors = values.split([kinds.scalars, kinds.vectors * dim], dim=1)
    return scalars, vectors.reshape(values.shape[0], kinds.vectors, dim)


def join_kinds(scalars: Float[Tensor, "N S"], vectors: Float[Tensor, "N V D"]) -> Float[Tensor, "N S+V*D"]:
    """Values (N, S + V · D) of scalars (N, S) and vectors (N, V, D)."""
    return torch.cat([scalars, vectors.flatten(1)], dim=1)
