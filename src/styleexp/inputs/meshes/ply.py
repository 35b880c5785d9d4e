"""PLY files as tables: every element with all its properties, including lists."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field

import numpy as np

from styleexp.system.errors import UserError

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
         "f4": "float", "f8": "double"}  # fmt: skip
EARLY = "ends too early: copy or export the mesh again."


@dataclass(frozen=True)
class Lists:
    """A list property: the concatenated entries of all rows."""

    lengths: np.ndarray
    """(rows,), in the file's own type."""
    values: np.ndarray
    """(sum of the lengths,)"""

    def take(self, rows: np.ndarray) -> Lists:
        """The lists of some rows, in that order."""
        lengths = self.lengths.astype(np.int64)
        start = np.cumsum(lengths) - lengths
        return Lists(self.lengths[rows], self.values[_runs(start[rows], lengths[rows])])


Column = np.ndarray | Lists


@dataclass(frozen=True)
class Ply:
    """The tables of a PLY file, keyed by element and property name, in file order."""

    elements: dict[str, dict[str, Column]]
    comments: list[str] = field(default_factory=list)
    """Header lines ``comment …`` and ``obj_info …``."""
    left: bool = False
    """Whether there is data after the last element."""


def take(column: Column, rows: np.ndarray) -> Column:
    """Select rows of a column."""
    return column.take(rows) if isinstance(column, Lists) else column[rows]


def numbers(columns: dict[str, Column], *names: str) -> np.ndarray:
    """Scalar properties as float64 (rows, names). Raises `UserError` for a list property."""
    found = [column for name in names if isinstance(column := columns[name], np.ndarray)]
    if len(found) < len(names):
        raise UserError(f"has lists for {', '.join(names)}: export the mesh again.")
    return np.stack(found, axis=1).astype(np.float64)


def parse(data: bytes) -> Ply:
    """Read a PLY file, ASCII or binary.

    Raises `UserError` with a message that lacks its subject, the file's name.
    """
    head = re.match(rb"ply[ \t]*(\r\n|\n|\r)(?:.*?(?:\r\n|\n|\r))??end_header[ \t]*(\r\n|\n|\r|$)",
                    data, re.DOTALL)  # fmt: skip
    if head is None:
        what = "has an unterminated header" if data.startswith(b"ply") else "is not a PLY file"
        raise UserError(f"{what}: export the mesh again.")
    kind, comments = "", []
    layout: dict[str, tuple[int, list[tuple[str, str, str | None]]]] = {}
    for number, line in enumerate(re.split(r"\r\n|\n|\r", head[0].decode("latin-1")), 1):
        match line.split():
            case ["ply" | "end_header"] | []:
                pass
            case ["format", kind, *_]:
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(line.strip().encode("latin-1").decode("utf-8", "replace"))
            case ["element", name, count] if count.isdecimal() and name not in layout:
                layout[name] = (int(count), [])
            case ["property", "list", length, each, name] if layout and _fresh(layout, name):
                list(layout.values())[-1][1].append((name, _type(each), _type(length)))
            case ["property", each, name] if layout and _fresh(layout, name):
                list(layout.values())[-1][1].append((name, _type(each), None))
            case _:
                raise UserError(
                    f"has a header that cannot be read in line {number} ('{line[:40]}'): export "
                    "the mesh again."
                )
    orders = {"binary_little_endian": "<", "binary_big_endian": ">"}
    body = data[head.end() :]
    reader: _Text | _Binary
    if kind == "ascii":
        reader = _Text(body)
    elif kind in orders:
        reader = _Binary(body, orders[kind])
    else:
        raise UserError(
            f"has the format '{kind[:20]}', which PLY does not define: export it again."
        )
    elements = {name: reader.element(name, *rest) for name, rest in layout.items()}
    return Ply(elements, comments, reader.left())


def written(ply: Ply) -> bytes:
    """Serialise a PLY file, binary little-endian."""
    head = ["ply", "format binary_little_endian 1.0", *ply.comments]
    body = []
    for element, columns in ply.elements.items():
        first = next(iter(columns.values()))
        count = len(first.lengths if isinstance(first, Lists) else first)
        head.append(f"element {element} {count}")
        for name, column in columns.items():
            if isinstance(column, Lists):
                kinds = (NAMES[c.dtype.str[1:]] for c in (column.lengths, column.values))
                head.append(f"property list {' '.join(kinds)} {name}")
            else:
                head.append(f"property {NAMES[column.dtype.str[1:]]} {name}")
        body.append(_packed(columns, count))
    head.append("end_header\n")
    return "\n".join(head).encode() + b"".join(body)


