"""OBJ files. Faces stay in the file's order, whereas trimesh groups them by material.

Normals are ignored: most are face normals of a smooth surface, and would make it faceted.
"""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from styleexp.inputs import images
from styleexp.inputs.meshes import precision, references
from styleexp.inputs.meshes.mesh import Carrier
from styleexp.inputs.meshes.welding import check_indices, plural
from styleexp.system.errors import UserError

# A line of an MTL file that names an image, after options such as ``-s 1 1 1`` or ``-bm 0.5``.
MAP = re.compile(
    r"^(\s*(?:map_\w+|bump|disp|decal|refl|norm)\s+"
    r"(?:-[a-z]+(?:\s+(?:on|off|[-+.\d][-+.\de]*|[rgbmlz](?=\s)|sphere))*\s+)*)(\S.*?)\s*$",
    re.IGNORECASE | re.MULTILINE,
)

OTHERS = ("l", "p", "curv", "curv2", "surf", "parm", "trim", "hole", "sp", "con")


def read_obj(data: bytes, path: Path) -> tuple[np.ndarray, Carrier, list[str]]:
    """Read the rows' positions, the carrier, and notes."""
    tables: dict[str, list[list[str]]] = {"v": [], "vt": []}
    polygons: list[list[int]] = []  # v and vt of each corner
    polygon_part, polygon_material = [], []
    parts: dict[str, int] = {}
    labels: dict[str, dict[str, int]] = {"g": {}, "s": {}}
    label, polygon_label = {"g": -1, "s": -1}, {"g": list[int](), "s": list[int]()}
    objects = False
    ignored: dict[str, int] = {}
    materials: dict[str, int] = {}
    libraries: list[str] = []
    part, material = path.stem, -1

    for number, line in enumerate(_text(data).replace("\\\n", " ").split("\n"), 1):
        key, _, rest = line.strip().partition(" ")
        rest = rest.strip()
        if key in tables:
            tables[key].append(rest.split("#")[0].split())
        elif key == "f":
            polygon = []
            for word in rest.split("#")[0].split():
                for given, table in zip(word.split("/"), tables.values(), strict=False):
                    value = _index(given, number) if given else -len(table) - 1  # -1 from 0: none
                    if value == 0:
                        raise UserError(
                            f"has index 0 in line {number}, but OBJ counts from 1: export it again."
                        )
                    polygon.append(value - 1 if value > 0 else len(table) + value)
                polygon += [-1] * (len(polygon) % 2)
            polygons.append(polygon)
            polygon_part.append(parts.setdefault(part, len(parts)))
            polygon_material.append(material)
            for word, current in label.items():
                polygon_label[word].append(current)
        elif key == "o":
            objects = True
            part = rest or path.stem
        elif key in labels:
            label[key] = labels[key].setdefault(rest, len(labels[key]))
        elif key in OTHERS:
            ignored[key] = ignored.get(key, 0) + 1
        elif key == "usemtl":
            material = materials.setdefault(rest, len(materials))
        elif key == "mtllib":
            libraries.append(rest)

    notes: list[str] = []
    if polygons and not data.rstrip(b" \t\0").endswith((b"\n", b"\r")):
        notes.append("its last line is incomplete: if the file was truncated, faces are missing")
    if ignored:
        lines = plural(sum(ignored.values()), "line", "lines")
        notes.append(f"left out {lines} of points, lines and curves ({', '.join(ignored)})")
    positions, shades = _vertices(tables["v"])
    colors = None if shades is None else _bytes(shades)
    counts = np.array([len(polygon) // 2 for polygon in polygons], dtype=np.int64)
    index = np.array([i for polygon in polygons for i in polygon], dtype=np.int64).reshape(-1, 2)
    check_indices(index[:, 0], len(positions))
    corner, owner = triangulate(counts, positions[index[:, 0]], notes)
    if len(counts) and not len(corner):
        raise UserError("has no face with three corners: export the mesh again.")
    if len(index) and index[:, 1].max() >= len(tables["vt"]):
        notes.append("left out the texture coordinates: faces refer to some that do not exist")
        index[:, 1] = -1

    chosen = {
        word: (tuple(names), np.array(polygon_label[word], dtype=np.int64)[owner])
        for word, names in labels.items()
        if names
    }
    part_names, face_part = tuple(parts), np.array(polygon_part, dtype=np.int64)[owner]
    if "g" in chosen and not objects:
        groups, group = chosen["g"]
        part_names = (*groups, path.stem)
        face_part = np.where(group < 0, len(groups), group)
    # A row is a combination of position and texture coordinate.
    rows, inverse = np.unique(index[corner.ravel()], axis=0, return_inverse=True)
    unused = len(positions) - len(np.unique(rows[:, 0]))
    if unused and len(corner):
        notes.append(f"left out {plural(unused, 'vertex', 'vertices')} that no face uses")
    mtl, textures, known = _materials(path, libraries, notes)
    carrier = Carrier(
        inverse.reshape(-1, 3),
        rows[:, 0],
        np.zeros(len(corner), dtype=bool),
        precision=precision.of_text([word for line in tables["v"] for word in line[:3]], positions),
        uv=_uv(tables["vt"], rows[:, 1]),
        colors=None if colors is None else colors[rows[:, 0]],
        shades=None if shades is None else shades[rows[:, 0]],
        labels=chosen,
        objects=objects,
        parts=part_names or (path.stem,),
        face_part=face_part,
        materials=tuple(known.get(name) or surface(name) for name in materials),
        face_material=np.array(polygon_material, dtype=np.int64)[owner],
        mtl=mtl,
        textures=textures,
    )
    return positions[rows[:, 0]] if len(corner) else positions, carrier, notes


def triangulate(
    counts: np.ndarray, points: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate polygons, in order: as fans, and quads along the inner diagonal.

    ``counts`` (polygons,) and ``points`` (sum of counts, 3) are runs of corners. Returns triangles
    (t, 3) as corner indices, and the polygon (t,) of each.
    """
    start = np.cumsum(counts) - counts
    corner = np.arange(len(points))
    quads = start[counts == 4, None] + np.arange(4)
    a, b, c, d = (points[quads[:, k]] for k in range(4))
    apart = np.einsum("ij,ij->i", np.cross(b - a, c - a), np.cross(c - a, d - a)) < 0
    corner[quads[apart]] = np.roll(quads[apart], -1, axis=1)

    triangles = np.maximum(counts - 2, 0)
    owner = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    fans = start[owner, None] + np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    if (small := int((counts < 3).sum())) > 0:
        number = plural(small, "face", "faces")
        notes.append(f"left out {number} with fewer than three corners")
    if (large := int((counts > 3).sum())) > 0:
        number = plural(large, "quad or larger polygon", "quads and larger polygons")
        notes.append(f"triangulated {number}")
    return corner[fans], owner


def surface(name: str, image: Any = None, color: Any = None) -> Any:
    """A matt material; ``color`` is red, green, blue, alpha in [0, 1]."""
    return trimesh.visual.material.PBRMaterial(
        name=name,
        baseColorTexture=image,
        baseColorFactor=color if color is not None else [1.0] * 4 if image else [0.8] * 3 + [1.0],
        metallicFactor=0.0,
        roughnessFactor=1.0,
        alphaMode="BLEND" if color is not None and color[3] < 1.0 else None,
    )


def _index(word: str, line: int) -> int:
    try:
        value = int(word)
    except ValueError:
        value = 1 << 62
    if abs(value) >= 1 << 62:
        raise UserError(f"has the index '{word[:20]}' in line {line}: export it again.")
    return value


def _text(data: bytes) -> str:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if "\0" in text:
        raise UserError("is binary where text was expected: export the mesh again.")
    return text.replace("\r\n", "\n").replace("\r", "\n").replace("\t", " ")


def _vertices(lines: list[list[str]]) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions (n, 3), and colours (n, 3) as stored, NaN for lines without.

    Lines are ``x y z``, ``x y z w``, ``x y z r g b`` or ``x y z w r g b``; w is ignored.
    """
    if min(map(len, lines), default=3) < 3:
        raise UserError("has a vertex with fewer than three coordinates: export it again.")
    table = np.full((len(lines), 6), np.nan)
    for number, line in enumerate(lines):
        color = line[4:7] if len(line) >= 7 else line[3:6]
        words = [*line[:3], *color] if len(color) == 3 else line[:3]
        try:
            table[number, : len(words)] = list(map(float, words))
        except ValueError:
            wrong = next(word for word in words if not _number(word))
            raise UserError(
                f"has '{wrong[:20]}' where vertex {number + 1} should have a number: export it "
                "again, with decimal points."
            ) from None
    colors = table[:, 3:]
    return table[:, :3].copy(), None if np.isnan(colors).all() else colors.copy()


def _bytes(shades: np.ndarray) -> np.ndarray:
    """8-bit colours (n, 4) from floats up to 1 or numbers up to 255; white if missing."""
    top = 1.0 if np.nanmax(shades) > 1.0 else 255.0
    values = np.clip(np.where(np.isnan(shades), 255.0, shades * top), 0, 255).round()
    return np.insert(values, 3, 255, axis=1).astype(np.uint8)


def _number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _uv(lines: list[list[str]], chosen: np.ndarray) -> np.ndarray | None:
    """Texture coordinates (rows, 2), zero for rows without; None if no row has them."""
    if not (chosen >= 0).any():
        return None
    return np.array([[*line, "0", "0"][:2] for line in [*lines, []]], dtype=np.float64)[chosen]


def _materials(
    path: Path, libraries: list[str], notes: list[str]
) -> tuple[str, dict[str, bytes], dict[str, Any]]:
    """Text of the material libraries, the images they name, and the materials by name."""
    texts: list[str] = []
    textures: dict[str, bytes] = {}
    pictures: dict[str, bytes] = {}  # only decodable ones
    root = path.parent
    for library in libraries:
        # One line may name several libraries, or one whose name has spaces.
        for name in [library] if references.find(library, root, root)[0] else library.split():
            file, reason = references.find(name, root, root)
            content = b"" if file is None else file.read_bytes()
            if file is None or b"\0" in content:
                reason = reason or "is binary"
                notes.append(f"saved without the material library '{name}': it {reason}")
                continue
            texts.append(_text(content))
            for wanted in dict.fromkeys(match[2] for match in MAP.finditer(texts[-1])):
                image, reason = references.find(wanted, file.parent, root)
                if image is None:
                    notes.append(f"saved without the texture '{wanted}': it {reason}")
                    continue
                content = image.read_bytes()
                textures.setdefault(wanted, content)
                if fault := images.fault(content):
                    notes.append(f"kept the texture '{wanted}' in OBJ only: it {fault}")
                else:
                    pictures.setdefault(wanted, content)
    text = "\n".join(texts)
    plain = MAP.sub(lambda match: f"{match[1].split()[0]} {match[2]}", text)
    known = {}
    for name, found in trimesh.exchange.obj.parse_mtl(plain, resolver=pictures).items():
        color = np.append(np.resize(found.get("diffuse", 0.8), 3), 1.0)
        with contextlib.suppress(ValueError):
            color[3] = 1.0 - float(found["tr"][-1]) if "tr" in found else color[3]
            color[3] = float(found["d"][-1]) if "d" in found else color[3]
        if found.get("image"):
            color[:3] = 1.0  # glTF multiplies the two, MTL viewers do not
        known[name] = surface(name, found.get("image"), color)
    return text, textures, known
