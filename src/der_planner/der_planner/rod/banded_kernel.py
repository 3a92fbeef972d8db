"""Banded linear algebra without pivoting, for the matrices of a chain of nodes.

A symmetric matrix of half-bandwidth b is stored by columns: s[j, k] = A[j+k, j], k = 0 … b. A
general one is stored by rows: a[i, k] = A[i, i+k-b], k = 0 … 2b.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from der_planner.arrays import Array
from der_planner.rod.compile import kernel


def _symmetric_solver(b: int) -> Callable[[Array, Array], float]:
    """Return a kernel for half-bandwidth b; with b a constant its inner loops are unrolled."""

    @kernel
    def solve(s: Array, r: Array) -> float:
        n = r.shape[0]
        least = np.inf
        for j in range(n - b):
            pivot = s[j, 0]
            least = min(least, pivot)
            inverse = 1.0 / pivot
            rj = r[j]
            for i in range(1, b + 1):
                factor = s[j, i] * inverse
                for k in range(i, b + 1):
                    s[j + i, k - i] -= factor * s[j, k]
                r[j + i] -= factor * rj
            s[j, 0] = inverse
        for j in range(n - b, n):
            pivot = s[j, 0]
            least = min(least, pivot)
            inverse = 1.0 / pivot
            for i in range(1, n - j):
                factor = s[j, i] * inverse
                for k in range(i, n - j):
                    s[j + i, k - i] -= factor * s[j, k]
                r[j + i] -= factor * r[j]
            s[j, 0] = inverse
        for j in range(n - 1, n - b - 1, -1):
            total = r[j]
            for i in range(1, n - j):
                total -= s[j, i] * r[j + i]
            r[j] = total * s[j, 0]
        for j in range(n - b - 1, -1, -1):
            total = r[j]
            for i in range(1, b + 1):
                total -= s[j, i] * r[j + i]
            r[j] = total * s[j, 0]
        return least

    return solve


# Factor s (n, b+1) into LDLᵀ in place, solve into r (n,), return the smallest pivot.
solve_5 = _symmetric_solver(5)
solve_10 = _symmetric_solver(10)


@kernel
def put(source: Array, target: Array) -> None:
    """Copy a vector (numba compiles a loop far faster than a slice assignment)."""
    for k in range(source.shape[0]):
        target[k] = source[k]


@kernel
def hold_fixed(s: Array, r: Array, fixed: Array) -> None:
    """Replace the equations of fixed unknowns in s, r by "no change"."""
    b = s.shape[1] - 1
    for d in fixed:
        r[d] = 0.0
        s[d, 0] = 1.0
        for k in range(1, b + 1):
            s[d, k] = 0.0
            if d - k >= 0:
                s[d - k, k] = 0.0


@kernel
def expand(s: Array, a: Array) -> None:
    """Write the symmetric band s (n, b+1) as a general band a (n, 2b+1)."""
    n = s.shape[0]
    b = s.shape[1] - 1
    a[:] = 0.0
    for j in range(n):
        a[j, b] = s[j, 0]
        for k in range(1, min(b, n - 1 - j) + 1):
            a[j, b + k] = s[j, k]
            a[j + k, b - k] = s[j, k]


@kernel
def hold_rows(a: Array, fixed: Array, diagonal: float) -> None:
    """Replace the rows of fixed unknowns in a general band by `diagonal` times the unknown."""
    b = (a.shape[1] - 1) // 2
    for d in fixed:
        for k in range(2 * b + 1):
            a[d, k] = 0.0
        a[d, b] = diagonal


@kernel
def factor_general(a: Array) -> None:
    """Replace a general band by L (unit diagonal) and U (its diagonal inverted)."""
    n = a.shape[0]
    b = (a.shape[1] - 1) // 2
    for j in range(n):
        inverse = 1.0 / a[j, b]
        a[j, b] = inverse
        for i in range(j + 1, min(n, j + b + 1)):
            factor = a[i, b + j - i] * inverse
            a[i, b + j - i] = factor
            for k in range(1, b + 1):
                a[i, b + j - i + k] -= factor * a[j, b + k]


@kernel
def add_product(a: Array, x: Array, y: Array) -> None:
    """Add A x to y for a general band a and the columns of x, y (n, C)."""
    n = a.shape[0]
    b = (a.shape[1] - 1) // 2
    for i in range(n):
        for k in range(max(0, i - b), min(n, i + b + 1)):
            value = a[i, k - i + b]
            if value != 0.0:
                for c in range(x.shape[1]):
                    y[i, c] += value * x[k, c]


@kernel
def solve_columns(a: Array, x: Array) -> None:
    """Solve L U y = x in place for the columns of x (n, C)."""
    n = a.shape[0]
    b = (a.shape[1] - 1) // 2
    columns = x.shape[1]
    for i in range(n):
        for k in range(max(0, i - b), i):
            factor = a[i, k - i + b]
            for c in range(columns):
                x[i, c] -= factor * x[k, c]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, min(n, i + b + 1)):
            factor = a[i, k - i + b]
            for c in range(columns):
                x[i, c] -= factor * x[k, c]
        inverse = a[i, b]
        for c in range(columns):
            x[i, c] *= inverse
