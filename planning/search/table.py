"""The candidates table on disk: Parquet, mm and degrees, with the run's provenance in the file's metadata."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools
from puncture_twin.planning.base.files import atomic

TABLE = "candidates.parquet"
"""Its name in a folder."""


def to_table(candidates: Any) -> pa.Table:
    """One row per direction, columns as DESIGN names them: `theta_deg`, `beta_deg`, `verdict`, `reason`, ..."""
    columns = _path_columns(candidates) | _choice_columns(candidates)
    if candidates.chances is not None:
        columns |= candidates.chances.columns()
    if candidates.deflection is not None:
        columns |= {"deflection_bound_mm": candidates.deflection}
    if candidates.breathing is not None:
        columns |= {
            "safe_all_phases": candidates.breathing.safe_all_phases,
            "worst_phase": candidates.breathing.worst_phase,
            "breathing_clearance_mm": candidates.breathing.clearance,
        }
    run = {**candidates.provenance, "safe_cone_from": candidates.cone_source}
    named = {name: one if isinstance(one, pa.Array) else column(np.asarray(one)) for name, one in columns.items()}
    table = pa.table(named)
    return table.replace_schema_metadata({"run": json.dumps(run, sort_keys=True)})


def _path_columns(candidates: Any) -> dict[str, Any]:
    columns: dict[str, Any] = {
        "theta_deg": candidates.theta_deg,
        "beta_deg": candidates.beta_deg,
        "verdict": np.where(candidates.safe, "safe", "rejected"),
        "reason": candidates.verdict.reason,
        "reason_structure": candidates.verdict.structure,
        "reason_depth_mm": candidates.verdict.depth,
        "reason_amount": candidates.verdict.amount,
        "reason_detail": candidates.verdict.detail,
        "entry_x_mm": candidates.path.entry_ct[:, 0],
        "entry_y_mm": candidates.path.entry_ct[:, 1],
        "entry_z_mm": candidates.path.entry_ct[:, 2],
        "path_length_mm": candidates.path.length,
        "skin_angle_deg": np.degrees(candidates.path.skin_angle),
        "min_clearance_mm": candidates.clearance.least,
    }
    for at, name in enumerate(candidates.clearance.structures):
        columns[f"clearance_{name}_mm"] = candidates.clearance.by_structure[:, at]
    return {**columns, "tissue_mm": candidates.path.tissue}


def _choice_columns(candidates: Any) -> dict[str, Any]:
    reachable = candidates.arm.reachable
    return {
        "reachable": truths(reachable > 0, reachable >= 0),
        "reach_margin": candidates.arm.margin,
        "safe_cone_deg": np.degrees(candidates.safe_cone),
        "cost": candidates.ranking.cost,
        "rank": candidates.ranking.rank,
        "pareto": candidates.ranking.pareto,
        "window": candidates.windows.of_row,
    }


def write_table(candidates: Any, path: Path) -> None:
    """Write the table as Parquet, whole or not at all; numbers, of which most differ, without a dictionary."""
    table = to_table(candidates)
    repeating = [field.name for field in table.schema if not pa.types.is_floating(field.type)]
    with atomic(path) as temporary, temporary.open("wb") as stream:
        pq.write_table(table, stream, use_dictionary=repeating)


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
    codes = {value: value.encode() for value in set(values)}  # few differ
    encoded = [codes[value] for value in values]
    ends = np.cumsum([0, *map(len, encoded)], dtype=np.int32)
    return _of(pa.string(), np.ones(len(values), bool), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded)))


def _of(kind: pa.DataType, known: Bools, *data: pa.Buffer) -> pa.Array:
    absent = int(len(known) - known.sum())
    return pa.Array.from_buffers(kind, len(known), [_bits(known) if absent else None, *data], absent)


def _bits(values: NDArray[np.bool_]) -> pa.Buffer:
    return pa.py_buffer(np.packbits(values, bitorder="little"))
