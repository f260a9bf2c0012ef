"""Laws that every public operation obeys, and the random inputs they are tried on.

An argument or a result is a tensor, a tuple or NamedTuple of these, or anything else, which is passed through as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from hypothesis import strategies as st
from torch import Tensor

from apcc_torch.native.structure import flattened

FLOATS = (torch.float32, torch.float64)
SHAPES: tuple[tuple[int, ...], ...] = ((), (1,), (3, 2))
# (relative, absolute) agreement of two orders of the same float operations, for values of order one.
TOLERANCE = {torch.float32: (1e-4, 1e-5), torch.float64: (1e-10, 1e-12)}

Op = Callable[..., Any]
MakeInputs = Callable[[tuple[int, ...], torch.dtype, torch.Generator], tuple[Any, ...]]

# Seeds of generators and leading shapes, for property tests.
seeds = st.integers(0, 2**31 - 1)
shapes = st.lists(st.integers(1, 3), max_size=2).map(tuple)
floats = st.sampled_from(FLOATS)


def generator(seed: int = 0) -> torch.Generator:
    """A generator of its own for one test."""
    return torch.Generator().manual_seed(seed)


def leaves(tree: Any) -> list[Tensor]:
    """All tensors of a tree, in order."""
    if isinstance(tree, Tensor):
        return [tree]
    if isinstance(tree, list | tuple):
        return [leaf for branch in tree for leaf in leaves(branch)]
    return []


def map_leaves(change: Callable[[Tensor], Tensor], tree: Any) -> Any:
    """The same tree with every tensor changed."""
    if isinstance(tree, Tensor):
        return change(tree)
    if isinstance(tree, list | tuple):
        branches = [map_leaves(change, branch) for branch in tree]
        return type(tree)(*branches) if hasattr(tree, "_fields") else type(tree)(branches)
    return tree


def bits(value: Tensor) -> Tensor:
    """The tensor's bits as integers, so that NaN equals itself and 0 differs from -0."""
    if not value.is_floating_point():
        return value
    whole = {2: torch.int16, 4: torch.int32, 8: torch.int64}[value.element_size()]
    return value.detach().clone(memory_format=torch.contiguous_format).view(whole)


def _assert_close(have: Any, want: Any, scale: float, what: str) -> None:
    have_leaves, want_leaves = leaves(have), leaves(want)
    assert len(have_leaves) == len(want_leaves), what
    for i, (a, b) in enumerate(zip(have_leaves, want_leaves, strict=True)):
        rtol, atol = (scale * t for t in TOLERANCE[b.dtype]) if b.is_floating_point() else (0.0, 0.0)
        torch.testing.assert_close(
            a, b, rtol=rtol, atol=atol, equal_nan=True, msg=lambda m, i=i: f"{what}, output {i}: {m}"
        )


def _call(op: Op, inputs: tuple[Any, ...], what: str) -> Any:
    """Calls op and checks that it wrote into none of its inputs, and that dtype and device follow them."""
    before = [leaf.clone() for leaf in leaves(inputs)]
    result = op(*inputs)
    for i, (was, now) in enumerate(zip(before, leaves(inputs), strict=True)):
        assert was.shape == now.shape and torch.equal(bits(was), bits(now)), f"{what} wrote into input {i}"
    given = next(leaf for leaf in leaves(inputs) if leaf.is_floating_point())
    for i, leaf in enumerate(leaves(result)):
        assert leaf.device == given.device, f"{what}: output {i} moved to {leaf.device}"
        assert not leaf.is_floating_point() or leaf.dtype == given.dtype, f"{what}: output {i} became {leaf.dtype}"
    return result


def check_batching(
    op: Op,
    make_inputs: MakeInputs,
    dtypes: Sequence[torch.dtype] = FLOATS,
    *,
    shared: Sequence[int] = (),
    shapes: Sequence[tuple[int, ...]] = SHAPES,
    scale: float = 1.0,
    seed: int = 0,
    device: str = "cpu",
) -> None:
    """Checks that op treats leading dimensions as a batch: rows do not mix, shape and dtype follow the inputs.

    Args:
        op: Takes the inputs, returns a tree of tensors, each with the batch's leading dimensions first.
        make_inputs: (shape, dtype, generator) -> inputs, every tensor with leading dimensions `shape`.
        dtypes: Floating dtypes to try.
        shared: Indices of arguments that may also come without any leading dimension, for the whole batch.
        shapes: Leading shapes to try.
        scale: Factor on the tolerances, for ill-conditioned operations or large values.
        seed: Of the inputs' generator.
        device: Where the inputs are put.
    """
    for dtype in dtypes:
        for shape in shapes:
            what = f"{getattr(op, '__name__', 'op')} {shape} {dtype}"
            inputs = map_leaves(lambda leaf: leaf.to(device), make_inputs(shape, dtype, generator(seed)))
            result = _call(op, inputs, what)
            for i, leaf in enumerate(leaves(result)):
                assert tuple(leaf.shape[: len(shape)]) == shape, f"{what}: output {i} has shape {tuple(leaf.shape)}"

            def flatten(leaf: Tensor, n: int = len(shape)) -> Tensor:
                return leaf.reshape(-1, *leaf.shape[n:])

            _assert_close(_call(op, map_leaves(flatten, inputs), what), map_leaves(flatten, result), scale, what)
            for index in _corners(shape):
                row = map_leaves(lambda leaf, index=index: leaf[index], inputs)
                want = map_leaves(lambda leaf, index=index: leaf[index], result)
                _assert_close(_call(op, row, what), want, scale, f"{what}, row {index}")
            for k in shared:
                _check_shared(op, inputs, k, shape, scale, what)


