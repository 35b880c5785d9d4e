"""What text, names, materials and PLY's and OBJ's further properties may hold."""

from __future__ import annotations

from tests.helpers.corpus.case import Case, group, refused, repaired, works
from tests.helpers.corpus.writers import (
    BALL,
    JUNK,
    TEXT,
    Content,
    F,
    V,
    ascii_stl,
    obj,
    off,
    picture,
    ply,
    png_claiming,
)

# ------------------------------------------------------------------------------ text and names


def _named(name: str) -> Case:
    shown = name if len(name) < 50 else f"{name[:10]}... ({len(name)} characters)"
    return works(name, f"the name {shown!r}", obj(), **BALL)


_LATIN = obj(before="o K\xe4se\n").decode().encode("latin-1")
_CONTINUED = obj().replace(b"f ", b"f \\\n")
_FOREIGN = obj(before="xyz 1 2\nvp 1 2\ns off\n")
_CRLF_PLY = ply(kind="ascii").replace(b"\n", b"\r\n")
_CRLF_STL = ascii_stl().replace(b"\n", b"\r\n")


def _long() -> bytes:
    return obj(before="# " + "x" * 10**6 + "\n")


TEXT_AND_NAMES = group(
    "names, text and line ends",
    works("crlf.obj", "line ends '\\r\\n'", obj(eol="\r\n"), **BALL),
    works("crlf.off", "line ends '\\r\\n'", off().replace(b"\n", b"\r\n"), **BALL),
    works("cr.obj", "line ends '\\r'", obj(eol="\r"), **BALL),
    works("cr.off", "line ends '\\r'", off().replace(b"\n", b"\r"), **BALL),
    works("crlf.ply", "line ends '\\r\\n', text", _CRLF_PLY, **BALL),
    works("crlf.stl", "line ends '\\r\\n', text", _CRLF_STL, **BALL),
    works("upper.stl", "text in upper case", ascii_stl().upper(), **BALL),
    works("bom.obj", "a byte order mark", b"\xef\xbb\xbf" + obj(), **BALL),
    refused("utf16.obj", "UTF-16", obj().decode().encode("utf-16"), "binary"),
    works("latin.obj", "Latin-1 in a part's name", _LATIN, **BALL),
    works("tabs.obj", "tabs", obj().replace(b" ", b"\t"), **BALL),
    works("spaces.obj", "spaces at both ends", obj().replace(b"\n", b"  \n  "), **BALL),
    works("continued.obj", "lines continued by a backslash", _CONTINUED, **BALL),
    works("long.obj", "a comment of a million characters", _long, **BALL),
    works("unknown.obj", "keywords of other programs", _FOREIGN, **BALL),
    works("normals.obj", "normals that are none", obj(before="vn a b c\n"), **BALL),
    works("colours.obj", "colours from 0 to 255", obj().replace(b"\nf", b" \nf", 1), **BALL),
    _named("K\xe4se und \u7403 \U0001f600.obj"),
    _named("with  spaces .obj"),
    _named("equals=a,b{c}[d].obj"),
    _named("$HOME ${x} %20 #1 ?.obj"),
    _named("quote'\".obj"),
    _named("<img src=x onerror=alert(1)>.obj"),
    _named("-dash.obj"),
    _named("new\nline.obj"),
    _named("a" * 200 + ".obj"),
    _named("UPPER.OBJ"),
    _named("two.dots.obj"),
    refused(".obj", "a name that is an extension alone", obj(), "no extension"),
    refused("model.fbx", "a format that isn't read", JUNK, "export it as GLB"),
    refused("model", "no extension", obj(), "no extension"),
    refused("folder.obj/inside.txt", "a folder called like a mesh", TEXT),
)

# -------------------------------------------------------------------------- materials (OBJ, MTL)


def _with_mtl(library: str) -> bytes:
    """The ball with texture coordinates and a material of this library."""
    uv = "".join(f"vt {k / 42} {k % 7 / 7}\n" for k in range(42))
    faces = ["f " + " ".join(f"{i + 1}/{i + 1}" for i in f) for f in F.tolist()]
    head = obj(V, []).decode() + f"mtllib {library}\n" + uv + "usemtl skin\n"
    return (head + "\n".join(faces) + "\n").encode()


