"""Files that are cut off, that promise what isn't there, or that are something else."""

from __future__ import annotations

import gzip
from collections.abc import Iterator

from tests.helpers.corpus.case import Case, group, refused, repaired, works
from tests.helpers.corpus.writers import (
    HTML,
    JUNK,
    TEXT,
    F,
    changed,
    glb,
    gltf,
    gltf_parts,
    good_glb,
    obj,
    off,
    picture,
    ply,
    stl,
    whole_files,
)


def _cut(kind: str, whole: bytes) -> Iterator[Case]:
    """Less and less is missing."""
    for percent in (0, 3, 10, 30, 60, 90, 99):
        cut = whole[: len(whole) * percent // 100]
        row = (f"cut{percent}.{kind}", f"the first {percent} %", cut)
        # Nothing in an OBJ file says how many faces there are.
        untold = kind == "obj" and percent >= 90
        yield repaired(*row, "truncated") if untold else refused(*row)
    row = (f"last.{kind}", "all but its last byte", whole[:-1])
    if kind in ("off", "ascii.ply", "ascii.stl"):  # whose last byte is the end of a line
        yield works(*row)
    else:
        yield repaired(*row, "truncated") if kind == "obj" else refused(*row)


_document, _buffer = gltf_parts()
_half = {"ball.bin": _buffer[: len(_buffer) // 2]}

TRUNCATED = group(
    "meshes cut off",
    *(case for kind, whole in whole_files().items() for case in _cut(kind, whole)),
    refused("buffer.gltf", "with half of its buffer", gltf(_document, _buffer, "ball.bin"),
            beside=_half),
)  # fmt: skip


def _face(line: str) -> bytes:
    return obj() + f"f {line}\n".encode()


def _promised(name: str, number: int) -> Iterator[Case]:
    """The ball, with this number of vertices in its header, then with another number of faces."""
    told, faces = f"{number} vertices promised, 42 there", number + 40
    for kind, short in (("binary_little_endian", "binary"), ("ascii", "ascii")):
        yield refused(f"vertices-{name}-{short}.ply", told, ply(kind=kind, count=number))
        if name != "fewer":
            row = (f"faces-{name}-{short}.ply", f"{faces} faces promised, 80 there",
                   ply(kind=kind, face_count=faces))  # fmt: skip
            some = name == "minus"
            yield repaired(*row, "after its last element") if some else refused(*row)
    head, _, body = off().split(b"\n", 2)
    yield refused(f"vertices-{name}.off", told, b"\n".join([head, b"%d 80 0" % number, body]))
    if name != "fewer":
        row = (f"faces-{name}.off", f"{faces} faces promised, 80 there",
               b"\n".join([head, b"42 %d 0" % faces, body]))  # fmt: skip
        yield repaired(*row) if name == "minus" else refused(*row)


def _accessor(number: int, **values) -> bytes:
    return glb(*changed(lambda document: document["accessors"][number].update(values)))


def _view(number: int, **values) -> bytes:
    return glb(*changed(lambda document: document["bufferViews"][number].update(values)))


def _without_view(count: int) -> bytes:
    def change(document: dict) -> None:
        document["accessors"][0].pop("bufferView")
        document["accessors"][0]["count"] = count

    return glb(*changed(change))


_largest = ply(faces=[*F, (0, 1, 2**31 - 1)])

COUNTS = group(
    "meshes with wrong counts and indices",
    refused("zero.obj", "index 0", _face("0 1 2"), "OBJ counts from 1"),
    refused("beyond.obj", "an index beyond the vertices", _face("1 2 43"), "vertex 42"),
    refused("before.obj", "a relative index before the first", _face("1 2 -43"), "vertex -1"),
    works("relative.obj", "relative indices", _face("-1 -2 -3"), faces=81, vertices=42),
    refused("large.obj", "an index of 10^18", _face(f"1 2 {10**18}"), "vertex 9999"),
    refused("larger.obj", "an index of 10^30", _face(f"1 2 {10**30}"), "in line 123"),
    refused("float.obj", "an index of 1.5", _face("1 2 1.5"), "in line 123"),
    refused("word.obj", "a word for an index", _face("1 2 x"), "in line 123"),
    repaired("manyslashes.obj", "an index of 1/2/3/4", _face("1/1/1/1 2 3"), "texture", faces=81),
    repaired("uvbeyond.obj", "texture coordinates that don't exist", _face("1/9 2/9 3/9"),
             "texture coordinates", faces=81),
    *_promised("more", 50),
    *_promised("fewer", 30),
    *_promised("minus", -1),
    *_promised("vast", 10**15),
    refused("negative.ply", "a negative index", ply(faces=[*F, (0, 1, -1)]), "vertex -1"),
    refused("index.ply", "an index beyond the vertices", _largest, "vertex 2147483647"),
    refused("index.off", "an index beyond the vertices", off(faces=[*F, (0, 1, 99)])),
    refused("negative.off", "a negative index", off(faces=[*F, (0, 1, -2)])),
    refused("more.stl", "4294967295 faces promised, 80 there", stl(count=2**32 - 1),
            "ends too early"),
    refused("fewer.stl", "60 faces promised, 80 there", stl(count=60)),
    refused("none.stl", "no face", stl(faces=F[:0]), "no faces"),
    refused("count.glb", "more positions than its buffer holds", _accessor(0, count=10**9)),
    refused("minus.glb", "a negative count", _accessor(0, count=-3)),
    refused("nothing.glb", "10^13 positions of nothing", _without_view(10**13), "10000000000000"),
    refused("type.glb", "an unknown type of numbers", _accessor(0, componentType=1)),
    refused("vector.glb", "positions of two coordinates", _accessor(0, type="VEC2")),
    refused("shorter.glb", "fewer positions than its indices need", _accessor(0, count=20),
            "vertex"),
    refused("view.glb", "a view beyond its buffer", _view(1, byteOffset=10**7)),
    refused("length.glb", "a view of negative length", _view(1, byteLength=-9)),
    refused("buffer.glb", "a view of a buffer that isn't there", _view(0, buffer=7)),
)  # fmt: skip

_OTHERS = {"junk": JUNK, "text": TEXT, "page": HTML, "picture": picture("PNG")}

RENAMED = group(
    "files that are something else",
    *(
        refused(f"{name}.{kind}", f"{name} called .{kind}", content)
        for kind in ("obj", "ply", "stl", "off", "glb", "gltf")
        for name, content in _OTHERS.items()
    ),
    refused("ply.obj", "a PLY called .obj", ply()),
    refused("obj.ply", "an OBJ called .ply", obj()),
    refused("obj.stl", "an OBJ called .stl", obj()),
    refused("glb.gltf", "a GLB called .gltf", good_glb()),
    refused("gltf.glb", "a glTF called .glb", gltf(*gltf_parts())),
    refused("zip.obj", "a ZIP called .obj", b"PK\x03\x04" + JUNK, "binary"),
    refused("gzip.ply", "a gzipped PLY called .ply", lambda: gzip.compress(ply())),
)
