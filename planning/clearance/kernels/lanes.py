"""Vectors of sixteen float32 numbers for compiled code, written as LLVM's own.

What LLVM makes of a loop over 16 lanes depends on the code around it; a comparison of all lanes then ends as one number
per lane. Here it ends as one integer, a bit per lane, so that only the lanes that pass cost anything. Processors with
shorter registers use two or four of them. `bare` hands arrays to hot loops without their reference count.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]  # it has no types
from numba import extending, types

intrinsic: Any = extending.intrinsic
"""Numba's own; callers leave out the first argument, which mypy cannot know."""


@intrinsic  # type: ignore[untyped-decorator]  # numba's own types
def bare(typing_context: Any, array: Any) -> Any:
    """The array without its reference count, which numba would touch at every call in a loop.

    Only for arguments of a function called from Python: the caller holds them until it returns.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (value,) = arguments
        for name in ("meminfo", "parent"):
            place = _field_place(context, signature.args[0], name)
            value = builder.insert_value(value, ir.Constant(value.type.elements[place], None), place)
        return value

    return array(array), codegen


def _field_place(context: Any, kind: Any, name: str) -> int:
    """The place of a field among those that a value of numba's type is made of."""
    return context.data_model_manager[kind].get_field_position(name)


LANES = 16
"""The float32 numbers of one AVX-512 register."""
FAST = ("reassoc", "nsz", "contract", "arcp")
"""What LLVM may do with these sums; the slack of the bounds allows for it."""
Number = float | np.floating[Any]

FLOAT, INDEX = ir.FloatType(), ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, LANES)


class Vector:
    """One float32 (or, from a comparison, one bit) per lane; operators write the instruction. Numbers are spread."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def __add__(self, other: Vector | Number) -> Vector:
        return Vector(self.builder, self.builder.fadd(self.value, self._like(other), flags=FAST))

    def __sub__(self, other: Vector | Number) -> Vector:
        return Vector(self.builder, self.builder.fsub(self.value, self._like(other), flags=FAST))

    def __mul__(self, other: Vector | Number) -> Vector:
        return Vector(self.builder, self.builder.fmul(self.value, self._like(other), flags=FAST))

    def __truediv__(self, other: Vector | Number) -> Vector:
        return Vector(self.builder, self.builder.fdiv(self.value, self._like(other), flags=FAST))

    def __neg__(self) -> Vector:
        return Vector(self.builder, self.builder.fsub(self._like(0.0), self.value, flags=FAST))

    def __lt__(self, other: Vector | Number) -> Vector:
        return Vector(self.builder, self.builder.fcmp_ordered("<", self.value, self._like(other)))

    def __le__(self, other: Vector | Number) -> Vector:
        return Vector(self.builder, self.builder.fcmp_ordered("<=", self.value, self._like(other)))

    def __gt__(self, other: Vector | Number) -> Vector:
        return Vector(self.builder, self.builder.fcmp_ordered(">", self.value, self._like(other)))

    def __or__(self, other: Vector) -> Vector:
        return Vector(self.builder, self.builder.or_(self.value, other.value))

    def __abs__(self) -> Vector:
        return self._call("llvm.fabs")

    def root(self) -> Vector:
        """Square root."""
        return self._call("llvm.sqrt")

    def choose(self, yes: Vector, no: Vector | Number) -> Vector:
        """Lane by lane ``yes`` where this comparison holds, else ``no``."""
        return Vector(self.builder, self.builder.select(self.value, yes.value, yes._like(no)))

    def _like(self, other: Vector | Number) -> Any:
        return other.value if isinstance(other, Vector) else _constant(other)

    def _call(self, name: str) -> Vector:
        function = _declared(self.builder, f"{name}.v{LANES}f32", ir.FunctionType(VECTOR, [VECTOR]))
        return Vector(self.builder, self.builder.call(function, [self.value]))


def least(p: Vector, q: Vector | Number) -> Vector:
    """The smaller of two, lane by lane."""
    return (p < q).choose(p, q)


def most(p: Vector, q: Vector | Number) -> Vector:
    """The larger of two, lane by lane."""
    return (p > q).choose(p, q)


class Arguments:
    """The arguments of an intrinsic as vectors; each is wanted by its place."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self._context, self._builder, self._signature, self._arguments = context, builder, signature, arguments

    def number(self, place: int) -> Vector:
        """A float32 in every lane."""
        return self._spread(self._arguments[place])

    def constant(self, number: Number) -> Vector:
        """A number in every lane."""
        return Vector(self._builder, _constant(number))

    def three(self, place: int) -> list[Vector]:
        """Three float32 numbers, each in every lane."""
        return [self._spread(self._builder.extract_value(self._arguments[place], axis)) for axis in range(3)]

    def rows(self, place: int, which: int, count: int) -> list[Vector]:
        """The ``count`` rows of one item of an array of shape (m, count, 16); argument ``which`` says which."""
        first = self._builder.mul(self._arguments[which], INDEX(count))
        rows = [self._builder.add(first, INDEX(row)) for row in range(count)]
        return [Vector(self._builder, self._builder.load(self._row(place, row), align=4)) for row in rows]

    def row(self, place: int, which: int) -> Vector:
        """One row of an array of shape (m, 16); argument ``which`` says which."""
        return Vector(self._builder, self._builder.load(self._row(place, self._arguments[which]), align=4))

    def write(self, place: int, which: int, vector: Vector) -> None:
        """Write one row of an array of shape (m, 16); argument ``which`` says which."""
        self._builder.store(vector.value, self._row(place, self._arguments[which]), align=4)

    def _spread(self, number: Any) -> Vector:
        undefined = ir.Constant(VECTOR, ir.Undefined)
        one = self._builder.insert_element(undefined, number, ir.IntType(32)(0))
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return Vector(self._builder, self._builder.shuffle_vector(one, undefined, lanes))

    def _row(self, place: int, row: Any) -> Any:
        field = _field_place(self._context, self._signature.args[place], "data")
        data = self._builder.extract_value(self._arguments[place], field)
        return self._builder.bitcast(
            self._builder.gep(data, [self._builder.mul(row, INDEX(LANES))]), VECTOR.as_pointer()
        )


@intrinsic  # type: ignore[untyped-decorator]  # numba's own types
def lanes_at_most(typing_context: Any, rows: Any, row: Any, limit: Any) -> Any:
    """Which lanes of ``rows[row]``, shape (m, 16), float32, do not exceed a limit: a bit each, lane 0 the lowest."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given = Arguments(context, builder, signature, arguments)
        passed = given.row(0, 1) <= given.number(2)
        return builder.zext(builder.bitcast(passed.value, ir.IntType(LANES)), INDEX)

    return types.int64(rows, types.int64, types.float32), codegen


@intrinsic  # type: ignore[untyped-decorator]  # numba's own types
def least_of(typing_context: Any, rows: Any, row: Any) -> Any:
    """The least lane of ``rows[row]``, shape (m, 16), float32, none of them NaN."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = Arguments(context, builder, signature, arguments).row(0, 1)
        kind = ir.FunctionType(FLOAT, [VECTOR])
        function = _declared(builder, f"llvm.vector.reduce.fmin.v{LANES}f32", kind)
        return builder.call(function, [vector.value], fastmath=("nnan", "nsz"))

    return types.float32(rows, types.int64), codegen


@intrinsic  # type: ignore[untyped-decorator]  # numba's own types
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Place of the lowest bit that is set; meaningless for 0."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen


def _constant(number: Number) -> Any:
    return ir.Constant(VECTOR, [float(number)] * LANES)


def _declared(builder: Any, name: str, kind: Any) -> Any:
    return builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