def _wearing(texture: str, content: Content | None = None, **more) -> dict:
    """What a case has besides its content: the library with this texture, which is there or not."""
    beside: dict[str, Content] = {
        "skin.mtl": f"newmtl skin\nKd 1 0.5 0.2\nmap_Kd {texture}\n".encode()
    }
    if content is not None:
        beside[texture] = content
    return {"beside": beside | more.pop("beside", {}), **more, **BALL}


_GOOD = picture("PNG")
_SKIN, _E, _S = _with_mtl("skin.mtl"), _with_mtl("e.mtl"), _with_mtl("s.mtl")
_LOST = "texture 'skin.png'"
_EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n"
_BOMB = png_claiming(30000, 30000)
_SECRET: dict[str, Content] = {
    "../secret/skin.png": _GOOD,
    "../secret/s.mtl": b"newmtl skin\nKd 1 0 0\n",
}
"""What lies outside of the mesh's folder and must not come in."""
_ODD_MTL = b"newmtl skin\nKd a b c\nd x\nNs\nnewmtl\nmap_Kd\n"
_NAN_MTL = b"newmtl skin\nKd nan 2 -1\nd nan\n"
_INNER_MTL = {"lib/s.mtl": b"newmtl skin\nKd 1 0 0\n"}

MATERIALS = group(
    "materials and textures of OBJ files",
    works("good.obj", "a material with its texture", _SKIN, **_wearing("skin.png", _GOOD)),
    works("spaces.mtl.obj", "a texture with spaces in its name", _SKIN,
          **_wearing("my skin 1.png", _GOOD)),
    works("below.obj", "a texture in a folder below", _SKIN, **_wearing("maps/skin.png", _GOOD)),
    works("windows.obj", "a texture by a Windows path", _SKIN,
          **_wearing("C:\\art\\skin.png", beside={"skin.png": _GOOD})),
    repaired("gone.obj", "a texture that isn't there", _SKIN, "texture 'gone.png'",
             **_wearing("gone.png")),
    repaired("cut.texture.obj", "a texture that is cut off", _SKIN, _LOST,
             **_wearing("skin.png", lambda: _GOOD()[:300])),
    repaired("text.texture.obj", "a texture that is text", _SKIN, _LOST,
             **_wearing("skin.png", TEXT)),
    repaired("svg.obj", "a texture that is a drawing", _SKIN, "texture 'skin.svg'",
             **_wearing("skin.svg", b"<svg/>")),
    repaired("eps.obj", "a texture that would start another program", _SKIN, "texture 'skin.eps'",
             **_wearing("skin.eps", _EPS)),
    repaired("bomb.obj", "a texture of 900 million pixels", _SKIN, _LOST,
             **_wearing("skin.png", _BOMB)),
    repaired("nomtl.obj", "a library that isn't there", _with_mtl("gone.mtl"), "gone.mtl", **BALL),
    works("emptymtl.obj", "an empty library", _E, beside={"e.mtl": b""}, **BALL),
    repaired("binarymtl.obj", "a library that is binary", _E, "e.mtl", beside={"e.mtl": JUNK},
             **BALL),
    works("oddmtl.obj", "a library with numbers that are none", _E, beside={"e.mtl": _ODD_MTL},
          **BALL),
    works("nanmtl.obj", "a library with NaN", _E, beside={"e.mtl": _NAN_MTL}, **BALL),
    works("nouse.obj", "a material that no library has", obj(before="usemtl gone\n"), **BALL),
    repaired("up.obj", "a texture by ../", _SKIN, "outside",
             **_wearing("../secret/skin.png", beside=_SECRET)),
    repaired("link.obj", "a texture that is a link to elsewhere", _SKIN, "outside",
             **_wearing("skin.png", beside=_SECRET, links={"skin.png": "../secret/skin.png"})),
    repaired("linked.obj", "a texture below a linked folder", _SKIN, "outside",
             **_wearing("maps/skin.png", beside=_SECRET, links={"maps": "../secret"})),
    repaired("absolute.obj", "a texture by an absolute path", _SKIN, "outside",
             **_wearing("/etc/passwd")),
    repaired("device.obj", "a texture that is a device", _SKIN, "texture '/dev/zero'",
             **_wearing("/dev/zero")),
    repaired("upmtl.obj", "a library by ../", _with_mtl("../secret/s.mtl"), "outside",
             beside=_SECRET, **BALL),
    repaired("linkmtl.obj", "a library that is a link to elsewhere", _S, "outside",
             beside=_SECRET, links={"s.mtl": "../secret/s.mtl"}, **BALL),
    works("inner.obj", "a library that is a link within the folder", _S,
          beside=_INNER_MTL, links={"s.mtl": "lib/s.mtl"}, **BALL),
)  # fmt: skip

