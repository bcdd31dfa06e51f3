"""Tables of numbers as sensor_msgs/PointCloud2 and back.

A column is a field, one number or a fixed count of them a row. Facts about the whole table (an extractor's name, a reference's stamp) are fields
named `key=value` that lie over the first byte of a row: viewers and converters pass over them, and an empty table keeps them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

_DATATYPES = {
    "int8": PointField.INT8, "uint8": PointField.UINT8, "int16": PointField.INT16, "uint16": PointField.UINT16, "int32": PointField.INT32,
    "uint32": PointField.UINT32, "float32": PointField.FLOAT32, "float64": PointField.FLOAT64,
}  # fmt: skip
_TYPES = {number: np.dtype(name) for name, number in _DATATYPES.items()}
EXACT_INTEGERS = 2**53
"""Whole numbers up to here are exact as float64: fields have no 64-bit integers."""


@dataclass(frozen=True, slots=True)
class Table:
    """columns: name to (N,) or (N, K); facts: key to text."""

    columns: Mapping[str, NDArray[Any]]
    facts: Mapping[str, str]


def cloud_message(header: Header, columns: Mapping[str, NDArray[Any]], facts: Mapping[str, object] | None = None) -> PointCloud2:
    """Columns of equal length as a cloud; int64 becomes float64.

    Raises:
        ValueError: If lengths differ, a type has no field, or a whole number is beyond `EXACT_INTEGERS`.
    """
    held = {name: _as_field(name, column) for name, column in columns.items()}
    lengths = {len(column) for column in held.values()}
    if len(lengths) != 1:
        raise ValueError(f"columns of different lengths: { {name: len(column) for name, column in held.items()} }")
    layout = np.dtype([(name, column.dtype, column.shape[1:]) for name, column in held.items()])
    rows = np.empty(lengths.pop(), dtype=layout)
    for name, column in held.items():
        rows[name] = column
    fields = [PointField(name=name, offset=layout.fields[name][1], datatype=_DATATYPES[c.dtype.name], count=int(np.prod(c.shape[1:]))) for name, c in held.items()]
    fields += [PointField(name=f"{key}={value}", offset=0, datatype=PointField.UINT8, count=1) for key, value in (facts or {}).items()]
    cloud = PointCloud2(header=header, height=1, width=len(rows), fields=fields, point_step=layout.itemsize, row_step=layout.itemsize * len(rows), is_dense=True)
    cloud.data.frombytes(rows.tobytes())
    return cloud


def cloud_table(cloud: PointCloud2) -> Table:
    """The columns, (N,) or (N, K), in native byte order, and the facts of a cloud.

    Raises:
        ValueError: If the data are shorter than the header says.
    """
    order = ">" if cloud.is_bigendian else "<"
    named = [field for field in cloud.fields if "=" not in field.name]
    formats = [np.dtype((_TYPES[f.datatype].newbyteorder(order), (f.count,))) if f.count > 1 else _TYPES[f.datatype].newbyteorder(order) for f in named]
    layout = np.dtype({"names": [f.name for f in named], "formats": formats, "offsets": [f.offset for f in named], "itemsize": cloud.point_step})
    rows = _rows(cloud, layout)
    columns = {field.name: np.ascontiguousarray(rows[field.name]).astype(_column_type(rows[field.name])) for field in named}
    return Table(columns, dict(field.name.split("=", 1) for field in cloud.fields if "=" in field.name))


def _rows(cloud: PointCloud2, layout: np.dtype[Any]) -> NDArray[Any]:
    needed = cloud.row_step * max(cloud.height - 1, 0) + cloud.point_step * cloud.width if cloud.height else 0
    if len(cloud.data) < needed:
        raise ValueError(f"a cloud of {cloud.height} x {cloud.width} points needs {needed} bytes and has {len(cloud.data)}")
    if cloud.height == 1:
        return np.frombuffer(cloud.data, dtype=layout, count=cloud.width)
    rows = [np.frombuffer(cloud.data, dtype=layout, count=cloud.width, offset=row * cloud.row_step) for row in range(cloud.height)]
    return np.concatenate(rows) if rows else np.empty(0, dtype=layout)


def _as_field(name: str, column: NDArray[Any]) -> NDArray[Any]:
    if column.dtype == np.bool_:
        column = column.astype(np.uint8)
    if column.dtype == np.int64:
        if np.any(np.abs(column) > EXACT_INTEGERS):
            raise ValueError(f"column {name} holds a whole number beyond 2^53, which a field cannot hold exactly")
        column = column.astype(np.float64)
    if column.dtype.name not in _DATATYPES or column.ndim not in (1, 2):
        raise ValueError(f"column {name} of shape {column.shape} and type {column.dtype} is no field of a cloud")
    return column


def _column_type(column: NDArray[Any]) -> np.dtype[Any]:
    return column.dtype.newbyteorder("=")
