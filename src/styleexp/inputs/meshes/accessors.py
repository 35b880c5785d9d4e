"""Read glTF accessors of any type, stride and sparsity."""

from __future__ import annotations

from typing import Any

import numpy as np

from styleexp.system.errors import UserError

MOST_ZEROS = 10_000_000
"""Maximum number of elements that a glTF file may declare without storing them."""
DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SHAPES = {
    "SCALAR": (1, 1),
    "VEC2": (1, 2),
    "VEC3": (1, 3),
    "VEC4": (1, 4),
    "MAT2": (2, 2),
    "MAT3": (3, 3),
    "MAT4": (4, 4),
}
"""Columns and rows per element type; glTF stores matrices column-major."""


def item(tree: dict[str, Any], kind: str, index: Any) -> dict[str, Any]:
    """An entry of one of the document's lists. Raises `UserError` if there is none."""
    found = tree.get(kind, [])
    # Python accepts True and -1 as indices; glTF doesn't.
    if type(index) is not int or not 0 <= index < len(found):
        raise UserError(
            f"refers to {kind}[{index}], but has {len(found)} {kind}: export the mesh again."
        )
    return found[index]


def read(tree: dict[str, Any], buffers: list[bytes], index: Any) -> np.ndarray:
    """An accessor's elements as stored, (count, components), with sparse values applied.

    Matrices become one row of entries, column-major. If the file lacks promised data, raises
    `UserError` with a message that lacks its subject, the file's name.
    """
    accessor = item(tree, "accessors", index)
    dtype, shape, count = _layout(accessor, index)
    if "bufferView" in accessor:
        start = accessor.get("byteOffset", 0)
        values = _view(tree, buffers, accessor["bufferView"], start, dtype, shape, count)
    elif count > MOST_ZEROS:
        raise UserError(f"promises {count} values that it does not contain: export it again.")
    else:
        values = np.zeros((count, shape[0] * shape[1]), dtype)
    sparse = accessor.get("sparse")
    if sparse is None:
        return values
    number = _whole(sparse["count"], "a sparse accessor's count")
    where, what = sparse["indices"], sparse["values"]
    kind = DTYPES.get(where["componentType"])
    if kind not in ("<u1", "<u2", "<u4"):
        raise UserError("has sparse indices that are not unsigned integers: export the mesh again.")
    at = _view(tree, buffers, where["bufferView"], where.get("byteOffset", 0), np.dtype(kind),
               (1, 1), number, packed=True)[:, 0].astype(np.int64)  # fmt: skip
    if number and at.max() >= count:
        raise UserError(f"has a sparse value for element {at.max()} of {count}: export it again.")
    values[at] = _view(tree, buffers, what["bufferView"], what.get("byteOffset", 0), dtype, shape,
                       number, packed=True)  # fmt: skip
    return values


def real(tree: dict[str, Any], buffers: list[bytes], index: Any) -> np.ndarray:
    """An accessor's elements as float64, with normalised integers converted to fractions."""
    values = read(tree, buffers, index)
    fractions = values.dtype.kind != "f" and item(tree, "accessors", index).get("normalized", False)
    return fraction(values) if fractions else values.astype(np.float64)


def fraction(values: np.ndarray) -> np.ndarray:
    """Normalised integers as float64 in [0, 1] or [-1, 1] (glTF 2.0, 3.6.2.2)."""
    return np.maximum(values.astype(np.float64) / np.iinfo(values.dtype).max, -1.0)


def count_of(tree: dict[str, Any], index: Any) -> int:
    """An accessor's declared number of elements."""
    return _layout(item(tree, "accessors", index), index)[2]


def _layout(accessor: dict[str, Any], index: Any) -> tuple[np.dtype, tuple[int, int], int]:
    kind, shape = DTYPES.get(accessor["componentType"]), SHAPES.get(accessor["type"])
    if kind is None or shape is None:
        raise UserError(
            f"has numbers of an unknown type in accessors[{index}] "
            f"({accessor['componentType']}, {accessor['type']}): export the mesh again."
        )
    return np.dtype(kind), shape, _whole(accessor["count"], f"the count of accessors[{index}]")


def _view(
    tree: dict[str, Any],
    buffers: list[bytes],
    index: Any,
    start: Any,
    dtype: np.dtype,
    shape: tuple[int, int],
    count: int,
    packed: bool = False,
) -> np.ndarray:
    """Copy ``count`` elements from a buffer view, at byte offset ``start``."""
    view = item(tree, "bufferViews", index)
    item(tree, "buffers", view["buffer"])
    columns, rows = shape
    # Matrix columns are aligned to four bytes.
    column = rows * dtype.itemsize if columns == 1 else -(-rows * dtype.itemsize // 4) * 4
    # Some exporters write stride 0 for tightly packed elements.
    stride = (0 if packed else view.get("byteStride", 0)) or columns * column
    what = f"bufferViews[{index}]"
    offset, start = _whole(view.get("byteOffset", 0), what), _whole(start, what)
    length, stride = _whole(view["byteLength"], what), _whole(stride, what)
    size = (columns - 1) * column + rows * dtype.itemsize
    end = start + (stride * (count - 1) + size if count else 0)
    if stride < size or end > length or offset + length > len(buffers[view["buffer"]]):
        raise UserError(
            f"promises more in {what} than it contains: copy or export the mesh again, with its "
            "buffers."
        )
    if count == 0:
        return np.zeros((0, columns * rows), dtype)
    found = np.ndarray(
        (count, columns, rows),
        dtype,
        buffers[view["buffer"]],
        offset + start,
        (stride, column, dtype.itemsize),
    )
    return found.reshape(count, columns * rows).copy()


def _whole(number: Any, what: str) -> int:
    if type(number) is float and number.is_integer():  # JSON's 12.0 is 12
        number = int(number)
    if type(number) is not int or number < 0:
        raise UserError(f"has {str(number)[:20]} for {what}: export the mesh again.")
    return number