# -------------------------------------------------------------------------- further properties


def _wider(vertex=b"", face=b"", values=b"", face_values=b"", after=b"", element=b"") -> bytes:
    """The ball with more properties, all rows with the same numbers."""
    head, body = ply(kind="ascii").split(b"end_header\n")
    rows = body.splitlines()
    top = head.replace(b"element face", vertex + b"element face") + face + element
    lines = [row + values for row in rows[:42]] + [row + face_values for row in rows[42:]]
    return top + b"end_header\n" + b"\n".join(lines) + b"\n" + after


def _of(*names: str, kind: str = "float") -> bytes:
    return "".join(f"property {kind} {name}\n" for name in names).encode()


def _colored(weight: bytes, every: int) -> bytes:
    """An OBJ with colours after every so many vertices."""
    lines = obj().split(b"\n")
    color = b" 0.5 0.25 0.125"
    some = [line + weight + color * (k % every == 0) for k, line in enumerate(lines[:42])]
    return b"\n".join([*some, *lines[42:]])


_CONFIDENCE = _wider(_of("confidence") + _of("label", kind="int"), values=b" 0.5 7")
_LISTS = _wider(b"property list uchar float weights\n", values=b" 2 0.5 0.5")
_FACE_COLORS = _wider(face=_of("red", "green", "blue", kind="uchar"), face_values=b" 9 99 199")
_UV_COLORS = _wider(
    _of("s", "t") + _of("red", "green", "blue", kind="uchar"), values=b" .5 .1 9 9 9"
)
_EDGE = b"element edge 1\n" + _of("vertex1", "vertex2", kind="int")
_STRIPS = ply(faces=[], kind="ascii").replace(b"face 0", b"tristrips 1") + b"4 0 1 2 3\n"
_GROUPS = obj().replace(b"\nf", b"\no hull\ng left\ns 1\nf", 1)

PROPERTIES = group(
    "what PLY and OBJ files have besides",
    repaired("confidence.ply", "vertices' confidence and label", _CONFIDENCE,
             "vertex properties (confidence, label)", **BALL),
    repaired("segment.ply", "faces' segment", _wider(face=_of("segment"), face_values=b" 3"),
             "GLB can't store face properties (segment)", **BALL),
    repaired("lists.ply", "a list for each vertex", _LISTS, "weights", **BALL),
    repaired("facecolors.ply", "faces' colours", _FACE_COLORS, "face colours", **BALL),
    works("normals.ply", "vertices' normals", _wider(_of("nx", "ny", "nz"), values=b" 0 0 1"),
          **BALL),
    works("uvcolors.ply", "texture coordinates and colours", _UV_COLORS, **BALL),
    repaired("edges.ply", "an element of edges", _wider(element=_EDGE, after=b"0 1\n"),
             "element 'edge'", **BALL),
    refused("strips.ply", "triangle strips", _STRIPS, "triangle strips"),
    refused("type.ply", "a number that its type can't hold",
            _wider(_of("label", kind="uchar"), values=b" 300"), "represent"),
    works("colors.obj", "colours after three coordinates", _colored(b"", 1), **BALL),
    works("colors4.obj", "colours after four", _colored(b" 1.0", 1), **BALL),
    works("somecolors.obj", "colours on some vertices", _colored(b"", 3), **BALL),
    works("groups.obj", "an object, a group and smoothing", _GROUPS, **BALL),
)  # fmt: skip