def _corners(shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    return sorted({tuple(0 for _ in shape), tuple(n - 1 for n in shape)})


def _check_shared(op: Op, inputs: tuple[Any, ...], k: int, shape: tuple[int, ...], scale: float, what: str) -> None:
    """One row of argument k, given bare, acts as that row repeated over the batch."""
    bare = map_leaves(lambda leaf: leaf[(0,) * len(shape)], inputs[k])
    repeated = map_leaves(lambda leaf: leaf.expand((*shape, *leaf.shape)).clone(), bare)
    have = _call(op, (*inputs[:k], bare, *inputs[k + 1 :]), what)
    want = op(*inputs[:k], repeated, *inputs[k + 1 :])
    _assert_close(have, want, scale, f"{what}, argument {k} shared")


def check_bad_row(op: Op, inputs: tuple[Any, ...], *, row: int = 1, arguments: Sequence[int] | None = None) -> None:
    """Checks that a row of NaN leaves every other row as it was, bit for bit.

    Args:
        op: Takes the inputs, returns a tree of tensors with the batch first.
        inputs: Every tensor has one leading batch dimension, longer than `row`.
        row: The row that goes bad.
        arguments: Which arguments go bad, each alone and then all together; default all of them.
    """

    def poison(leaf: Tensor) -> Tensor:
        bad = leaf.clone()
        if bad.is_floating_point():
            bad[row] = torch.nan
        return bad

    chosen = list(range(len(inputs)) if arguments is None else arguments)
    good = leaves(op(*inputs))
    others = [i for i in range(good[0].shape[0]) if i != row]
    for poisoned in [*([k] for k in chosen), chosen]:
        bad_inputs = tuple(map_leaves(poison, x) if k in poisoned else x for k, x in enumerate(inputs))
        for i, (was, now) in enumerate(zip(good, leaves(op(*bad_inputs)), strict=True)):
            assert torch.equal(bits(was[others]), bits(now[others])), f"NaN in row {row} of {poisoned}: output {i}"


def check_gradients(op: Op, *inputs: Tensor, second: bool = True, atol: float = 1e-6, rtol: float = 1e-5) -> None:
    """Checks op's gradient, and the gradient of its gradient, against finite differences in float64."""
    doubles = tuple(x.detach().to(torch.float64).clone().requires_grad_() for x in inputs)
    assert torch.autograd.gradcheck(op, doubles, atol=atol, rtol=rtol)
    if second:
        assert torch.autograd.gradgradcheck(op, doubles, atol=atol, rtol=rtol)


def uniform(shape: Sequence[int], low: float, high: float, dtype: torch.dtype, rng: torch.Generator) -> Tensor:
    """Uniform numbers in [low, high); the same numbers, rounded, for every dtype."""
    drawn = torch.rand(tuple(shape), generator=rng, dtype=torch.float64)
    return (low + (high - low) * drawn).to(dtype)


def normal(shape: Sequence[int], dtype: torch.dtype, rng: torch.Generator) -> Tensor:
    """Standard normal numbers; the same numbers, rounded, for every dtype."""
    return torch.randn(tuple(shape), generator=rng, dtype=torch.float64).to(dtype)


def unit_vectors(shape: Sequence[int], dtype: torch.dtype, rng: torch.Generator) -> Tensor:
    """Directions (*shape, 3) spread evenly over the sphere."""
    return torch.nn.functional.normalize(normal((*shape, 3), torch.float64, rng), dim=-1).to(dtype)


def rotation_vectors(shape: Sequence[int], dtype: torch.dtype, rng: torch.Generator, max_angle: float = 3.0) -> Tensor:
    """Rotation vectors (*shape, 3) of evenly spread axis and angle, rad."""
    angle = uniform((*shape, 1), 0.0, max_angle, torch.float64, rng)
    return (angle * unit_vectors(shape, torch.float64, rng)).to(dtype)


def twists(shape: Sequence[int], dtype: torch.dtype, rng: torch.Generator, max_angle: float = 3.0) -> Tensor:
    """Twists (*shape, 6): a rotation vector, rad, and a linear part of order one, m."""
    return torch.cat((rotation_vectors(shape, dtype, rng, max_angle), normal((*shape, 3), dtype, rng)), dim=-1)


def rotations(shape: Sequence[int], dtype: torch.dtype, rng: torch.Generator) -> Tensor:
    """Rotation matrices (*shape, 3, 3), made from unit quaternions without any code under test."""
    q = torch.nn.functional.normalize(normal((*shape, 4), torch.float64, rng), dim=-1)
    w, v = q[..., 0, None, None], q[..., 1:]
    outer = v.unsqueeze(-1) * v.unsqueeze(-2)
    eye = torch.eye(3, dtype=torch.float64)
    cross = torch.linalg.cross(eye.expand(*shape, 3, 3), v.unsqueeze(-2), dim=-1)  # rows e_i x v: the matrix of v x
    return ((2.0 * w * w - 1.0) * eye + 2.0 * outer + 2.0 * w * cross).to(dtype)


def poses(shape: Sequence[int], dtype: torch.dtype, rng: torch.Generator) -> Tensor:
    """Poses (*shape, 4, 4) with positions of order one, m."""
    pose = torch.eye(4, dtype=torch.float64).expand(*shape, 4, 4).clone()
    pose[..., :3, :3] = rotations(shape, torch.float64, rng)
    pose[..., :3, 3] = normal((*shape, 3), torch.float64, rng)
    return pose.to(dtype)


def worst(have: Any, want: Any) -> float:
    """Largest difference, of large numbers (rates, forces) relative to the largest of them."""
    pairs = [(a.double(), b.double()) for a, b in zip(flattened(have), flattened(want), strict=True)]
    return max(float((a - b).abs().max() / b.abs().max().clamp(min=1.0)) for a, b in pairs if b.numel())
