"""Small dense linear algebra, written out: products, Cholesky factors, and solves with them."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.native.scalars import BOOL, FLOAT, INT
from apcc_torch.native.values import Arithmetic, Value, mapped
from apcc_torch.shapes import broadcast

Matrix = list[list[int]]


def _matrices(entries: Tensor) -> list[Matrix]:
    return entries.reshape(-1, *entries.shape[-2:]).tolist()


def product(a: Arithmetic, dtype: torch.dtype, x: Value, y: Value) -> Value:
    """x @ y with torch's rules for vectors and broadcast matrices."""
    make = a.scalars.make
    left = x.entries.unsqueeze(0) if x.entries.dim() == 1 else x.entries
    right = y.entries.unsqueeze(-1) if y.entries.dim() == 1 else y.entries
    batch = broadcast(left.shape[:-2], right.shape[:-2])
    n, m = left.shape[-2], right.shape[-1]
    rows = left.expand(*batch, *left.shape[-2:]).unsqueeze(-2).expand(*batch, n, m, left.shape[-1])
    columns = right.mT.expand(*batch, m, right.shape[-2]).unsqueeze(-3).expand(*batch, n, m, right.shape[-2])
    pairs = zip(rows.reshape(-1, rows.shape[-1]).tolist(), columns.reshape(-1, rows.shape[-1]).tolist(), strict=True)
    flat = [a.total([make("mul", p, q) for p, q in zip(row, column, strict=True)]) for row, column in pairs]
    result = torch.tensor(flat, dtype=torch.int64).reshape(*batch, n, m)
    if x.entries.dim() == 1:
        result = result.squeeze(-2)
    return Value(result.squeeze(-1) if y.entries.dim() == 1 else result, dtype)


def cross(a: Arithmetic, dtype: torch.dtype, x: Value, y: Value, dim: int = -1) -> Value:
    """Cross product along a dimension."""
    make = a.scalars.make
    p, q = torch.broadcast_tensors(x.entries, y.entries)
    p, q = p.movedim(dim, 0), q.movedim(dim, 0)

    def minus(i: int, j: int) -> Tensor:
        return mapped(lambda s, t, u, v: make("sub", make("mul", s, t), make("mul", u, v)), p[i], q[j], p[j], q[i])

    return Value(torch.stack((minus(1, 2), minus(2, 0), minus(0, 1))).movedim(0, dim), dtype)


def cholesky(
    a: Arithmetic, dtype: list[torch.dtype], x: Value, upper: bool = False, check_errors: bool = False
) -> list[Value]:
    """Lower factor, and a number that is not zero where a pivot is not positive."""
    make, constant = a.scalars.make, a.scalars.constant
    zero = constant(0.0, FLOAT)
    factors, infos = [], []
    for A in _matrices(x.entries):
        n = len(A)
        L = [[zero] * n for _ in range(n)]
        sound = constant(True, BOOL)
        for j in range(n):
            rest = [A[i][j] for i in range(n)]
            for k in range(j):
                for i in range(j, n):
                    rest[i] = make("sub", rest[i], make("mul", L[i][k], L[j][k]))
            sound = make("and", sound, make("lt", zero, rest[j]))
            L[j][j] = make("sqrt", rest[j])
            inverse = make("div", constant(1.0, FLOAT), L[j][j])
            for i in range(j + 1, n):
                L[i][j] = make("mul", rest[i], inverse)
        factors.append(L)
        infos.append(make("select", sound, constant(0, INT), constant(1, INT)))
    entries = torch.tensor(factors, dtype=torch.int64).reshape(x.entries.shape)
    return [
        Value(entries.mT if upper else entries, dtype[0]),
        Value(torch.tensor(infos, dtype=torch.int64).reshape(x.entries.shape[:-2]), dtype[1]),
    ]


def cholesky_solve(a: Arithmetic, dtype: torch.dtype, x: Value, factor: Value, upper: bool = False) -> Value:
    """(L L^T)^-1 x by substitution."""
    make, one = a.scalars.make, a.scalars.constant(1.0, FLOAT)
    lower = factor.entries.mT if upper else factor.entries
    batch = broadcast(x.entries.shape[:-2], lower.shape[:-2])
    shape = (*batch, *x.entries.shape[-2:])
    solutions = []
    matrices = _matrices(lower.expand(*batch, *lower.shape[-2:]))
    for L, B in zip(matrices, _matrices(x.entries.expand(shape)), strict=True):
        n = len(L)
        inverse = [make("div", one, L[i][i]) for i in range(n)]
        columns = []
        for column in zip(*B, strict=True):
            y = list(column)
            for i in range(n):
                for k in range(i):
                    y[i] = make("sub", y[i], make("mul", L[i][k], y[k]))
                y[i] = make("mul", y[i], inverse[i])
            for i in reversed(range(n)):
                for k in range(i + 1, n):
                    y[i] = make("sub", y[i], make("mul", L[k][i], y[k]))
                y[i] = make("mul", y[i], inverse[i])
            columns.append(y)
        solutions.append([list(row) for row in zip(*columns, strict=True)])
    return Value(torch.tensor(solutions, dtype=torch.int64).reshape(shape), dtype)


def solve_ex(
    a: Arithmetic, dtype: list[torch.dtype], x: Value, y: Value, left: bool = True, check_errors: bool = False
) -> list[Value]:
    """x^-1 y by elimination with row pivots, and a number that is not zero where x is singular."""
    make, constant = a.scalars.make, a.scalars.constant
    if not left or y.entries.dim() < x.entries.dim():
        raise NotImplementedError("only matrices on the right-hand side are solved for")
    batch = broadcast(x.entries.shape[:-2], y.entries.shape[:-2])
    shape = (*batch, *y.entries.shape[-2:])
    solutions, infos = [], []
    matrices = _matrices(x.entries.expand(*batch, *x.entries.shape[-2:]))
    for A, B in zip(matrices, _matrices(y.entries.expand(shape)), strict=True):
        n = len(A)
        rows = [[*left_row, *right_row] for left_row, right_row in zip(A, B, strict=True)]
        regular = constant(True, BOOL)
        for j in range(n):
            for i in range(j + 1, n):
                # The larger of two pivots comes first; which it is, is known only at run time.
                swap = make("lt", make("abs", rows[j][j]), make("abs", rows[i][j]))
                pairs = list(zip(rows[j], rows[i], strict=True))
                rows[j] = [make("select", swap, q, p) for p, q in pairs]
                rows[i] = [make("select", swap, p, q) for p, q in pairs]
            regular = make("and", regular, make("ne", rows[j][j], constant(0.0, FLOAT)))
            for i in range(j + 1, n):
                factor = make("div", rows[i][j], rows[j][j])
                rows[i] = [make("sub", p, make("mul", factor, q)) for p, q in zip(rows[i], rows[j], strict=True)]
        for j in reversed(range(n)):
            for k in range(n, len(rows[j])):
                rest = rows[j][k]
                for i in range(j + 1, n):
                    rest = make("sub", rest, make("mul", rows[j][i], rows[i][k]))
                rows[j][k] = make("div", rest, rows[j][j])
        solutions.append([row[n:] for row in rows])
        infos.append(make("select", regular, constant(0, INT), constant(1, INT)))
    return [
        Value(torch.tensor(solutions, dtype=torch.int64).reshape(shape), dtype[0]),
        Value(torch.tensor(infos, dtype=torch.int64).reshape(batch), dtype[1]),
    ]