def _packed(columns: dict[str, Column], count: int) -> bytes:
    """Pack all columns, row by row."""
    if not any(isinstance(c, Lists) and np.ptp(c.lengths) for c in columns.values() if count):
        fields: list[tuple[str, str, int]] = []
        parts: list[np.ndarray] = []
        for column in columns.values():
            both = (column.lengths, column.values) if isinstance(column, Lists) else (column,)
            for part in both:
                width = len(part) // max(count, 1)
                fields.append((f"f{len(fields)}", "<" + part.dtype.str[1:], width))
                parts.append(part)
        rows = np.zeros(count, np.dtype([(n, t, (w,)) for n, t, w in fields]))
        for (name, _, width), part in zip(fields, parts, strict=True):
            rows[name] = part.reshape(count, width)
        return rows.tobytes()
    sizes, pieces = [], []
    for column in columns.values():
        both = (column.lengths, column.values) if isinstance(column, Lists) else (column,)
        for k, part in enumerate(both):
            each = column.lengths.astype(np.int64) if k and isinstance(column, Lists) else 1
            sizes.append(np.broadcast_to(each * part.dtype.itemsize, count))
            pieces.append(part.astype("<" + part.dtype.str[1:]).view(np.uint8))
    ends = np.cumsum(np.stack(sizes, axis=1).ravel()).reshape(count, -1)
    out = np.zeros(int(ends[-1, -1]), np.uint8)
    for k, (size, piece) in enumerate(zip(sizes, pieces, strict=True)):
        out[_runs(ends[:, k] - size, size)] = piece
    return out.tobytes()


class _Binary:
    def __init__(self, body: bytes, order: str) -> None:
        self.body, self.order, self.at = body, order, 0

    def left(self) -> bool:
        """Whether there is more than was asked for."""
        return bool(self.body[self.at :].strip(b" \t\r\n\0"))

    def element(
        self, name: str, count: int, properties: list[tuple[str, str, str | None]]
    ) -> dict[str, Column]:
        """All columns of one element."""
        least = sum(np.dtype(length or each).itemsize for _, each, length in properties)
        if count * least > len(self.body) - self.at:
            raise UserError(EARLY)
        if count == 0 or not properties:
            return {n: _empty(each, length) for n, each, length in properties}
        return self._even(count, properties) or self._uneven(count, properties)

    def _even(
        self, count: int, properties: list[tuple[str, str, str | None]]
    ) -> dict[str, Column] | None:
        """Columns of an element whose lists have the same length in all rows."""
        at, fields = self.at, []
        for k, (_, each, length) in enumerate(properties):
            width = 1
            if length is not None:
                fields.append((f"n{k}", self.order + length))
                width = self._length(at, length)
                at += np.dtype(length).itemsize
            fields.append((f"v{k}", self.order + each, (width,)))  # type: ignore[arg-type]
            at += np.dtype(each).itemsize * width
        row = np.dtype(fields)
        if row.itemsize * count > len(self.body) - self.at:
            return None
        table = np.frombuffer(self.body, row, count, self.at)
        columns: dict[str, Column] = {}
        for k, (name, each, length) in enumerate(properties):
            values = table[f"v{k}"].reshape(-1).astype(each)
            if length is not None:
                lengths = table[f"n{k}"].astype(length)
                if (lengths != lengths[0]).any():
                    return None
                columns[name] = Lists(lengths, values)
            else:
                columns[name] = values
        self.at += row.itemsize * count
        return columns

    def _uneven(
        self, count: int, properties: list[tuple[str, str, str | None]]
    ) -> dict[str, Column]:
        starts = np.zeros((len(properties), count), np.int64)
        widths = np.ones((len(properties), count), np.int64)
        sizes = [np.dtype(each).itemsize for _, each, _ in properties]
        at = self.at
        for row in range(count):
            for k, (_, _, length) in enumerate(properties):
                width = 1
                if length is not None:
                    widths[k, row] = width = self._length(at, length)
                    at += int(length[1])
                starts[k, row] = at
                at += width * sizes[k]
        if at > len(self.body):
            raise UserError(EARLY)
        self.at = at
        octets = np.frombuffer(self.body, np.uint8)
        columns: dict[str, Column] = {}
        for k, (name, each, length) in enumerate(properties):
            raw = octets[_runs(starts[k], widths[k] * sizes[k])]
            values = raw.view(self.order + each).astype(each)
            columns[name] = values if length is None else Lists(widths[k].astype(length), values)
        return columns

    def _length(self, at: int, kind: str) -> int:
        code = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}.get(kind)
        if code is None:
            raise UserError("counts a list in floats: export the mesh again.")
        try:
            (length,) = struct.unpack_from(self.order + code, self.body, at)
        except struct.error:
            raise UserError(EARLY) from None
        if not 0 <= length <= len(self.body):
            raise UserError(f"has a list of {length} entries: export the mesh again.")
        return length


