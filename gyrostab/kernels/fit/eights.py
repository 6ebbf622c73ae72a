"""Eight float64 as one number, for kernels that solve the same small problem eight at a time.

A matrix of forty rows is too small for vector code along its rows: most vectors are partly filled,
and every sum waits for the one before. With a problem in each of the eight places, all vectors are
full and nothing is added across places, so the result of a problem does not depend, bit for bit, on
its neighbours. Where the processor has shorter vectors, the compiler splits these.

Arrays of eights are float64 (n, 8), made by `eights`; ``a[k, place]`` is one of the numbers.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, register_model

from gyrostab.kernels.compiled import INNER

#: Problems side by side.
PLACES = 8

_VECTOR = ir.VectorType(ir.DoubleType(), PLACES)
_SHORT = ir.IntType(32)
#: A product that is added may be rounded once instead of twice, as in the code of the compiler's
#: own making.
_FUSE = ("contract",)


class _EightType(types.Type):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__(name="Eight")


_EIGHT = _EightType()


@register_model(_EightType)
class _EightModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


@lower_cast(types.Float, _EightType)
def _spread_number(context: Any, builder: Any, source: Any, target: Any, value: Any) -> Any:
    """Spread a plain number over all eight places."""
    wide = context.cast(builder, value, source, types.float64)
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), wide, ir.Constant(_SHORT, 0))
    return builder.shuffle_vector(
        first, first, ir.Constant(ir.VectorType(_SHORT, PLACES), [0] * PLACES)
    )


def _register_operator(symbol: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Teach the compiler one operator between eights, or between eights and a plain number."""

    class Typing(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            eight_flags = [isinstance(argument, _EightType) for argument in args]
            if any(eight_flags) and all(
                eight or isinstance(argument, types.Float)
                for eight, argument in zip(eight_flags, args, strict=True)
            ):
                return signature(_EIGHT, _EIGHT, _EIGHT)
            return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)

    infer_global(symbol)(Typing)
    lower_builtin(symbol, _EightType, _EightType)(lower)


_register_operator(operator.add, lambda builder, a, b: builder.fadd(a, b, flags=_FUSE))
_register_operator(operator.sub, lambda builder, a, b: builder.fsub(a, b, flags=_FUSE))
_register_operator(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=_FUSE))
_register_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b))


def _element_address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Where the eights number `index` of a C-contiguous (n, 8) array stand."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(builder.bitcast(data, _VECTOR.as_pointer()), [index])


def _is_array_of_eights(array: Any) -> bool:
    return (
        isinstance(array, types.Array)
        and array.ndim == 2
        and array.layout == "C"
        and array.dtype == types.float64
    )


@intrinsic
def take(typing_context: Any, array: Any, index: Any) -> Any:
    """Eights number `index` of an array of `eights`."""
    if not (_is_array_of_eights(array) and isinstance(index, types.Integer)):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_element_address(context, builder, sig.args[0], *args), align=8)

    return _EIGHT(array, types.intp), emit


@intrinsic
def put(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Write eights, or eight times a plain number, to place `index` of an array of `eights`."""
    if not (_is_array_of_eights(array) and isinstance(index, types.Integer)):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _element_address(context, builder, sig.args[0], *args[:2]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, _EIGHT), emit


@intrinsic
def root(typing_context: Any, value: Any) -> Any:
    """Square roots."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        return builder.call(
            cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{PLACES}f64"), args
        )

    return _EIGHT(_EIGHT), emit


@intrinsic
def where_above(typing_context: Any, x: Any, y: Any, yes: Any, no: Any) -> Any:
    """`yes` where ``x > y``, `no` elsewhere and where x or y is NaN."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return _EIGHT(_EIGHT, _EIGHT, _EIGHT, _EIGHT), emit


@njit(**INNER)
def eights(n):  # type: ignore[no-untyped-def]
    """Zeros (n, 8), each eight of them in one line of the cache."""
    room = np.zeros((n + 1) * PLACES)
    skip = -(room.ctypes.data // 8) % PLACES
    return room[skip : skip + n * PLACES].reshape((n, PLACES))
