"""The inner loop of the Allan variance in vectors of eight: squared second differences of several lags in one pass.

Left alone, a compiler takes one lag at a time, in vectors half as wide as many processors have. Here several lags share
the loads of ``theta[m]``, and vectors of a stated width are used whole: twice to three times the terms per second. Where
the processor has shorter vectors, the compiler splits these. The order of additions is the same on every machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from gyrostab.kernels.compiled import KERNEL

__all__ = ["LANES", "TOGETHER", "split_sums"]

#: Elements of a vector.
LANES = 8
#: Most lags in one pass.
TOGETHER = 4

_INDEX = ir.IntType(64)
_SHORT = ir.IntType(32)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_INDICES = ir.VectorType(_INDEX, LANES)
# Vectors per turn of the loop: with few lags additions would wait for each other.
_STEPS = {1: 4, 2: 2, 3: 1, 4: 1}
_FAST = ("reassoc", "contract", "nsz")


def _places(places: list[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(_SHORT, len(places)), places)


def _splat(builder: Any, value: Any) -> Any:
    empty = ir.Constant(_INDICES, ir.Undefined)
    return builder.shuffle_vector(builder.insert_element(empty, value, ir.Constant(_SHORT, 0)), empty, _places([0] * LANES))


def _extreme(builder: Any, values: list[Any], sign: str) -> Any:
    found = values[0]
    for value in values[1:]:
        found = builder.select(builder.icmp_signed(sign, value, found), value, found)
    return found


@contextmanager
def _while(builder: Any, goes_on: Callable[[], Any]) -> Iterator[None]:
    test, body, after = (builder.append_basic_block() for _ in range(3))
    builder.branch(test)
    builder.position_at_end(test)
    builder.cbranch(goes_on(), body, after)
    builder.position_at_end(body)
    yield
    builder.branch(test)
    builder.position_at_end(after)


def _differences(builder: Any, theta: Any, at: Any, lags: list[Any]) -> list[Any]:
    """Second differences of each lag at ``at ... at + LANES - 1``."""

    def load(index: Any) -> Any:
        return builder.load(builder.bitcast(builder.gep(theta, [index]), _DOUBLES.as_pointer()), align=8)

    first, minus_two = load(at), ir.Constant(_DOUBLES, [-2.0] * LANES)
    found = []
    for lag in lags:
        middle, last = load(builder.add(at, lag)), load(builder.add(at, builder.add(lag, lag)))
        outer = builder.fadd(builder.fmul(middle, minus_two, flags=_FAST), last, flags=_FAST)
        found.append(builder.fadd(outer, first, flags=_FAST))
    return found


def _add_square(builder: Any, where: Any, value: Any) -> None:
    builder.store(builder.fadd(builder.load(where), builder.fmul(value, value, flags=_FAST), flags=_FAST), where)


def _halves(builder: Any, first: Any, second: Any, width: int) -> Any:
    """Two vectors as one: in each group of `width` elements the halves are added, those of the two vectors side by side."""
    low = [at for at in range(2 * LANES) if at % width < width // 2]
    left, right = (builder.shuffle_vector(first, second, _places([at + by for at in low])) for by in (0, width // 2))
    return builder.fadd(left, right)


def _totals(builder: Any, sums: list[list[Any]]) -> Any:
    """Sums of all elements of eight vectors as one vector, halves first; each vector is given in parts."""
    vectors = []
    for parts in sums:
        vector = builder.load(parts[0])
        for part in parts[1:]:
            vector = builder.fadd(vector, builder.load(part))
        vectors.append(vector)
    width = LANES
    while len(vectors) > 1:
        vectors = [_halves(builder, vectors[at], vectors[at + 1], width) for at in range(0, len(vectors), 2)]
        width //= 2
    return vectors[0]


def _loop(builder: Any, theta: Any, lags: list[Any], splits: list[Any], sizes: list[Any]) -> list[Any]:
    """Sums of every lag over ``m < split``, then those over ``split <= m < size``."""
    steps = _STEPS[len(lags)]
    nothing = ir.Constant(_DOUBLES, [0.0] * LANES)
    heads, tails = ([[cgutils.alloca_once(builder, _DOUBLES) for _ in range(steps)] for _ in lags] for _ in range(2))
    for place in [place for sums in heads + tails for place in sums]:
        builder.store(nothing, place)
    position = cgutils.alloca_once(builder, _INDEX)
    builder.store(ir.Constant(_INDEX, 0), position)
    first_split, last_split = _extreme(builder, splits, "<"), _extreme(builder, splits, ">")
    first_size, last_size = _extreme(builder, sizes, "<"), _extreme(builder, sizes, ">")
    wide_splits, wide_sizes = ([_splat(builder, value) for value in values] for values in (splits, sizes))

    def advanced(by: int) -> Any:
        return builder.add(builder.load(position), ir.Constant(_INDEX, by))

    def whole_vectors(limit: Any, sums: list[list[Any]]) -> None:
        with _while(builder, lambda: builder.icmp_signed("<=", advanced(steps * LANES), limit)):
            for step in range(steps):
                for lag, value in enumerate(_differences(builder, theta, advanced(step * LANES), lags)):
                    _add_square(builder, sums[lag][step], value)
            builder.store(advanced(steps * LANES), position)

    with _while(builder, lambda: builder.icmp_signed("<", builder.load(position), last_size)):
        whole_vectors(first_split, heads)
        with builder.if_then(builder.icmp_signed(">=", builder.load(position), last_split)):
            whole_vectors(first_size, tails)
        with builder.if_then(builder.icmp_signed("<", builder.load(position), last_size)):
            at = builder.load(position)
            index = builder.add(_splat(builder, at), ir.Constant(_INDICES, list(range(LANES))))
            for lag, value in enumerate(_differences(builder, theta, at, lags)):
                before = builder.icmp_signed("<", index, wide_splits[lag])
                inside = builder.icmp_signed("<", index, wide_sizes[lag])
                value = builder.select(inside, value, nothing)
                _add_square(builder, heads[lag][0], builder.select(before, value, nothing))
                _add_square(builder, tails[lag][0], builder.select(before, nothing, value))
            builder.store(advanced(LANES), position)
    # eight rows, those that no lag has filled with those of another
    rows = [sums[lag % len(lags)] for sums in (heads, tails) for lag in range(LANES // 2)]
    found = _totals(builder, rows)
    places = [lag + part * LANES // 2 for part in range(2) for lag in range(len(lags))]
    return [builder.extract_element(found, ir.Constant(_SHORT, place)) for place in places]


def _of_lags(count: int) -> Any:
    """The loop for `count` lags as a function for compiled code, arguments as `split_sums`."""

    def sums(typing_context, theta, first, lags, at, splits, sizes, out):  # type: ignore[no-untyped-def]
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            starts = [
                context.make_array(kind)(context, builder, value).data
                for kind, value in zip(signature.args, args, strict=True)
                if isinstance(kind, types.Array)
            ]
            theta, integers, out = builder.gep(starts[0], [args[1]]), starts[1:4], starts[4]
            integers[0] = builder.gep(integers[0], [args[3]])

            def place(start: Any, i: int) -> Any:
                return builder.gep(start, [ir.Constant(_INDEX, i)])

            values = [[builder.load(place(start, i)) for i in range(count)] for start in integers]
            for i, total in enumerate(_loop(builder, theta, *values)):
                builder.store(total, place(out, i))
            return context.get_dummy_value()

        return types.void(theta, types.int64, lags, types.int64, splits, sizes, out), generate

    return intrinsic(sums)


_one, _two, _three, _four = (_of_lags(count) for count in range(1, TOGETHER + 1))


@njit(**KERNEL)
def split_sums(theta, first, count, lags, at, splits, sizes, out):  # type: ignore[no-untyped-def]
    """Sums of squared second differences of one to four lags from one place on, in two parts.

    Parameters
    ----------
    theta : float64 (n,)
        Angle, contiguous. Elements up to ``first + max(sizes) + 2 * max(lags) + LANES`` are read; those that no term needs may
        have any value.
    first : int
        Index of m = 0.
    count : int
        Number of lags, 1 to `TOGETHER`.
    lags, at : int64 (n_lags,), int
        Averaging factors, used from number `at` on.
    splits, sizes : int64 (count,)
        Terms of the head, ``m < split``; terms of head and tail, ``split <= m < size``.
    out : float64 (2 * count,)
        Overwritten: heads, then tails.
    """
    if count == 4:
        _four(theta, first, lags, at, splits, sizes, out)
    elif count == 3:
        _three(theta, first, lags, at, splits, sizes, out)
    elif count == 2:
        _two(theta, first, lags, at, splits, sizes, out)
    else:
        _one(theta, first, lags, at, splits, sizes, out)
