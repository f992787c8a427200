"""Eight numbers side by side in the processor's vector registers, for kernels that treat eight points at a time.

Inside an ``njit`` function ``load`` and ``gather`` make such a vector out of an array of float64, ``+ - * /`` work on
it (and on scalars), ``store`` and ``scatter`` write it. It is LLVM's ``<8 x double>``: one AVX-512 register, or two or
four smaller ones. (Loops over eight numbers are not made into vectors by the compiler: arrays may overlap.)
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numpy.typing import NDArray

from livedeform.common.compiled import njit

LANES = 8
_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_intrinsic: Any = extending.intrinsic


def side_by_side(numbers: NDArray[Any], q: int | None = None) -> NDArray[Any]:
    """Those of eight elements, (n, ...) -> (n / LANES, ..., LANES); the last one fills what is left. With ``q`` points
    to an element, numbered through: (n q, ...) -> (n / LANES, q, ..., LANES)."""
    if q is not None:
        numbers = numbers.reshape(-1, q, *numbers.shape[1:])
    n = len(numbers)
    blocks = -(-n // LANES)
    if n < blocks * LANES:
        numbers = numbers[np.minimum(np.arange(blocks * LANES), n - 1)]
    return np.ascontiguousarray(np.moveaxis(numbers.reshape(blocks, LANES, *numbers.shape[1:]), 1, -1))


def one_by_one(lanes: NDArray[Any], n: int) -> NDArray[Any]:
    """Back again: (n / LANES, ..., LANES) -> (n, ...)."""
    return np.moveaxis(lanes, -1, 1).reshape(-1, *lanes.shape[1:-1])[:n]


@njit(cache=True)
def work_array(n):
    """Memory for ``n`` vectors, (n LANES,), none of which lies across two lines of the cache (that would cost half)."""
    memory = np.empty((n + 1) * LANES)
    start = -(memory.ctypes.data // 8) % LANES
    return memory[start : start + n * LANES]


@njit(inline="always")
def rows_of(block, n, q, rows):
    """Find which of the ``n`` points stand side by side in a block, into ``rows`` (LANES,): the same of the ``q``
    points of eight elements; the last element fills what is left."""
    for lane in range(LANES):
        rows[lane] = min(block // q * LANES + lane, n // q - 1) * q + block % q


@njit(inline="always")
def n_blocks(n, q):
    """Return how many blocks there are."""
    return -(-n // (q * LANES)) * q


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes")


_LANES = _LanesType()


@extending.register_model(_LanesType)
class _LanesModel(extending.models.PrimitiveModel):
    def __init__(self, manager, numba_type) -> None:
        super().__init__(manager, numba_type, _VECTOR)


def _spread(builder, value):
    """The same number in all lanes."""
    if value.type == _VECTOR:
        return value
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, _I32(0))
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(_I32, LANES), [0] * LANES))


def _register(operation, instruction: str) -> None:
    """Makes a Python operator work on lanes, and on lanes with a scalar."""

    @infer_global(operation)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            if len(args) == 2 and _LANES in args and all(a in (_LANES, types.float64) for a in args):
                return signature(_LANES, *args)
            return None

    def lower(context, builder, sig, args):
        a, b = (_spread(builder, value) for value in args)
        return getattr(builder, instruction)(a, b, flags=("contract",))

    for pair in ((_LANES, _LANES), (_LANES, types.Float), (types.Float, _LANES)):
        lower_builtin(operation, *pair)(lower)


_register(operator.add, "fadd")
_register(operator.sub, "fsub")
_register(operator.mul, "fmul")
_register(operator.truediv, "fdiv")


def _place(context, builder, array_type, array, index):
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def _places(context, builder, sig, args):
    """Pointers to array[rows[l] * stride + offset]."""
    array, rows, stride, offset = args
    for lane in range(LANES):
        row = builder.load(_place(context, builder, sig.args[1], rows, _I64(lane)))
        yield lane, _place(context, builder, sig.args[0], array, builder.add(builder.mul(row, stride), offset))


@_intrinsic
def load(typingctx, array, index):
    """``array[index : index + LANES]`` of the flat ``array``."""

    def codegen(context, builder, sig, args):
        place = _place(context, builder, sig.args[0], *args)
        return builder.load(builder.bitcast(place, _VECTOR.as_pointer()), align=8)

    return _LANES(array, types.intp), codegen


@_intrinsic
def store(typingctx, array, index, lanes):
    """``array[index : index + LANES] = lanes`` in the flat ``array``."""

    def codegen(context, builder, sig, args):
        place = _place(context, builder, sig.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(place, _VECTOR.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, _LANES), codegen


@_intrinsic
def gather(typingctx, array, rows, stride, offset):
    """``array[rows[l] * stride + offset]`` in lane l, of the flat ``array``; ``rows`` (LANES,)."""

    def codegen(context, builder, sig, args):
        vector = ir.Constant(_VECTOR, ir.Undefined)
        for lane, place in _places(context, builder, sig, args):
            vector = builder.insert_element(vector, builder.load(place), _I32(lane))
        return vector

    return _LANES(array, rows, types.intp, types.intp), codegen


@_intrinsic
def scatter(typingctx, array, rows, stride, offset, lanes):
    """``array[rows[l] * stride + offset] = lanes[l]`` in the flat ``array``; ``rows`` (LANES,)."""

    def codegen(context, builder, sig, args):
        for lane, place in _places(context, builder, sig, args[:4]):
            builder.store(builder.extract_element(args[4], _I32(lane)), place)
        return context.get_dummy_value()

    return types.void(array, rows, types.intp, types.intp, _LANES), codegen


@_intrinsic
def spread(typingctx, number):
    """The same number in all lanes."""

    def codegen(context, builder, sig, args):
        return _spread(builder, args[0])

    return _LANES(types.float64), codegen


@njit(inline="always")
def collect(array, rows, stride, offset, n, out):
    """``n`` numbers of each row, from ``offset`` on, side by side in ``out`` (n LANES,)."""
    for m in range(n):
        store(out, m * LANES, gather(array, rows, stride, offset + m))
