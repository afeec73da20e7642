"""Symmetric block-tridiagonal systems, several at once: what chains of knots lead to."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Factor:
    """A lower Cholesky factor L of a chain.

    Attributes:
      lower: inverses of the blocks on L's diagonal, shape (n, n_blocks, m, m).
      across: the transposed blocks below it, shape (n, n_blocks - 1, m, m).
    """

    lower: Array
    across: Array

    def logdet(self) -> Array:
        """Logarithm of the matrices' determinants, shape (n,)."""
        diagonal = np.diagonal(self.lower, axis1=2, axis2=3)
        return np.asarray(-2 * np.log(diagonal).sum(axis=(1, 2)))

    def solve(self, right: Array) -> Array:
        """Solutions for right sides of shape (n, n_blocks, m, k)."""
        out = np.empty_like(right)
        blocks = right.shape[1]
        for i in range(blocks):
            part = right[:, i]
            if i:
                part = part - _t(self.across[:, i - 1]) @ out[:, i - 1]
            out[:, i] = self.lower[:, i] @ part
        for i in reversed(range(blocks)):
            part = out[:, i]
            if i + 1 < blocks:
                part = part - self.across[:, i] @ out[:, i + 1]
            out[:, i] = _t(self.lower[:, i]) @ part
        return out

    def inverse(self) -> "Chain":
        """The blocks on and beside the diagonal of the inverse matrices."""
        diagonal, beside = np.empty_like(self.lower), np.empty_like(self.across)
        for i in reversed(range(self.lower.shape[1])):
            diagonal[:, i] = _t(self.lower[:, i]) @ self.lower[:, i]
            if i < self.across.shape[1]:
                lead = _t(self.lower[:, i]) @ self.across[:, i]
                beside[:, i] = -lead @ diagonal[:, i + 1]
                diagonal[:, i] -= beside[:, i] @ _t(lead)
        return Chain(diagonal, beside)


@dataclass(frozen=True, eq=False)
class Chain:
    """Symmetric positive definite matrices with blocks on the diagonal and beside it.

    Attributes:
      diagonal: shape (n, n_blocks, m, m).
      beside: block i couples blocks i and i + 1, shape (n, n_blocks - 1, m, m).
    """

    diagonal: Array
    beside: Array

    def factor(self) -> Factor:
        """The Cholesky factor."""
        lower, across = np.empty_like(self.diagonal), np.empty_like(self.beside)
        left = self.diagonal[:, 0]
        for i in range(self.diagonal.shape[1]):
            lower[:, i] = np.linalg.inv(np.linalg.cholesky(left))
            if i < across.shape[1]:
                across[:, i] = lower[:, i] @ self.beside[:, i]
                left = self.diagonal[:, i + 1] - _t(across[:, i]) @ across[:, i]
        return Factor(lower, across)


def _t(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)
