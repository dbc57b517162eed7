"""Cholesky's decomposition of a small matrix."""

from __future__ import annotations

import math

from ompl_ext.arrays import Matrix
from ompl_ext.jit import part


@part
def factorise(matrix: Matrix, size: int, least: float) -> bool:
    """Cholesky's decomposition in place; false if a pivot is not above `least`: the matrix is not positive definite."""
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j and not total > least:
                return False
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]
    return True


@part
def solve_factorised(matrix: Matrix, size: int, right: Matrix, columns: int) -> None:
    """Solve in place for several right-hand sides (size, columns), given the factor."""
    for i in range(size):
        for k in range(i):
            for column in range(columns):
                right[i, column] -= matrix[i, k] * right[k, column]
        for column in range(columns):
            right[i, column] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            for column in range(columns):
                right[i, column] -= matrix[k, i] * right[k, column]
        for column in range(columns):
            right[i, column] /= matrix[i, i]
