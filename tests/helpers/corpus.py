"""Bad and odd files, each with what has to come of it.

`CASES` is what tests/inputs/test_corpus.py tries and docs/robustness.md lists. Nothing of it is
stored: every file is made when it is asked for. A case works, or works with a repair that the user
is told, or is refused with one sentence.
"""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

WORKS, REPAIRED, REFUSED = "works", "repaired", "refused"

Content = bytes | Callable[[], bytes]


@dataclass(frozen=True)
class Case:
    """One file, and what has to come of it."""

    group: str
    name: str
    """The file's name, with folders where it lies in some."""
    what: str
    content: Content
    outcome: str
    says: str = ""
    """Part of the repair's note or of the refusal."""
    faces: int | None = None
    """Of the result, where it works."""
    vertices: int | None = None
    beside: dict[str, Content] = field(default_factory=dict)
    """Files that it refers to, or should not be able to."""
    links: dict[str, str] = field(default_factory=dict)
    """Symbolic links beside it, and where they lead."""
    style: bool = False
    """Taken as the style, not as the source."""

    def write(self, folder: Path) -> Path:
        """Make the files in an empty folder of their own; returns the one to load."""
        home = folder / "home"
        for name, content in {self.name: self.content, **self.beside}.items():
            path = home / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content() if callable(content) else content)
        for name, target in self.links.items():
            path = home / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(target)
        return home / self.name


CASES: dict[str, Case] = {}


def case(group: str, name: str, what: str, content: Content, outcome: str, says: str = "", **more):
    """Add a case to the corpus."""
    assert name not in CASES, name
    CASES[name] = Case(group, name, what, content, outcome, says, **more)


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


# ------------------------------------------------------------------------------------- corpus


JUNK = bytes(np.random.default_rng(3).integers(0, 256, 4000, dtype=np.uint8))
TEXT = b"hello, world\n" * 20
HTML = b"<!DOCTYPE html><html><body>404 Not Found</body></html>"
BALL = {"faces": 80, "vertices": 42}
BOX = {"faces": 12, "vertices": 8}


def _whole() -> dict[str, Content]:
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


