"""What each tensor operation means in scalar expressions.

The table is keyed by the names of torch's own operations; a name without its overload ("aten.mul" of
"aten.mul.Tensor") stands for all overloads. An operation that only moves entries runs as it is, on the tensor of
indices.
"""

from __future__ import annotations

import torch

from apcc_torch.native.entrywise import (
    addcmul,
    clamp,
    converted,
    entrywise,
    lerp,
    logic,
    masked_fill,
    power,
    reciprocal,
    rsub,
    scaled,
    swapped,
    threshold,
    where,
)
from apcc_torch.native.linear_algebra import cholesky, cholesky_solve, cross, product, solve_ex
from apcc_torch.native.placing import (
    embedded,
    filled,
    filling,
    gather,
    index,
    known,
    known_tensor,
    pad,
    scattered,
    triangle,
)
from apcc_torch.native.reductions import SUM, argmax, cumsum, mean, norm, reduced
from apcc_torch.native.scalars import FLOAT
from apcc_torch.native.values import Operator, Value, kind_of

# Operations that move entries and compute nothing.
MOVES = frozenset({
    "_unsafe_view", "alias", "as_strided", "cat", "clone", "copy_", "detach", "diagonal", "expand", "flip",
    "lift_fresh", "permute", "repeat", "select", "slice", "split", "split_with_sizes", "squeeze", "stack", "t",
    "transpose", "unbind", "unsqueeze", "view",
})  # fmt: skip


OPERATORS: dict[str, Operator] = {
    "aten._to_copy": converted,
    "aten.abs": entrywise("abs"),
    "aten.acos": entrywise("acos", FLOAT),
    "aten.add": scaled("add"),
    "aten.addcmul": addcmul,
    "aten.all": reduced(lambda a, row: a.folded("and", row), True),
    "aten.amax": reduced(lambda a, row: a.folded("max", row)),
    "aten.amin": reduced(lambda a, row: a.folded("min", row)),
    "aten.any": reduced(lambda a, row: a.folded("or", row), False),
    "aten.arange": known_tensor(torch.arange),
    "aten.argmax": argmax("max"),
    "aten.argmin": argmax("min"),
    "aten.asin": entrywise("asin", FLOAT),
    "aten.atan": entrywise("atan", FLOAT),
    "aten.atan2": entrywise("atan2", FLOAT),
    "aten.bitwise_and": logic("and"),
    "aten.bitwise_not": logic("not"),
    "aten.bitwise_or": logic("or"),
    "aten.bmm": product,
    "aten.cholesky_solve": cholesky_solve,
    "aten.clamp": clamp,
    "aten.clamp_max": lambda a, dtype, x, bound: clamp(a, dtype, x, None, bound),
    "aten.clamp_min": lambda a, dtype, x, bound: clamp(a, dtype, x, bound),
    "aten.constant_pad_nd": pad,
    "aten.cos": entrywise("cos", FLOAT),
    "aten.cumsum": cumsum,
    "aten.diag_embed": embedded,
    "aten.diagonal_scatter": scattered,
    "aten.div": entrywise("div", FLOAT),
    "aten.eq": entrywise("eq"),
    "aten.exp": entrywise("exp", FLOAT),
    "aten.eye": known_tensor(torch.eye),
    "aten.expm1": entrywise("expm1", FLOAT),
    "aten.floor": entrywise("floor", FLOAT),
    "aten.full": filled,
    "aten.full_like": filled,
    "aten.gather": gather,
    "aten.ge": swapped("le"),
    "aten.gt": swapped("lt"),
    "aten.index": index,
    "aten.index_select": lambda a, dtype, x, dim, index: Value(x.entries.index_select(dim, known(a, index)), dtype),
    "aten.isfinite": entrywise("isfinite", FLOAT),
    "aten.isnan": lambda a, dtype, x: entrywise("ne", FLOAT)(a, dtype, x, x),
    "aten.le": entrywise("le"),
    "aten.lerp": lerp,
    "aten.linalg_cholesky_ex": cholesky,
    "aten.linalg_cross": cross,
    "aten.linalg_solve_ex": solve_ex,
    "aten.linalg_vector_norm": norm,
    "aten.log": entrywise("log", FLOAT),
    "aten.logical_and": logic("and"),
    "aten.logical_not": logic("not"),
    "aten.logical_or": logic("or"),
    "aten.lt": entrywise("lt"),
    "aten.masked_fill": masked_fill,
    "aten.matmul": product,
    "aten.maximum": entrywise("max"),
    "aten.mean": reduced(mean),
    "aten.minimum": entrywise("min"),
    "aten.mm": product,
    "aten.mul": lambda a, dtype, x, y: a.entrywise(
        lambda p, q: a.scalars.make("mul", p, q), [x, y], kind_of(dtype), dtype
    ),
    "aten.mv": product,
    "aten.ne": entrywise("ne"),
    "aten.neg": entrywise("neg"),
    "aten.new_zeros": lambda a, dtype, x, shape, **_: filled(a, dtype, shape, 0),
    "aten.ones": filling(1),
    "aten.ones_like": filling(1),
    "aten.pow": power,
    "aten.prod": reduced(lambda a, row: a.folded("mul", row), 1.0),
    "aten.reciprocal": reciprocal,
    "aten.relu": lambda a, dtype, x: clamp(a, dtype, x, 0),
    "aten.rsub": rsub,
    "aten.rsqrt": lambda a, dtype, x: reciprocal(a, dtype, entrywise("sqrt", FLOAT)(a, dtype, x)),
    "aten.scalar_tensor": lambda a, dtype, value, **_: filled(a, dtype, (), value),
    "aten.sin": entrywise("sin", FLOAT),
    "aten.sqrt": entrywise("sqrt", FLOAT),
    "aten.sub": scaled("sub"),
    "aten.sum": SUM,
    "aten.tan": entrywise("tan", FLOAT),
    "aten.tanh": entrywise("tanh", FLOAT),
    "aten.threshold": threshold,
    "aten.tril": triangle("lower"),
    "aten.triu": triangle("upper"),
    "aten.where": where,
    "aten.zeros": filling(0),
    "aten.zeros_like": filling(0),
}
