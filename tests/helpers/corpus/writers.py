"""Good files of every kind, and the same with something changed."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from collections.abc import Callable

import numpy as np

Content = bytes | Callable[[], bytes]

# ------------------------------------------------------------------------------------- shapes


def icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """12 vertices and 20 faces, outward."""
    from scipy.spatial import ConvexHull

    g = (1 + 5**0.5) / 2
    points = np.array([(0, a, b * g) for a in (-1, 1) for b in (-1, 1)], dtype=float)
    points = np.concatenate([np.roll(points, k, axis=1) for k in range(3)])
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces[np.lexsort(faces.T)]


def divided(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each face into four."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (inverse.reshape(-1, 3) + len(points)).T
    a, b, c = faces.T
    new = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return np.concatenate([points, points[edges].mean(axis=1)]), new


V, F = divided(*icosahedron())  # 42 vertices, 80 faces
V = V / np.linalg.norm(V, axis=1, keepdims=True)
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(p) for p, _ in parts)])
    return (
        np.concatenate([p for p, _ in parts]),
        np.concatenate([f + s for (_, f), s in zip(parts, starts, strict=False)]),
    )


# ------------------------------------------------------------------------------------ formats


def obj(points=V, faces=F, before: str = "", after: str = "", eol: str = "\n") -> bytes:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(points, float).tolist()]
    lines += ["f " + " ".join(str(int(i) + 1) for i in f) for f in faces]
    text = before + "\n".join(lines) + "\n" + after
    return text.replace("\n", eol).encode()


def off(points=V, faces=F) -> bytes:
    lines = ["OFF", f"{len(points)} {len(faces)} 0"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in np.asarray(points, float).tolist()]
    lines += [" ".join(map(str, [len(f), *map(int, f)])) for f in faces]
    return ("\n".join(lines) + "\n").encode()


def ply(
    points=V, faces=F, kind="binary_little_endian", count=None, face_count=None, extra=b""
) -> bytes:
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(points) if count is None else count}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces) if face_count is None else face_count}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    if kind == "ascii":
        body = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in np.asarray(points, float).tolist())
        body += "".join(f"{len(f)} {' '.join(map(str, map(int, f)))}\n" for f in faces)
        return head + body.encode() + extra
    order = ">" if "big" in kind else "<"
    body = np.asarray(points, f"{order}f4").tobytes()
    body += b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)
    return head + body + extra


def stl(points=V, faces=F, count=None) -> bytes:
    rows = np.zeros(len(faces), np.dtype([("f", "<12f4"), ("u", "<u2")]))
    rows["f"][:, 3:] = np.asarray(points, "<f4")[np.asarray(faces)].reshape(-1, 9)
    return bytes(80) + struct.pack("<I", len(faces) if count is None else count) + rows.tobytes()


def ascii_stl(points=V, faces=F, end: str = "endsolid ball\n") -> bytes:
    out = ["solid ball"]
    for f in faces:
        out += ["facet normal 0 0 0", "outer loop"]
        out += ["vertex {!r} {!r} {!r}".format(*points[i].tolist()) for i in f]
        out += ["endloop", "endfacet"]
    return ("\n".join(out) + "\n" + end).encode()


def gltf_parts(points=V, faces=F) -> tuple[dict, bytes]:
    """The document and the buffer of a mesh, float positions and 16-bit indices."""
    positions = np.asarray(points, "<f4").tobytes()
    indices = np.asarray(faces, "<u2").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "ball"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(points),
                "type": "VEC3",
                "min": np.min(points, axis=0).tolist(),
                "max": np.max(points, axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5123, "count": 3 * len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(positions)},
            {"buffer": 0, "byteOffset": len(positions), "byteLength": len(indices)},
        ],
        "buffers": [{"byteLength": len(positions) + len(indices)}],
    }
    return document, positions + indices


def changed(change: Callable[[dict], None], points=V, faces=F) -> tuple[dict, bytes]:
    document, buffer = gltf_parts(points, faces)
    change(document)
    return document, buffer


def glb(document: dict, buffer: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    buffer += b"\0" * (-len(buffer) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf(document: dict, buffer: bytes, uri: str | None = None) -> bytes:
    if uri is None:
        uri = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    document["buffers"][0]["uri"] = uri
    return json.dumps(document).encode()


def good_glb() -> bytes:
    return glb(*gltf_parts())


def pixels(height=48, width=64) -> np.ndarray:
    """A picture with structure, (height, width, 3), 8 bits."""
    y, x = np.mgrid[0:height, 0:width]
    wave = np.sin(x / 3) * np.cos(y / 4)
    return np.stack([127 + 120 * wave, 255 * x / width, 255 * y / height], axis=-1).astype(np.uint8)


def picture(kind: str, array=None, mode: str | None = None, **options) -> Callable[[], bytes]:
    def make() -> bytes:
        from PIL import Image

        image = Image.fromarray(pixels() if array is None else array)
        out = io.BytesIO()
        (image.convert(mode) if mode else image).save(out, kind, **options)
        return out.getvalue()

    return make


def png_claiming(width: int, height: int) -> bytes:
    """A PNG of a hundred bytes that says it is as large as that."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + check

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    data = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def deep(array: np.ndarray, kind: str = "png", **options) -> Callable[[], bytes]:
    """More than 8 bits of several colours, which Pillow can't write."""

    def make() -> bytes:
        import imagecodecs
        import tifffile

        if kind == "png":
            return imagecodecs.png_encode(array)
        out = io.BytesIO()
        tifffile.imwrite(out, array, **options)
        return out.getvalue()

    return make


def animated(kind: str) -> Callable[[], bytes]:
    """Two frames, or pages."""

    def make() -> bytes:
        from PIL import Image

        frames = [Image.fromarray(pixels()), Image.fromarray(pixels()[::-1].copy())]
        out = io.BytesIO()
        frames[0].save(out, kind, save_all=True, append_images=frames[1:])
        return out.getvalue()

    return make


def rotated() -> bytes:
    """A JPEG that an EXIF entry turns."""
    from PIL import Image

    image = Image.fromarray(pixels())
    exif = image.getexif()
    exif[0x0112] = 6
    out = io.BytesIO()
    image.save(out, "JPEG", exif=exif)
    return out.getvalue()


def part(make: Content, percent: int) -> Callable[[], bytes]:
    """The beginning of a file."""

    def cut() -> bytes:
        whole = make() if callable(make) else make
        return whole[: len(whole) * percent // 100]

    return cut


def whole_files() -> dict[str, bytes]:
    """The ball, once in each format."""
    return {
        "obj": obj(),
        "off": off(),
        "stl": stl(),
        "ascii.stl": ascii_stl(),
        "ply": ply(),
        "big.ply": ply(kind="binary_big_endian"),
        "ascii.ply": ply(kind="ascii"),
        "glb": good_glb(),
        "gltf": gltf(*gltf_parts()),
    }


JUNK = bytes(np.random.default_rng(3).integers(0, 256, 4000, dtype=np.uint8))
TEXT = b"hello, world\n" * 20
HTML = b"<!DOCTYPE html><html><body>404 Not Found</body></html>"
BALL = {"faces": 80, "vertices": 42}
BOX = {"faces": 12, "vertices": 8}