def _truncated() -> None:
    group = "meshes cut off"
    for kind, whole in _whole().items():
        assert isinstance(whole, bytes)
        for percent in (0, 3, 10, 30, 60, 90, 99):
            cut = whole[: len(whole) * percent // 100]
            # Nothing in an OBJ file says how many faces there are.
            untold = kind == "obj" and percent >= 90
            case(
                group,
                f"cut{percent}.{kind}",
                f"the first {percent} %",
                cut,
                REPAIRED if untold else REFUSED,
                "truncated" if untold else "",
            )
        said, needed = kind in ("off", "ascii.ply", "ascii.stl"), kind != "obj"
        case(
            group,
            f"last.{kind}",
            "all but its last byte",
            whole[:-1],
            WORKS if said else REFUSED if needed else REPAIRED,
            "" if needed else "truncated",
        )
    document, buffer = gltf_parts()
    outside = gltf(document, buffer, "ball.bin")
    case(
        group,
        "buffer.gltf",
        "with half of its buffer",
        outside,
        REFUSED,
        beside={"ball.bin": buffer[: len(buffer) // 2]},
    )


def _counts() -> None:
    group = "meshes with wrong counts and indices"
    tail = obj()

    def face(line: str) -> bytes:
        return tail + f"f {line}\n".encode()

    case(group, "zero.obj", "index 0", face("0 1 2"), REFUSED, "OBJ counts from 1")
    case(group, "beyond.obj", "an index beyond the vertices", face("1 2 43"), REFUSED, "vertex 42")
    case(
        group,
        "before.obj",
        "a relative index before the first",
        face("1 2 -43"),
        REFUSED,
        "vertex -1",
    )
    case(group, "relative.obj", "relative indices", face("-1 -2 -3"), WORKS, faces=81, vertices=42)
    case(group, "large.obj", "an index of 10^18", face(f"1 2 {10**18}"), REFUSED, "vertex 9999")
    case(group, "larger.obj", "an index of 10^30", face(f"1 2 {10**30}"), REFUSED, "in line 123")
    case(group, "float.obj", "an index of 1.5", face("1 2 1.5"), REFUSED, "in line 123")
    case(group, "word.obj", "a word for an index", face("1 2 x"), REFUSED, "in line 123")
    case(
        group,
        "manyslashes.obj",
        "an index of 1/2/3/4",
        face("1/1/1/1 2 3"),
        REPAIRED,
        "texture",
        faces=81,
    )
    case(
        group,
        "uvbeyond.obj",
        "texture coordinates that don't exist",
        face("1/9 2/9 3/9"),
        REPAIRED,
        "texture coordinates",
        faces=81,
    )

    for name, number in (("more", 50), ("fewer", 30), ("minus", -1), ("vast", 10**15)):
        says = {"fewer": ""}.get(name, "")
        for kind in ("binary_little_endian", "ascii"):
            short = "ascii" if kind == "ascii" else "binary"
            case(
                group,
                f"vertices-{name}-{short}.ply",
                f"{number} vertices promised, 42 there",
                ply(kind=kind, count=number),
                REFUSED,
                says,
            )
            number_faces = {"fewer": 60}.get(name, number + 40)
            if name != "fewer":
                some = name == "minus"
                case(
                    group,
                    f"faces-{name}-{short}.ply",
                    f"{number_faces} faces promised, 80 there",
                    ply(kind=kind, face_count=number_faces),
                    REPAIRED if some else REFUSED,
                    "after its last element" if some else "",
                )
        whole = off().split(b"\n", 2)
        case(
            group,
            f"vertices-{name}.off",
            f"{number} vertices promised, 42 there",
            b"\n".join([whole[0], f"{number} 80 0".encode(), whole[2]]),
            REFUSED,
        )
        if name != "fewer":
            case(
                group,
                f"faces-{name}.off",
                f"{number + 40} faces promised, 80 there",
                b"\n".join([whole[0], f"42 {number + 40} 0".encode(), whole[2]]),
                REPAIRED if name == "minus" else REFUSED,
            )
    case(
        group, "negative.ply", "a negative index", ply(faces=[*F, (0, 1, -1)]), REFUSED, "vertex -1"
    )
    case(
        group,
        "index.ply",
        "an index beyond the vertices",
        ply(faces=[*F, (0, 1, 2**31 - 1)]),
        REFUSED,
        "vertex 2147483647",
    )
    case(group, "index.off", "an index beyond the vertices", off(faces=[*F, (0, 1, 99)]), REFUSED)
    case(group, "negative.off", "a negative index", off(faces=[*F, (0, 1, -2)]), REFUSED)
    case(
        group,
        "more.stl",
        "4294967295 faces promised, 80 there",
        stl(count=2**32 - 1),
        REFUSED,
        "ends too early",
    )
    case(group, "fewer.stl", "60 faces promised, 80 there", stl(count=60), REFUSED)
    case(group, "none.stl", "no face", stl(faces=F[:0]), REFUSED, "no faces")

    def accessor(number: int, **values):
        return lambda document: document["accessors"][number].update(values)

    def without_view(count: int):
        def change(document: dict) -> None:
            document["accessors"][0].pop("bufferView")
            document["accessors"][0]["count"] = count

        return change

    def view(number: int, **values):
        return lambda document: document["bufferViews"][number].update(values)

    for name, what, change, says in (
        ("count", "more positions than its buffer holds", accessor(0, count=10**9), ""),
        ("minus", "a negative count", accessor(0, count=-3), ""),
        ("nothing", "10^13 positions of nothing", without_view(10**13), "10000000000000"),
        ("type", "an unknown type of numbers", accessor(0, componentType=1), ""),
        ("vector", "positions of two coordinates", accessor(0, type="VEC2"), ""),
        ("shorter", "fewer positions than its indices need", accessor(0, count=20), "vertex"),
        ("view", "a view beyond its buffer", view(1, byteOffset=10**7), ""),
        ("length", "a view of negative length", view(1, byteLength=-9), ""),
        ("buffer", "a view of a buffer that isn't there", view(0, buffer=7), ""),
    ):
        case(group, f"{name}.glb", what, glb(*changed(change)), REFUSED, says)


def _coordinates() -> None:
    group = "meshes with odd coordinates"
    bad = V.copy()
    bad[7, 1] = np.nan
    infinite = V.copy()
    infinite[7] = np.inf
    for kind, write in (
        ("obj", obj),
        ("off", off),
        ("ply", ply),
        ("stl", stl),
        ("ascii.stl", ascii_stl),
    ):
        case(
            group, f"nan.{kind}", "a coordinate that is NaN", write(bad), REFUSED, "NaN or infinite"
        )
        case(
            group,
            f"infinite.{kind}",
            "infinite coordinates",
            write(infinite),
            REFUSED,
            "NaN or infinite",
        )
    document, buffer = gltf_parts()
    case(
        group,
        "nan.glb",
        "a coordinate that is NaN",
        glb(document, np.asarray(bad, "<f4").tobytes() + buffer[42 * 12 :]),
        REFUSED,
        "NaN or infinite",
    )
    for scale, name in ((1e30, "1e30"), (1e-30, "1e-30"), (1e7, "1e7"), (1e-7, "1e-7")):
        case(group, f"scale{name}.obj", f"a radius of {name}", obj(V * scale), WORKS, **BALL)
        case(group, f"scale{name}.ply", f"a radius of {name}", ply(V * scale), WORKS, **BALL)
        case(
            group,
            f"style{name}.obj",
            f"a style with a radius of {name}",
            obj(V * scale),
            WORKS,
            style=True,
        )
    case(group, "subnormal.ply", "a radius of 1e-40", ply(V * 1e-40), WORKS, **BALL)
    case(group, "scale1e200.obj", "a radius of 1e200", obj(V * 1e200), REFUSED, "scale the mesh")
    case(group, "scale1e-200.obj", "a radius of 1e-200", obj(V * 1e-200), REFUSED, "scale the mesh")
    case(
        group,
        "far.obj",
        "four million radii from the origin",
        obj(V + 4e6),
        REPAIRED,
        "far from the origin",
        **BALL,
    )
    case(group, "point.obj", "all vertices in one place", obj(V * 0), REFUSED, "no extent")
    case(group, "line.obj", "all vertices on a line", obj(V * [1, 0, 0]), REFUSED, "degenerate")
    case(
        group,
        "needle.obj",
        "a million times longer than wide",
        obj(V * [1e6, 1, 1]),
        REFUSED,
        "the views don't see",
    )
    case(
        group,
        "flat.obj",
        "without thickness",
        obj(CUBE[[0, 2, 6, 4]], [[0, 1, 2], [0, 2, 3]]),
        WORKS,
        faces=2,
        vertices=4,
    )
    unused = np.concatenate([V, [[np.nan] * 3]])
    case(
        group,
        "unused.obj",
        "NaN in a vertex that no face uses",
        obj(unused, F),
        REPAIRED,
        "no face uses",
        **BALL,
    )
    far = np.concatenate([V, [[1e6, 0, 0]]])
    case(
        group,
        "outlier.obj",
        "an unused vertex a million radii away",
        obj(far, F),
        REPAIRED,
        "no face uses",
        **BALL,
    )
    comma = obj().replace(b".", b",")
    case(group, "comma.obj", "decimal commas", comma, REFUSED, "decimal points")
    case(
        group,
        "flat2d.obj",
        "two coordinates a vertex",
        b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n",
        REFUSED,
        "fewer than three coordinates",
    )
    case(
        group,
        "weights.obj",
        "a fourth coordinate",
        obj().replace(b"\nf", b" 1.0\nf", 1),
        WORKS,
        **BALL,
    )


def _topology() -> None:
    group = "meshes with odd topology"
    ball = (V, F)
    case(
        group,
        "degenerate.obj",
        "faces without area",
        obj(V, [*F, (0, 0, 1), (3, 3, 3)]),
        REPAIRED,
        "degenerate",
        faces=82,
        vertices=42,
    )
    case(
        group,
        "onlydegenerate.obj",
        "nothing but such faces",
        obj(V, [(0, 0, 1), (3, 3, 3)]),
        REFUSED,
        "only degenerate",
    )
    case(group, "twice.obj", "every face twice", obj(V, [*F, *F]), WORKS, faces=160, vertices=42)
    case(
        group,
        "mirrored.obj",
        "every face twice, once turned",
        obj(V, [*F, *F[:, ::-1]]),
        WORKS,
        faces=160,
        vertices=42,
    )
    case(
        group,
        "hundredfold.obj",
        "one face a hundred times",
        obj(V, [*F, *([F[0]] * 99)]),
        WORKS,
        faces=179,
        vertices=42,
    )
    turned = F.copy()
    turned[:20] = turned[:20, ::-1]
    case(
        group,
        "turned.obj",
        "a quarter of the faces turned",
        obj(V, turned),
        REPAIRED,
        "flipped",
        **BALL,
    )
    case(group, "inward.obj", "inside out", obj(V, F[:, ::-1]), REPAIRED, "inwards", **BALL)
    case(
        group,
        "fan.obj",
        "three faces at one edge",
        obj(CUBE[:5], [(0, 1, 2), (1, 0, 3), (0, 1, 4)]),
        WORKS,
        faces=3,
        vertices=5,
    )
    case(
        group,
        "wings.obj",
        "twenty faces at one edge",
        obj(
            np.concatenate(
                [
                    [[0, 0, -1], [0, 0, 1]],
                    [[np.cos(a), np.sin(a), 0] for a in np.arange(20) * np.pi / 10],
                ]
            ),
            [(0, 1, k + 2) for k in range(20)],
        ),
        WORKS,
        faces=20,
        vertices=22,
    )
    case(
        group,
        "bowtie.obj",
        "two balls that share a vertex",
        obj(*joined(ball, (V + 2 * V[0], F))),
        WORKS,
        faces=160,
        vertices=83,
    )
    case(group, "open.obj", "a hole", obj(V, F[8:]), WORKS, faces=72)
    case(group, "sheet.obj", "one triangle", obj(V[:3], [(0, 1, 2)]), WORKS, faces=1, vertices=3)
    case(
        group, "two.obj", "two balls", obj(*joined(ball, (V + 5, F))), WORKS, faces=160, vertices=84
    )
    case(group, "nested.obj", "a ball in a ball", obj(*joined(ball, (V / 2, F))), WORKS, faces=160)
    case(
        group,
        "hollow.obj",
        "a hollow ball",
        obj(*joined(ball, (V / 2, F[:, ::-1]))),
        REPAIRED,
        "pointed inwards",
        faces=160,
    )
    tetra = (CUBE[[0, 3, 5, 6]], np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]))
    grid = [
        (tetra[0] + 3 * np.array([k % 15, k // 15 % 15, k // 225]), tetra[1]) for k in range(2000)
    ]
    case(
        group,
        "crowd.obj",
        "2000 components",
        lambda: obj(*joined(*grid)),
        WORKS,
        faces=8000,
        vertices=8000,
    )
    isolated = np.concatenate([V, V[:9] * 3])
    case(
        group,
        "isolated.obj",
        "vertices without faces",
        obj(isolated, F),
        REPAIRED,
        "no face uses",
        **BALL,
    )
    case(
        group,
        "isolated.ply",
        "vertices without faces",
        ply(isolated, F),
        REPAIRED,
        "no face uses",
        **BALL,
    )
    for kind, write in (("obj", obj), ("ply", ply), ("off", off)):
        case(
            group,
            f"quads.{kind}",
            "quads",
            write(CUBE, QUADS),
            REPAIRED,
            "triangulated",
            **BOX,
        )
    case(
        group,
        "mixed.obj",
        "triangles and quads",
        obj(CUBE, [*QUADS[:5], *[(1, 5, 7), (1, 7, 3)]]),
        REPAIRED,
        "triangulated",
        **BOX,
    )
    case(
        group,
        "mixed.ply",
        "triangles and quads, binary",
        ply(CUBE, [*QUADS[:5], *[(1, 5, 7), (1, 7, 3)]]),
        REPAIRED,
        "triangulated 5 quads",
        **BOX,
    )
    case(
        group,
        "mixed.off",
        "triangles and quads",
        off(CUBE, [*QUADS[:5], *[(1, 5, 7), (1, 7, 3)]]),
        REPAIRED,
        "triangulated",
        **BOX,
    )
    circle = np.array([(np.cos(a), np.sin(a), 0) for a in np.arange(500) * np.pi / 250])
    case(
        group,
        "disc.obj",
        "one face of 500 corners",
        obj(circle, [range(500)]),
        REPAIRED,
        "triangulated",
        faces=498,
        vertices=500,
    )
    case(
        group,
        "pairs.obj",
        "faces of two corners",
        obj(V, [*F.tolist(), (0, 1), (5,)]),
        REPAIRED,
        "fewer than three",
        **BALL,
    )
    case(
        group,
        "onlypairs.obj",
        "nothing but such faces",
        obj(V, [(0, 1), (5,)]),
        REFUSED,
        "three corners",
    )
    case(group, "points.obj", "a point cloud", obj(V, []), REFUSED, "point cloud")
    case(group, "points.ply", "a point cloud", ply(V, []), REFUSED, "point cloud")
    case(
        group,
        "lines.obj",
        "lines and points among the faces",
        obj(after="l 1 2 3\np 4\n"),
        REPAIRED,
        "(l, p)",
        **BALL,
    )
    case(
        group,
        "curve.obj",
        "a spline",
        obj(V, [], after="curv 0 1 1 2 3\nend\n"),
        REFUSED,
        "point cloud",
    )
    case(group, "comment.obj", "comments alone", b"# nothing here\n", REFUSED, "no mesh")
    soup = V[F].reshape(-1, 3)
    case(
        group,
        "soup.obj",
        "every face with vertices of its own",
        obj(soup, np.arange(240).reshape(-1, 3)),
        WORKS,
        **BALL,
    )
    case(group, "soup.stl", "every face with vertices of its own", stl(), WORKS, **BALL)
    case(
        group,
        "crossing.obj",
        "two balls that cut each other",
        obj(*joined(ball, (V + 0.5, F))),
        WORKS,
        faces=160,
        vertices=84,
    )
    n = 24
    angle = np.arange(n) * 2 * np.pi / n
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    side = 0.3 * (np.cos(angle / 2)[:, None] * ring + np.sin(angle / 2)[:, None] * [0, 0, 1])
    band = [(k, k + 1, n + k + 1, n + k) for k in range(n - 1)] + [(n - 1, n, 0, 2 * n - 1)]
    case(
        group,
        "moebius.obj",
        "a one-sided band",
        obj(np.concatenate([ring - side, ring + side]), band),
        REPAIRED,
        "triangulated",
        faces=48,
        vertices=48,
    )
    case(
        group,
        "onlystyle.obj",
        "one triangle as the style",
        obj(V[:3], [(0, 1, 2)]),
        WORKS,
        style=True,
    )
    case(
        group,
        "openstyle.obj",
        "a style with a hole and turned faces",
        obj(V, turned[8:]),
        REPAIRED,
        "flipped",
        style=True,
    )


def _text() -> None:
    group = "names, text and line ends"
    for name, eol in (("crlf", "\r\n"), ("cr", "\r")):
        case(group, f"{name}.obj", f"line ends {eol!r}", obj(eol=eol), WORKS, **BALL)
        case(
            group,
            f"{name}.off",
            f"line ends {eol!r}",
            off().replace(b"\n", eol.encode()),
            WORKS,
            **BALL,
        )
    windows = ply(kind="ascii").replace(b"\n", b"\r\n")
    case(group, "crlf.ply", "line ends '\\r\\n', text", windows, WORKS, **BALL)
    case(
        group,
        "crlf.stl",
        "line ends '\\r\\n', text",
        ascii_stl().replace(b"\n", b"\r\n"),
        WORKS,
        **BALL,
    )
    case(group, "upper.stl", "text in upper case", ascii_stl().upper(), WORKS, **BALL)
    case(group, "bom.obj", "a byte order mark", b"\xef\xbb\xbf" + obj(), WORKS, **BALL)
    case(group, "utf16.obj", "UTF-16", obj().decode().encode("utf-16"), REFUSED, "binary")
    case(
        group,
        "latin.obj",
        "Latin-1 in a part's name",
        obj(before="o K\xe4se\n").decode().encode("latin-1"),
        WORKS,
        **BALL,
    )
    case(group, "tabs.obj", "tabs", obj().replace(b" ", b"\t"), WORKS, **BALL)
    case(group, "spaces.obj", "spaces at both ends", obj().replace(b"\n", b"  \n  "), WORKS, **BALL)
    case(
        group,
        "continued.obj",
        "lines continued by a backslash",
        obj().replace(b"f ", b"f \\\n"),
        WORKS,
        **BALL,
    )
    case(
        group,
        "long.obj",
        "a comment of a million characters",
        lambda: obj(before="# " + "x" * 10**6 + "\n"),
        WORKS,
        **BALL,
    )
    case(
        group,
        "unknown.obj",
        "keywords of other programs",
        obj(before="xyz 1 2\nvp 1 2\ns off\n"),
        WORKS,
        **BALL,
    )
    case(
        group,
        "normals.obj",
        "normals that are none",
        obj(before="vn a b c\n").replace(b"f ", b"f "),
        WORKS,
        **BALL,
    )
    case(
        group,
        "colours.obj",
        "colours from 0 to 255",
        obj().replace(b"\nf", b" \nf", 1),
        WORKS,
        **BALL,
    )
    for name in (
        "K\xe4se und \u7403 \U0001f600.obj",
        "with  spaces .obj",
        "equals=a,b{c}[d].obj",
        "$HOME ${x} %20 #1 ?.obj",
        "quote'\".obj",
        "<img src=x onerror=alert(1)>.obj",
        "-dash.obj",
        "new\nline.obj",
        "a" * 200 + ".obj",
        "UPPER.OBJ",
        "two.dots.obj",
    ):
        shown = name if len(name) < 50 else f"{name[:10]}... ({len(name)} characters)"
        case(group, name, f"the name {shown!r}", obj(), WORKS, **BALL)
    case(group, ".obj", "a name that is an extension alone", obj(), REFUSED, "no extension")
    case(group, "model.fbx", "a format that isn't read", JUNK, REFUSED, "export it as GLB")
    case(group, "model", "no extension", obj(), REFUSED, "no extension")
    case(group, "folder.obj/inside.txt", "a folder called like a mesh", TEXT, REFUSED)


def _materials() -> None:
    group = "materials and textures of OBJ files"
    mtl = "newmtl skin\nKd 1 0.5 0.2\nmap_Kd {}\n"
    uv = "".join(f"vt {k / 42} {k % 7 / 7}\n" for k in range(42))
    text = ("mtllib {}\n" + uv + "usemtl skin\n").format
    faces = ["f " + " ".join(f"{i + 1}/{i + 1}" for i in f) for f in F.tolist()]
    vertices = obj(V, []).decode()

    def with_mtl(library: str) -> bytes:
        return (vertices + text(library) + "\n".join(faces) + "\n").encode()

    def textured(name, what, wanted, outcome, says="", content=None, **more):
        beside = {"skin.mtl": mtl.format(wanted).encode()}
        if content is not None:
            beside[wanted] = content
        beside |= more.pop("beside", {})
        case(group, name, what, with_mtl("skin.mtl"), outcome, says, beside=beside, **more, **BALL)

    good = picture("PNG")
    textured("good.obj", "a material with its texture", "skin.png", WORKS, content=good)
    textured(
        "spaces.mtl.obj", "a texture with spaces in its name", "my skin 1.png", WORKS, content=good
    )
    textured("below.obj", "a texture in a folder below", "maps/skin.png", WORKS, content=good)
    textured(
        "windows.obj",
        "a texture by a Windows path",
        "C:\\art\\skin.png",
        WORKS,
        beside={"skin.png": good},
    )
    textured("gone.obj", "a texture that isn't there", "gone.png", REPAIRED, "texture 'gone.png'")
    textured(
        "cut.texture.obj",
        "a texture that is cut off",
        "skin.png",
        REPAIRED,
        "texture 'skin.png'",
        content=lambda: good()[:300],
    )
    textured(
        "text.texture.obj",
        "a texture that is text",
        "skin.png",
        REPAIRED,
        "texture 'skin.png'",
        content=TEXT,
    )
    textured(
        "svg.obj",
        "a texture that is a drawing",
        "skin.svg",
        REPAIRED,
        "texture 'skin.svg'",
        content=b"<svg/>",
    )
    textured(
        "eps.obj",
        "a texture that would start another program",
        "skin.eps",
        REPAIRED,
        "texture 'skin.eps'",
        content=b"%!PS-Adobe-3.0 EPSF-3.0\n",
    )
    textured(
        "bomb.obj",
        "a texture of 900 million pixels",
        "skin.png",
        REPAIRED,
        "texture 'skin.png'",
        content=png_claiming(30000, 30000),
    )
    case(
        group,
        "nomtl.obj",
        "a library that isn't there",
        with_mtl("gone.mtl"),
        REPAIRED,
        "gone.mtl",
        **BALL,
    )
    case(
        group,
        "emptymtl.obj",
        "an empty library",
        with_mtl("e.mtl"),
        WORKS,
        beside={"e.mtl": b""},
        **BALL,
    )
    case(
        group,
        "binarymtl.obj",
        "a library that is binary",
        with_mtl("e.mtl"),
        REPAIRED,
        "e.mtl",
        beside={"e.mtl": JUNK},
        **BALL,
    )
    case(
        group,
        "oddmtl.obj",
        "a library with numbers that are none",
        with_mtl("e.mtl"),
        WORKS,
        beside={"e.mtl": b"newmtl skin\nKd a b c\nd x\nNs\nnewmtl\nmap_Kd\n"},
        **BALL,
    )
    case(
        group,
        "nanmtl.obj",
        "a library with NaN",
        with_mtl("e.mtl"),
        WORKS,
        beside={"e.mtl": b"newmtl skin\nKd nan 2 -1\nd nan\n"},
        **BALL,
    )
    case(
        group,
        "nouse.obj",
        "a material that no library has",
        obj(before="usemtl gone\n"),
        WORKS,
        **BALL,
    )
    # What lies outside of the mesh's folder must not come in.
    secret = {"../secret/skin.png": good, "../secret/s.mtl": b"newmtl skin\nKd 1 0 0\n"}
    textured("up.obj", "a texture by ../", "../secret/skin.png", REPAIRED, "outside", beside=secret)
    textured(
        "link.obj",
        "a texture that is a link to elsewhere",
        "skin.png",
        REPAIRED,
        "outside",
        beside=secret,
        links={"skin.png": "../secret/skin.png"},
    )
    textured(
        "linked.obj",
        "a texture below a linked folder",
        "maps/skin.png",
        REPAIRED,
        "outside",
        beside=secret,
        links={"maps": "../secret"},
    )
    textured("absolute.obj", "a texture by an absolute path", "/etc/passwd", REPAIRED, "outside")
    textured(
        "device.obj", "a texture that is a device", "/dev/zero", REPAIRED, "texture '/dev/zero'"
    )
    case(
        group,
        "upmtl.obj",
        "a library by ../",
        with_mtl("../secret/s.mtl"),
        REPAIRED,
        "outside",
        beside=secret,
        **BALL,
    )
    case(
        group,
        "linkmtl.obj",
        "a library that is a link to elsewhere",
        with_mtl("s.mtl"),
        REPAIRED,
        "outside",
        beside=secret,
        links={"s.mtl": "../secret/s.mtl"},
        **BALL,
    )
    case(
        group,
        "inner.obj",
        "a library that is a link within the folder",
        with_mtl("s.mtl"),
        WORKS,
        beside={"lib/s.mtl": b"newmtl skin\nKd 1 0 0\n"},
        links={"s.mtl": "lib/s.mtl"},
        **BALL,
    )


def _gltf() -> None:
    group = "features and faults of glTF"

    def build(name, what, change, outcome, says="", kind="glb", points=V, faces=F, **more):
        document, buffer = changed(change, points, faces)
        content = glb(document, buffer) if kind == "glb" else gltf(document, buffer)
        if outcome != REFUSED:
            more = {"faces": len(faces)} | more
        case(group, f"{name}.{kind}", what, content, outcome, says, **more)

    def update(**values):
        return lambda document: document.update(values)

    def primitive(**values):
        return lambda document: document["meshes"][0]["primitives"][0].update(values)

    def node(**values):
        return lambda document: document["nodes"][0].update(values)

    build("plain", "nothing odd", update(), WORKS)
    build("uri", "its buffer as a data URI", update(), WORKS, kind="gltf")
    document, buffer = gltf_parts()
    case(
        group,
        "beside.gltf",
        "its buffer beside it",
        gltf(document, buffer, "ball.bin"),
        WORKS,
        beside={"ball.bin": buffer},
        **BALL,
    )
    case(
        group,
        "percent.gltf",
        "its buffer beside it, %20 for a space",
        gltf(document, buffer, "my%20ball.bin"),
        WORKS,
        beside={"my ball.bin": buffer},
        **BALL,
    )
    case(
        group,
        "gone.gltf",
        "a buffer that isn't there",
        gltf(document, buffer, "ball.bin"),
        REFUSED,
        "ball.bin",
    )
    outside = {"../secret/ball.bin": buffer}
    case(
        group,
        "up.gltf",
        "a buffer by ../",
        gltf(document, buffer, "../secret/ball.bin"),
        REFUSED,
        "outside",
        beside=outside,
    )
    case(
        group,
        "encoded.gltf",
        "a buffer by %2e%2e/",
        gltf(document, buffer, "%2e%2e/secret/ball.bin"),
        REFUSED,
        "outside",
        beside=outside,
    )
    case(
        group,
        "link.gltf",
        "a buffer that is a link to elsewhere",
        gltf(document, buffer, "ball.bin"),
        REFUSED,
        "outside",
        beside=outside,
        links={"ball.bin": "../secret/ball.bin"},
    )
    case(
        group,
        "absolute.gltf",
        "a buffer by an absolute path",
        gltf(document, buffer, "/etc/passwd"),
        REFUSED,
        "outside",
    )
    case(
        group,
        "file.gltf",
        "a buffer by file://",
        gltf(document, buffer, "file:///etc/passwd"),
        REFUSED,
        "file:///etc/passwd",
    )
    case(
        group,
        "web.gltf",
        "a buffer on the web",
        gltf(document, buffer, "http://127.0.0.1/b.bin"),
        REFUSED,
        "http://127.0.0.1/b.bin",
    )
    case(
        group,
        "base64.gltf",
        "a data URI that is cut off",
        gltf(document, buffer, "data:application/octet-stream;base64,AAAA"),
        REFUSED,
    )
    case(
        group,
        "nobase64.gltf",
        "a data URI that is none",
        gltf(document, buffer, "data:application/octet-stream;base64,%%%"),
        REFUSED,
    )

    draco = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    required = {"extensionsUsed": list(draco), "extensionsRequired": list(draco)}

    def compressed(document: dict) -> None:
        document.update(required)
        document["meshes"][0]["primitives"][0]["extensions"] = draco

    build("draco", "Draco compression", compressed, REFUSED, "KHR_draco_mesh_compression")
    build(
        "meshopt",
        "meshopt compression",
        update(extensionsRequired=["EXT_meshopt_compression"]),
        REFUSED,
        "EXT_meshopt_compression",
    )
    build(
        "optional",
        "an unknown extension that isn't required",
        update(extensionsUsed=["ABC_xyz"]),
        WORKS,
    )
    skin = {"skins": [{"joints": [0]}]}
    build(
        "skin",
        "a node with a skin, whose mesh has no joints",
        lambda d: (d.update(skin), d["nodes"][0].update(skin=0)),
        REPAIRED,
        "kept skins",
    )
    build(
        "animation",
        "an animation",
        update(
            animations=[
                {
                    "channels": [{"sampler": 0, "target": {"node": 0, "path": "scale"}}],
                    "samplers": [{"input": 1, "output": 0}],
                }
            ]
        ),
        REPAIRED,
        "kept animations",
    )
    build(
        "morph",
        "a morph target",
        primitive(targets=[{"POSITION": 0}]),
        REPAIRED,
        "kept morph targets",
    )
    build(
        "camera",
        "a camera and no mesh",
        lambda d: (d["nodes"][0].pop("mesh"), d.update(cameras=[])),
        REFUSED,
        "no faces",
    )
    build("points", "points", primitive(mode=0), REFUSED, "no faces")
    build("lines", "lines", primitive(mode=1), REFUSED, "no faces")
    build(
        "strip",
        "a triangle strip",
        primitive(mode=5),
        REPAIRED,
        "no face uses",
        faces=np.arange(36).reshape(-1, 3),
    )
    CASES["strip.glb"] = replace(CASES["strip.glb"], faces=34)
    build(
        "unindexed",
        "no indices",
        lambda d: d["meshes"][0]["primitives"][0].pop("indices"),
        WORKS,
        points=V[F].reshape(-1, 3),
        vertices=42,
    )
    build("noposition", "a mesh without positions", primitive(attributes={}), REFUSED)
    build("nomesh", "a node with a mesh that isn't there", node(mesh=5), REFUSED)
    build(
        "nonode",
        "a scene with a node that isn't there",
        update(scenes=[{"nodes": [0, 9]}]),
        REFUSED,
    )
    build("noscene", "no scene", lambda d: (d.pop("scene"), d.pop("scenes")), REFUSED, "no mesh")
    build("badscene", "a scene that isn't there", update(scene=4), REFUSED)
    build("empty", "a mesh without primitives", update(meshes=[{"primitives": []}]), REFUSED)
    build("cycle", "a node that is its own child", node(children=[0]), REFUSED)
    build(
        "loop",
        "two nodes that are each other's children",
        update(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]),
        REFUSED,
    )
    deep = [{"children": [k + 1]} for k in range(2000)] + [{"mesh": 0}]
    build("deep", "3000 nodes below each other", update(nodes=deep), WORKS)
    build("flat", "a node of scale 0", node(scale=[0, 0, 0]), REFUSED, "no extent")
    build("mirror", "a mirrored node", node(scale=[-1, 1, 1]), WORKS)
    build("nanmatrix", "a node's matrix with a word in it", node(matrix=["x"] * 16), REFUSED)
    build("short", "a node's matrix of three numbers", node(matrix=[1, 0, 0]), REFUSED)
    build(
        "twice",
        "two nodes that show one mesh",
        lambda d: (
            d.update(nodes=[{"mesh": 0}, {"mesh": 0, "translation": [4, 0, 0]}]),
            d.update(scenes=[{"nodes": [0, 1]}]),
        ),
        WORKS,
        faces=F,
    )
    CASES["twice.glb"] = replace(CASES["twice.glb"], faces=160, vertices=84)
    build(
        "names",
        "a node with markup for a name",
        node(name="</script><img src=x onerror=alert(1)>"),
        WORKS,
    )
    build("version1", "version 1", update(asset={"version": "1.0"}), WORKS)
    case(group, "list.gltf", "JSON that is a list", b"[1, 2]", REFUSED)
    case(group, "nest.gltf", "JSON nested 100000 deep", b"[" * 10**5, REFUSED)
    case(
        group,
        "header.glb",
        "a wrong length in its header, whole besides",
        good_glb()[:8] + struct.pack("<I", 10**9) + good_glb()[12:],
        WORKS,
        **BALL,
    )
    case(
        group,
        "chunk.glb",
        "a chunk of 4 GB",
        good_glb()[:12] + struct.pack("<I", 2**32 - 1) + good_glb()[16:],
        REFUSED,
    )

    def image(**values):
        def change(document: dict) -> None:
            document.update(
                images=[values],
                textures=[{"source": 0}],
                materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
            )
            document["meshes"][0]["primitives"][0]["material"] = 0

        return change

    def data(content: bytes) -> str:
        return "data:image/png;base64," + base64.b64encode(content).decode()

    build("image", "a texture inside", image(uri=data(picture("PNG")())), WORKS)
    build("goneimage", "a texture that isn't there", image(uri="gone.png"), REPAIRED, "gone.png")
    build(
        "cutimage",
        "a texture that is cut off",
        image(uri=data(picture("PNG")()[:300])),
        REPAIRED,
        "texture",
    )
    build(
        "bombimage",
        "a texture of 900 million pixels",
        image(uri=data(png_claiming(30000, 30000))),
        REPAIRED,
        "texture",
    )
    build("textimage", "a texture that is text", image(uri=data(TEXT)), REPAIRED, "texture")
    build(
        "upimage",
        "a texture by ../",
        image(uri="../secret/skin.png"),
        REPAIRED,
        "outside",
        kind="gltf",
        beside={"../secret/skin.png": picture("PNG")},
    )


def _gltf_numbers() -> None:
    group = "numbers of glTF"

    def build(name, what, columns=(), change=None, outcome=WORKS, says="", **more):
        """``columns``: attribute, numbers, component type, normalised."""
        document, buffer = gltf_parts()
        for attribute, values, kind, normalised in columns:
            buffer += bytes(-len(buffer) % 4)
            content = np.ascontiguousarray(values)
            document["bufferViews"].append(
                {"buffer": 0, "byteOffset": len(buffer), "byteLength": content.nbytes}
            )
            buffer += content.tobytes()
            accessor = {
                "bufferView": len(document["bufferViews"]) - 1,
                "componentType": kind,
                "count": len(content),
                "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[content.shape[1]],
            }
            document["accessors"].append(accessor | ({"normalized": True} if normalised else {}))
            primitive = document["meshes"][0]["primitives"][0]
            primitive["attributes"][attribute] = len(document["accessors"]) - 1
        document["buffers"][0]["byteLength"] = len(buffer)
        if change is not None:
            change(document)
        known = BALL if outcome != REFUSED else {}
        content = glb(document, buffer)
        case(group, f"{name}.glb", what, content, outcome, says, **{**known, **more})

    share = (V[:, :2] + 1) / 2
    build("uvfloat", "texture coordinates without a material",
          [("TEXCOORD_0", share.astype("<f4"), 5126, False)])  # fmt: skip
    padded = np.pad((share * 255).astype("u1"), ((0, 0), (0, 2)))
    build("uvbyte", "texture coordinates of 8 bits, in strides",
          [("TEXCOORD_0", padded, 5121, True)],
          lambda d: (d["accessors"][2].update(type="VEC2"),
                     d["bufferViews"][2].update(byteStride=4)))  # fmt: skip
    build("uvshort", "texture coordinates of 16 bits",
          [("TEXCOORD_0", (share * 65535).astype("<u2"), 5123, True)])  # fmt: skip
    color = ((V + 1) / 2 * 65535).astype("<u2")
    opaque = np.pad(color, ((0, 0), (0, 1)), constant_values=65535)
    build("color16", "colours of 16 bits", [("COLOR_0", opaque, 5123, True)])
    build("colorfloat", "colours of floats, without opacity",
          [("COLOR_0", (color / 65535).astype("<f4"), 5126, False)])  # fmt: skip
    build("second", "a second set of texture coordinates, tangents",
          [("TEXCOORD_0", share.astype("<f4"), 5126, False),
           ("TEXCOORD_1", share[::-1].astype("<f4"), 5126, False),
           ("NORMAL", V.astype("<f4"), 5126, False),
           ("TANGENT", np.pad(V[:, [1, 2, 0]], ((0, 0), (0, 1)), constant_values=1).astype("<f4"),
            5126, False)])  # fmt: skip
    short = np.pad(np.round(V * 32767).astype("<i2"), ((0, 0), (0, 1)))

    def quantised(document: dict) -> None:
        document["accessors"][2]["type"] = "VEC3"
        document["bufferViews"][2]["byteStride"] = 8
        document["extensionsRequired"] = document["extensionsUsed"] = ["KHR_mesh_quantization"]

    build("quantised", "positions of 16 bits (KHR_mesh_quantization)",
          [("POSITION", short, 5122, True)], quantised)  # fmt: skip

    def sparse(document: dict) -> None:
        # The second column's view holds the indices, the third's the values.
        document["accessors"][0]["sparse"] = {
            "count": 3,
            "indices": {"bufferView": 2, "componentType": 5121},
            "values": {"bufferView": 3},
        }
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        del attributes["_INDICES"], attributes["_VALUES"]

    parts = [("_INDICES", np.array([[1], [5], [7]], "u1"), 5121, False),
             ("_VALUES", (V[[1, 5, 7]] * 1.1).astype("<f4"), 5126, False)]  # fmt: skip
    build("sparse", "sparse positions", parts, sparse)
    build("sparsebeyond", "a sparse position beyond the last",
          [("_INDICES", np.array([[1], [5], [99]], "u1"), 5121, False), parts[1]], sparse,
          REFUSED, "element 99 of 42")  # fmt: skip
    build("fewcolors", "fewer colours than vertices",
          [("COLOR_0", color[:9], 5123, True)], None, REFUSED, "9 elements")  # fmt: skip
    build("stride", "a stride shorter than its elements", (),
          lambda d: d["bufferViews"][0].update(byteStride=4), REFUSED, "it contains")  # fmt: skip
    build("instances", "a hundred thousand nodes that show one mesh", (),
          lambda d: d.update(nodes=[{"mesh": 0}] * 100_000,
                             scenes=[{"nodes": list(range(100_000))}]),
          REFUSED, "too often")  # fmt: skip
    build("diamond", "nodes below two others, 2^60 ways to the mesh", (),
          lambda d: d.update(nodes=[*({"children": [k + 1, k + 1]} for k in range(60)),
                                    {"mesh": 0}]),
          REFUSED, "child of two nodes")  # fmt: skip
    instancing = {"EXT_mesh_gpu_instancing": {"attributes": {}}}
    build("instancing", "instances by an extension that isn't required", (),
          lambda d: d["nodes"][0].update(extensions=instancing),
          REFUSED, "EXT_mesh_gpu_instancing")  # fmt: skip


def _tables() -> None:
    group = "what PLY and OBJ files have besides"
    head, body = ply(kind="ascii").split(b"end_header\n")
    rows = body.splitlines()

    def wider(vertex=b"", face=b"", values=b"", face_values=b"", after=b"", element=b"") -> bytes:
        """The ball with more properties, all rows with the same numbers."""
        top = head.replace(b"element face", vertex + b"element face") + face + element
        lines = [row + values for row in rows[:42]] + [row + face_values for row in rows[42:]]
        return top + b"end_header\n" + b"\n".join(lines) + b"\n" + after

    def one(*names: str, kind="float") -> bytes:
        return "".join(f"property {kind} {name}\n" for name in names).encode()

    lists = b"property list uchar float weights\n"
    case(group, "confidence.ply", "vertices' confidence and label",
         wider(one("confidence") + one("label", kind="int"), values=b" 0.5 7"),
         REPAIRED, "vertex properties (confidence, label)", **BALL)  # fmt: skip
    case(group, "segment.ply", "faces' segment", wider(face=one("segment"), face_values=b" 3"),
         REPAIRED, "GLB can't store face properties (segment)", **BALL)  # fmt: skip
    case(group, "lists.ply", "a list for each vertex", wider(lists, values=b" 2 0.5 0.5"),
         REPAIRED, "weights", **BALL)  # fmt: skip
    case(group, "facecolors.ply", "faces' colours",
         wider(face=one("red", "green", "blue", kind="uchar"), face_values=b" 9 99 199"),
         REPAIRED, "face colours", **BALL)  # fmt: skip
    case(group, "normals.ply", "vertices' normals",
         wider(one("nx", "ny", "nz"), values=b" 0 0 1"), WORKS, **BALL)  # fmt: skip
    case(group, "uvcolors.ply", "texture coordinates and colours",
         wider(one("s", "t") + one("red", "green", "blue", kind="uchar"), values=b" .5 .1 9 9 9"),
         WORKS, **BALL)  # fmt: skip
    case(group, "edges.ply", "an element of edges",
         wider(element=b"element edge 1\n" + one("vertex1", "vertex2", kind="int"), after=b"0 1\n"),
         REPAIRED, "element 'edge'", **BALL)  # fmt: skip
    strips = ply(faces=[], kind="ascii").replace(b"face 0", b"tristrips 1") + b"4 0 1 2 3\n"
    case(group, "strips.ply", "triangle strips", strips, REFUSED, "triangle strips")
    case(group, "type.ply", "a number that its type can't hold",
         wider(one("label", kind="uchar"), values=b" 300"), REFUSED, "represent")  # fmt: skip
    lines = obj().split(b"\n")

    def colored(weight: bytes, every: int) -> bytes:
        color = [line + weight + b" 0.5 0.25 0.125" * (k % every == 0)
                 for k, line in enumerate(lines[:42])]  # fmt: skip
        return b"\n".join([*color, *lines[42:]])

    case(group, "colors.obj", "colours after three coordinates", colored(b"", 1), WORKS, **BALL)
    case(group, "colors4.obj", "colours after four", colored(b" 1.0", 1), WORKS, **BALL)
    case(group, "somecolors.obj", "colours on some vertices", colored(b"", 3), WORKS, **BALL)
    groups = obj().replace(b"\nf", b"\no hull\ng left\ns 1\nf", 1)
    case(group, "groups.obj", "an object, a group and smoothing", groups, WORKS, **BALL)


def _rounding() -> None:
    group = "vertices that rounding tears apart"
    rng = np.random.default_rng(9)
    far = (V[F].reshape(-1, 3) + 50).astype(np.float32)
    way = rng.choice(np.array([-np.inf, np.inf], np.float32), far.shape)
    soup = np.nextafter(far, way).astype(float), np.arange(len(far)).reshape(-1, 3)
    for kind, write in (("stl", stl), ("ply", ply), ("obj", obj)):
        case(group, f"noise.{kind}", "corners off by a unit in the last place of singles",
             write(*soup), REPAIRED, "merged", **BALL)  # fmt: skip
    digits = (V[F].reshape(-1, 3) + rng.uniform(-4e-7, 4e-7, (240, 3))).round(6)
    case(group, "digits.obj", "corners off in the last of six decimals",
         obj(digits, soup[1]), REPAIRED, "merged", **BALL)  # fmt: skip
    half = V[F].reshape(-1, 3).copy()
    half[:120] += [0, 0, 2e-5]
    case(group, "gap.obj", "two halves wider apart than rounding explains",
         obj(half, soup[1]), REPAIRED, "nearly coincide", faces=80)  # fmt: skip
    case(group, "plate.stl", "a closed box a hundred thousand times wider than thick",
         stl(CUBE * [1, 1, 1e-5], [t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))]),
         WORKS, **BOX)  # fmt: skip


def _renamed() -> None:
    group = "files that are something else"
    others = {"junk": JUNK, "text": TEXT, "page": HTML, "picture": picture("PNG")}
    for kind in ("obj", "ply", "stl", "off", "glb", "gltf"):
        for name, content in others.items():
            case(group, f"{name}.{kind}", f"{name} called .{kind}", content, REFUSED)
    case(group, "ply.obj", "a PLY called .obj", ply(), REFUSED)
    case(group, "obj.ply", "an OBJ called .ply", obj(), REFUSED)
    case(group, "obj.stl", "an OBJ called .stl", obj(), REFUSED)
    case(group, "glb.gltf", "a GLB called .gltf", good_glb(), REFUSED)
    case(group, "gltf.glb", "a glTF called .glb", gltf(*gltf_parts()), REFUSED)
    case(group, "zip.obj", "a ZIP called .obj", b"PK\x03\x04" + JUNK, REFUSED, "binary")
    case(
        group,
        "gzip.ply",
        "a gzipped PLY called .ply",
        lambda: __import__("gzip").compress(ply()),
        REFUSED,
    )


def _pictures() -> None:
    group = "pictures as the style"

    def add(name, what, content, outcome=WORKS, says="", **more):
        case(group, name, what, content, outcome, says, style=True, **more)

    for kind, suffix in (
        ("PNG", "png"),
        ("JPEG", "jpg"),
        ("WEBP", "webp"),
        ("TIFF", "tiff"),
        ("BMP", "bmp"),
        ("GIF", "gif"),
        ("PPM", "ppm"),
        ("JPEG2000", "jp2"),
        ("AVIF", "avif"),
    ):
        add(f"good.{suffix}", f"a {kind}", picture(kind))
        for percent in (0, 5, 60):

            def cut(kind=kind, percent=percent):
                whole = picture(kind)()
                return whole[: len(whole) * percent // 100]

            add(f"cut{percent}.{suffix}", f"the first {percent} % of a {kind}", cut, REFUSED)
    add("renamed.jpg", "a PNG called .jpg", picture("PNG"))
    add("cmyk.jpg", "CMYK", picture("JPEG", mode="CMYK"))
    add("cmyk.tiff", "CMYK", picture("TIFF", mode="CMYK"))
    add("lab.tiff", "CIELAB", picture("TIFF", mode="LAB"))
    add("palette.png", "a palette", picture("PNG", mode="P"))
    add("bits.png", "one bit a pixel", picture("PNG", mode="1"))
    add("grey.png", "grey", picture("PNG", mode="L"))
    add("alpha.png", "transparency", picture("PNG", mode="RGBA"))
    add("greyalpha.png", "grey with transparency", picture("PNG", mode="LA"))
    add("deep.png", "16 bits", picture("PNG", (pixels()[..., 0].astype(np.uint16) * 257)))
    add("deep.tiff", "16 bits", picture("TIFF", (pixels()[..., 0].astype(np.uint16) * 257)))
    add("float.tiff", "32-bit floats", picture("TIFF", pixels()[..., 0].astype(np.float32) / 255))
    color = pixels().astype(np.uint16) * 257 + 3
    opaque = np.full((*color.shape[:2], 1), 40000, np.uint16)

    def deep(array, kind="png", **options):
        def make() -> bytes:
            import imagecodecs
            import tifffile

            if kind == "png":
                return imagecodecs.png_encode(array)
            out = io.BytesIO()
            tifffile.imwrite(out, array, **options)
            return out.getvalue()

        return make

    add("rgb16.png", "16 bits of each colour", deep(color))
    add(
        "rgba16.png",
        "16 bits of each colour and of opacity",
        deep(np.concatenate([color, opaque], 2)),
    )
    add(
        "la16.png",
        "16 bits of grey and of opacity",
        deep(np.concatenate([color[..., :1], opaque], 2)),
    )
    add("rgb16.tiff", "16 bits of each colour", deep(color, "tiff", photometric="rgb"))
    add("lzw16.tiff", "16 bits of each colour, compressed",
        deep(color, "tiff", photometric="rgb", compression="lzw", predictor=True))  # fmt: skip
    add("half.tiff", "half-precision floats",
        deep((pixels() / 255).astype(np.float16), "tiff", photometric="rgb"))  # fmt: skip
    add("rgbfloat.tiff", "floats of each colour",
        deep((pixels() / 255).astype(np.float32), "tiff", photometric="rgb"))  # fmt: skip
    for percent in (30, 90):
        add(f"deepcut{percent}.png", f"the first {percent} % of 16-bit colours",
            lambda percent=percent: (whole := deep(color)())[: len(whole) * percent // 100],
            REFUSED, "damaged or truncated")  # fmt: skip
        add(f"deepcut{percent}.tiff", f"the first {percent} % of 16-bit colours",
            lambda percent=percent: (whole := deep(color, "tiff", photometric="rgb")())
            [: len(whole) * percent // 100],
            REFUSED, "damaged or truncated")  # fmt: skip
    bump = np.gradient(pixels()[..., 0] / 40.0)
    normal = np.stack([-bump[1], -bump[0], np.ones_like(bump[0])], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    add("normalmap.png", "a normal map", picture("PNG", ((normal + 1) * 127.5).astype(np.uint8)),
        REPAIRED, "normal map")  # fmt: skip
    add(
        "hdr.tiff",
        "floats above 1",
        picture("TIFF", pixels()[..., 0].astype(np.float32)),
        REFUSED,
        "outside [0, 1]",
    )
    add(
        "nan.tiff",
        "NaN",
        picture("TIFF", pixels()[..., 0].astype(np.float32) * np.float32("nan")),
        REFUSED,
        "outside [0, 1]",
    )
    add("one.png", "1x1", picture("PNG", pixels(1, 1)), REFUSED, "at least 16")
    add(
        "thin.png",
        "30000x1",
        picture("PNG", np.zeros((1, 30000), np.uint8)),
        REFUSED,
        "at least 16",
    )
    add("strip.png", "30000x16", picture("PNG", np.resize(pixels()[..., 0], (16, 30000))))
    add("least.png", "16x16", picture("PNG", pixels(16, 16)))
    black, clear = np.zeros((64, 64), np.uint8), np.zeros((64, 64, 4), np.uint8)
    add("black.png", "black all over", picture("PNG", black), REFUSED, "uniform tone")
    add("clear.png", "wholly transparent", picture("PNG", clear), REFUSED, "uniform tone")

    def animated(kind: str):
        def make() -> bytes:
            from PIL import Image

            frames = [Image.fromarray(pixels()), Image.fromarray(pixels()[::-1].copy())]
            out = io.BytesIO()
            frames[0].save(out, kind, save_all=True, append_images=frames[1:])
            return out.getvalue()

        return make

    add("moving.png", "an animated PNG", animated("PNG"), REPAIRED, "has 2 frames")
    add("moving.webp", "an animated WebP", animated("WEBP"), REPAIRED, "has 2 frames")
    add("moving.gif", "an animated GIF", animated("GIF"), REPAIRED, "has 2 frames")
    add("pages.tiff", "a TIFF of two pages", animated("TIFF"), REPAIRED, "has 2 frames")

    def rotated() -> bytes:
        from PIL import Image

        image = Image.fromarray(pixels())
        exif = image.getexif()
        exif[0x0112] = 6
        out = io.BytesIO()
        image.save(out, "JPEG", exif=exif)
        return out.getvalue()

    add("rotated.jpg", "turned by its EXIF entry", rotated)
    add(
        "bomb.png",
        "900 million pixels in a kilobyte",
        png_claiming(30000, 30000),
        REFUSED,
        "pixels",
    )
    add("vast.png", "4 * 10^18 pixels claimed", png_claiming(2**31 - 1, 2**31 - 1), REFUSED)
    add(
        "short.png",
        "more pixels claimed than there are",
        png_claiming(500, 500),
        REFUSED,
        "truncated",
    )
    add(
        "drawing.png",
        "an SVG called .png",
        b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        REFUSED,
        "SVG",
    )
    add(
        "drawing.svg",
        "an SVG",
        b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        REFUSED,
        "export it as PNG",
    )
    add("notes.png", "text called .png", TEXT, REFUSED, "text file")
    add("page.jpg", "a web page called .jpg", HTML, REFUSED, "web page")
    add("print.png", "an EPS called .png", b"%!PS-Adobe-3.0 EPSF-3.0\n", REFUSED, "text file")
    add("paper.pdf", "a PDF", b"%PDF-1.4\n" + JUNK, REFUSED, "a picture")
    add("noise.webp", "random bytes", JUNK, REFUSED, "not an image")
    add("ball.png", "a mesh called .png", obj(), REFUSED, "text file")
    case(group, "source.png", "a picture as the source", picture("PNG"), REFUSED, "give a mesh")


for _group in (
    _truncated,
    _counts,
    _coordinates,
    _topology,
    _text,
    _materials,
    _gltf,
    _gltf_numbers,
    _tables,
    _rounding,
    _renamed,
    _pictures,
):
    _group()
