"""The inner loop of the Allan variance in LLVM vectors of eight, several lags in one pass.

Left alone, a compiler takes one lag at a time, in vectors half as wide as many processors have.
Here several lags share the loads of ``theta[m]``, and vectors of a stated width are used whole:
twice to three times the terms per second. Most of the time then goes to loads that begin in one
line of the cache and end in the next. Lags that follow each other need few of these, as each takes
its elements out of two vectors that all of them share. Where the processor has shorter vectors, the
compiler splits these. The order of additions is the same on every machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from gyrostab.kernels.allan.plain_sums import CONSECUTIVE_LAGS, LANES, MAX_LAGS
from gyrostab.kernels.compiled import KERNEL

_INDEX = ir.IntType(64)
_SHORT = ir.IntType(32)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_INDICES = ir.VectorType(_INDEX, LANES)
# Vectors per turn of the loop: with few lags additions would wait for each other.
_VECTORS_PER_TURN = {1: 4, 2: 2, 3: 1, 4: 1}
_FAST = ("reassoc", "contract", "nsz")


def _shuffle_mask(places: list[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(_SHORT, len(places)), places)


def _spread_value(builder: Any, value: Any) -> Any:
    empty = ir.Constant(_INDICES, ir.Undefined)
    return builder.shuffle_vector(
        builder.insert_element(empty, value, ir.Constant(_SHORT, 0)),
        empty,
        _shuffle_mask([0] * LANES),
    )


def _select_extreme(builder: Any, values: list[Any], sign: str) -> Any:
    extreme = values[0]
    for value in values[1:]:
        extreme = builder.select(builder.icmp_signed(sign, value, extreme), value, extreme)
    return extreme


@contextmanager
def _while_loop(builder: Any, goes_on: Callable[[], Any]) -> Iterator[None]:
    test, body, after = (builder.append_basic_block() for _ in range(3))
    builder.branch(test)
    builder.position_at_end(test)
    builder.cbranch(goes_on(), body, after)
    builder.position_at_end(body)
    yield
    builder.branch(test)
    builder.position_at_end(after)


def _load_vector(builder: Any, theta: Any, index: Any) -> Any:
    return builder.load(
        builder.bitcast(builder.gep(theta, [index]), _DOUBLES.as_pointer()), align=8
    )


def _second_difference(builder: Any, first: Any, middle: Any, last: Any) -> Any:
    minus_two = ir.Constant(_DOUBLES, [-2.0] * LANES)
    return builder.fadd(
        builder.fadd(builder.fmul(middle, minus_two, flags=_FAST), last, flags=_FAST),
        first,
        flags=_FAST,
    )


def _second_differences(builder: Any, theta: Any, at: Any, lags: list[Any]) -> list[Any]:
    """Second differences of each lag at ``at ... at + LANES - 1``."""
    first = _load_vector(builder, theta, at)
    differences = []
    for lag in lags:
        middle = _load_vector(builder, theta, builder.add(at, lag))
        last = _load_vector(builder, theta, builder.add(at, builder.add(lag, lag)))
        differences.append(_second_difference(builder, first, middle, last))
    return differences


def _consecutive_differences(builder: Any, theta: Any, at: Any, lags: list[Any]) -> list[Any]:
    """The same of lags that follow each other."""
    last_needed = len(lags) + LANES - 2

    def vectors(index: Any, reach: int) -> list[Any]:
        return [
            _load_vector(builder, theta, builder.add(index, ir.Constant(_INDEX, by)))
            for by in range(0, reach + 1, LANES)
        ]

    def taken(loaded: list[Any], by: int) -> Any:
        place, by = divmod(by, LANES)
        return (
            builder.shuffle_vector(
                loaded[place], loaded[place + 1], _shuffle_mask(list(range(by, by + LANES)))
            )
            if by
            else loaded[place]
        )

    first = _load_vector(builder, theta, at)
    middles = vectors(builder.add(at, lags[0]), last_needed)
    lasts = vectors(builder.add(at, builder.add(lags[0], lags[0])), last_needed + len(lags) - 1)
    return [
        _second_difference(builder, first, taken(middles, i), taken(lasts, 2 * i))
        for i in range(len(lags))
    ]


def _add_square(builder: Any, place: Any, value: Any, where: Any = None) -> None:
    before = builder.load(place)
    after = builder.fadd(before, builder.fmul(value, value, flags=_FAST), flags=_FAST)
    builder.store(after if where is None else builder.select(where, after, before), place)


def _add_halves(builder: Any, first: Any, second: Any, width: int) -> Any:
    """Add the halves of each group of `width` elements of two vectors, into one vector."""
    low = [at for at in range(2 * LANES) if at % width < width // 2]
    left, right = (
        builder.shuffle_vector(first, second, _shuffle_mask([at + by for at in low]))
        for by in (0, width // 2)
    )
    return builder.fadd(left, right)


def _sum_vectors(builder: Any, sums: list[list[Any]]) -> Any:
    """Sum the elements of eight vectors into one vector, halves first; vectors come in parts."""
    vectors = []
    for parts in sums:
        vector = builder.load(parts[0])
        for part in parts[1:]:
            vector = builder.fadd(vector, builder.load(part))
        vectors.append(vector)
    width = LANES
    while len(vectors) > 1:
        vectors = [
            _add_halves(builder, vectors[at], vectors[at + 1], width)
            for at in range(0, len(vectors), 2)
        ]
        width //= 2
    return vectors[0]


def _sum_heads_and_tails(builder: Any, heads: list[list[Any]], tails: list[list[Any]]) -> list[Any]:
    """Sums of all elements of each vector, as one vector for the heads and one for the tails."""
    count = len(heads)
    if 2 * count > LANES:
        return [_sum_vectors(builder, sums) for sums in (heads, tails)]
    vectors = heads + tails
    # the remaining lanes are filled with any
    totals = _sum_vectors(builder, [vectors[place % len(vectors)] for place in range(LANES)])
    return [
        builder.shuffle_vector(totals, totals, _shuffle_mask(list(range(begin, begin + count))))
        for begin in (0, count)
    ]


def _emit_loop(
    builder: Any,
    theta: Any,
    lags: list[Any],
    splits: list[Any],
    sizes: list[Any],
    *,
    in_a_row: bool,
) -> list[Any]:
    """Vector with the sum of every lag over ``m < split``, and that over ``split <= m < size``."""
    steps = 1 if in_a_row else _VECTORS_PER_TURN[len(lags)]
    differences = _consecutive_differences if in_a_row else _second_differences
    nothing = ir.Constant(_DOUBLES, [0.0] * LANES)
    heads, tails = (
        [[cgutils.alloca_once(builder, _DOUBLES) for _ in range(steps)] for _ in lags]
        for _ in range(2)
    )
    for place in [place for sums in heads + tails for place in sums]:
        builder.store(nothing, place)
    position = cgutils.alloca_once(builder, _INDEX)
    builder.store(ir.Constant(_INDEX, 0), position)
    first_split = _select_extreme(builder, splits, "<")
    last_split = _select_extreme(builder, splits, ">")
    first_size = _select_extreme(builder, sizes, "<")
    last_size = _select_extreme(builder, sizes, ">")
    wide_splits, wide_sizes = (
        [_spread_value(builder, value) for value in values] for values in (splits, sizes)
    )

    def advanced(by: int) -> Any:
        return builder.add(builder.load(position), ir.Constant(_INDEX, by))

    def whole_vectors(limit: Any, sums: list[list[Any]]) -> None:
        with _while_loop(
            builder, lambda: builder.icmp_signed("<=", advanced(steps * LANES), limit)
        ):
            for step in range(steps):
                for lag, value in enumerate(
                    differences(builder, theta, advanced(step * LANES), lags)
                ):
                    _add_square(builder, sums[lag][step], value)
            builder.store(advanced(steps * LANES), position)

    with _while_loop(builder, lambda: builder.icmp_signed("<", builder.load(position), last_size)):
        whole_vectors(first_split, heads)
        with builder.if_then(builder.icmp_signed(">=", builder.load(position), last_split)):
            whole_vectors(first_size, tails)
        with builder.if_then(builder.icmp_signed("<", builder.load(position), last_size)):
            at = builder.load(position)
            index = builder.add(
                _spread_value(builder, at), ir.Constant(_INDICES, list(range(LANES)))
            )
            for lag, value in enumerate(differences(builder, theta, at, lags)):
                in_head = builder.icmp_signed("<", index, wide_splits[lag])
                inside = builder.icmp_signed("<", index, wide_sizes[lag])
                _add_square(builder, heads[lag][0], value, where=in_head)
                _add_square(
                    builder, tails[lag][0], value, where=builder.and_(inside, builder.not_(in_head))
                )
            builder.store(advanced(LANES), position)
    return _sum_heads_and_tails(builder, heads, tails)


def _intrinsic_of_lags(count: int, *, in_a_row: bool = False) -> Any:
    """The loop for `count` lags as a function for compiled code, arguments as `split_sums`."""

    def sums(typing_context, theta, first, lags, at, splits, sizes, heads, tails, place):  # type: ignore[no-untyped-def]
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            arrays = zip(signature.args, args, strict=True)
            starts = [
                context.make_array(kind)(context, builder, value).data
                for kind, value in arrays
                if isinstance(kind, types.Array)
            ]
            theta, lags = builder.gep(starts[0], [args[1]]), builder.gep(starts[1], [args[3]])
            values = [
                [builder.load(builder.gep(start, [ir.Constant(_INDEX, i)])) for i in range(count)]
                for start in (lags, starts[2], starts[3])
            ]
            pointer_type = ir.VectorType(ir.DoubleType(), count).as_pointer()
            for total, start in zip(
                _emit_loop(builder, theta, *values, in_a_row=in_a_row), starts[4:], strict=True
            ):
                row = builder.bitcast(builder.gep(start, [args[8]]), pointer_type)
                builder.store(builder.fadd(builder.load(row, align=8), total), row, align=8)
            return context.get_dummy_value()

        return types.void(
            theta, types.int64, lags, types.int64, splits, sizes, heads, tails, types.int64
        ), generate

    return intrinsic(sums)


_one, _two, _three, _four = (_intrinsic_of_lags(count) for count in range(1, MAX_LAGS + 1))
_eight_in_a_row = _intrinsic_of_lags(CONSECUTIVE_LAGS, in_a_row=True)


@njit(**KERNEL)
def split_sums(theta, first, count, lags, at, splits, sizes, heads, tails, place):  # type: ignore[no-untyped-def]
    """Add squared second differences of one to four lags, or eight consecutive ones, in two parts.

    Parameters
    ----------
    theta : float64 (n,)
        Angle, contiguous. Elements below ``first + max(sizes) + 2 * max(lags) + 2 * LANES`` are
        read; those that no term needs may have any value.
    first : int
        Index of m = 0.
    count : int
        Number of lags: 1 to `MAX_LAGS`, or `CONSECUTIVE_LAGS`.
    lags, at : int64 (n_lags,), int
        Averaging factors, rising, used from number `at` on.
    splits, sizes : int64 (count,)
        Terms of the head, ``m < split``; terms of head and tail, ``split <= m < size``.
    heads, tails, place : float64 (n,), float64 (n,), int
        Sums of the two parts, to which is added, from number `place` on.
    """
    if count == 8:
        _eight_in_a_row(theta, first, lags, at, splits, sizes, heads, tails, place)
    elif count == 4:
        _four(theta, first, lags, at, splits, sizes, heads, tails, place)
    elif count == 3:
        _three(theta, first, lags, at, splits, sizes, heads, tails, place)
    elif count == 2:
        _two(theta, first, lags, at, splits, sizes, heads, tails, place)
    else:
        _one(theta, first, lags, at, splits, sizes, heads, tails, place)
