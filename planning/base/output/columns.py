"""NumPy's columns as Arrow's: what ``pyarrow.array(..., from_pandas=True)`` makes, which imports pandas if it can."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools


def column(values: NDArray[Any]) -> pa.Array:
    """Numbers, truth values or texts, shape (n,); NaN becomes null: "no number" is not a number."""
    if values.dtype.kind in "OU":
        return _texts(values.tolist())
    known = ~np.isnan(values) if values.dtype.kind == "f" else np.ones(len(values), bool)
    data = _bits(values) if values.dtype.kind == "b" else pa.py_buffer(np.ascontiguousarray(values))
    return _of(pa.from_numpy_dtype(values.dtype), known, data)


def truths(values: NDArray[np.bool_], known: Bools) -> pa.Array:
    """Truth values, shape (n,), null where they are not known."""
    return _of(pa.bool_(), known, _bits(values & known))


def _texts(values: list[str]) -> pa.Array:
    encoded = [value.encode() for value in values]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    return _of(pa.string(), np.ones(len(values), bool), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded)))


def _of(kind: pa.DataType, known: Bools, *data: pa.Buffer) -> pa.Array:
    absent = int(len(known) - known.sum())
    return pa.Array.from_buffers(kind, len(known), [_bits(known) if absent else None, *data], absent)


def _bits(values: NDArray[np.bool_]) -> pa.Buffer:
    return pa.py_buffer(np.packbits(values, bitorder="little"))