class _Text:
    def __init__(self, body: bytes) -> None:
        self.words, self.at = body.split(), 0

    def left(self) -> bool:
        """Whether there is more than was asked for."""
        return self.at < len(self.words)

    def element(
        self, name: str, count: int, properties: list[tuple[str, str, str | None]]
    ) -> dict[str, Column]:
        """All columns of one element."""
        if count * len(properties) > len(self.words) - self.at:
            raise UserError(EARLY)
        lengths: dict[str, list[int]] = {n: [] for n, _, length in properties if length}
        entries: dict[str, list[bytes]] = {n: [] for n, _, _ in properties}
        if not lengths:
            stop = self.at + count * len(properties)
            for k, (n, _, _) in enumerate(properties):
                entries[n] = self.words[self.at + k : stop : len(properties)]
            self.at = stop
        else:
            for _ in range(count):
                for n, _, length in properties:
                    width = 1
                    if length is not None:
                        width = self._length()
                        lengths[n].append(width)
                    entries[n] += self.words[self.at : self.at + width]
                    self.at += width
            if self.at > len(self.words):
                raise UserError(EARLY)
        columns: dict[str, Column] = {}
        for n, each, length in properties:
            values = _numbers(entries[n], each, f"'{n}' of element '{name}'")
            columns[n] = values
            if length is not None:
                columns[n] = Lists(np.array(lengths[n], np.int64).astype(length), values)
        return columns

    def _length(self) -> int:
        if self.at >= len(self.words):
            raise UserError(EARLY)
        word = self.words[self.at]
        if not word.isdigit() or len(word) > 9:
            shown = word[:20].decode("latin-1")
            raise UserError(f"has '{shown}' where a list's length should be: export it again.")
        self.at += 1
        return int(word)


def _numbers(words: list[bytes], kind: str, what: str) -> np.ndarray:
    try:
        values = np.array(list(map(float, words)), dtype=np.float64)
    except ValueError:
        for word in words:
            if not re.fullmatch(rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf\w*)", word,
                                re.IGNORECASE):  # fmt: skip
                shown = word[:20].decode("latin-1")
                break
        raise UserError(
            f"has '{shown}' where {what} should be a number: export it again, with decimal points."
        ) from None
    if kind[0] == "f":
        return values.astype(kind)
    limits = np.iinfo(kind)
    if len(values) and not (values.min() >= limits.min and values.max() <= limits.max):
        raise UserError(f"has numbers in {what} that its type cannot represent: export it again.")
    return values.astype(kind)


def _runs(start: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Concatenate ``start, start + 1, …`` over all runs."""
    total = np.cumsum(length)
    return np.arange(int(total[-1]) if len(total) else 0) + np.repeat(
        start - total + length, length
    )


def _empty(each: str, length: str | None) -> Column:
    values = np.zeros(0, each)
    return values if length is None else Lists(np.zeros(0, length), values)


def _fresh(layout: dict, name: str) -> bool:
    return name not in {n for n, _, _ in list(layout.values())[-1][1]}


def _type(name: str) -> str:
    if name not in TYPES:
        raise UserError(
            f"has numbers of the type '{name[:20]}', which PLY does not define: export it again."
        )
    return TYPES[name]
