"""Meshes whose vertices or faces are odd, whatever the format."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from tests.helpers.corpus.case import Case, group, refused, repaired, works
from tests.helpers.corpus.writers import (
    BALL,
    BOX,
    CUBE,
    QUADS,
    F,
    V,
    ascii_stl,
    glb,
    gltf_parts,
    joined,
    obj,
    off,
    ply,
    stl,
)

# --------------------------------------------------------------------------------- coordinates


def _with(row: int, value) -> np.ndarray:
    out = V.copy()
    out[row] = value
    return out


_NAN = _with(7, [V[7, 0], np.nan, V[7, 2]])
_INFINITE = _with(7, np.inf)


def _not_finite(kind: str, write: Callable[..., bytes]) -> Iterator[Case]:
    yield refused(f"nan.{kind}", "a coordinate that is NaN", write(_NAN), "NaN or infinite")
    says = "NaN or infinite"
    yield refused(f"infinite.{kind}", "infinite coordinates", write(_INFINITE), says)


def _scaled(name: str) -> Iterator[Case]:
    ball, told = V * float(name), f"a radius of {name}"
    yield works(f"scale{name}.obj", told, obj(ball), **BALL)
    yield works(f"scale{name}.ply", told, ply(ball), **BALL)
    yield works(f"style{name}.obj", f"a style with {told}", obj(ball), style=True)


def _nan_glb() -> bytes:
    document, buffer = gltf_parts()
    return glb(document, np.asarray(_NAN, "<f4").tobytes() + buffer[42 * 12 :])


_FLAT = obj(CUBE[[0, 2, 6, 4]], [[0, 1, 2], [0, 2, 3]])
_UNUSED = obj([*V, [np.nan] * 3], F)
_OUTLIER = obj([*V, [1e6, 0, 0]], F)
_2D = b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n"
_WEIGHTS = obj().replace(b"\nf", b" 1.0\nf", 1)

COORDINATES = group(
    "meshes with odd coordinates",
    *_not_finite("obj", obj),
    *_not_finite("off", off),
    *_not_finite("ply", ply),
    *_not_finite("stl", stl),
    *_not_finite("ascii.stl", ascii_stl),
    refused("nan.glb", "a coordinate that is NaN", _nan_glb(), "NaN or infinite"),
    *_scaled("1e30"),
    *_scaled("1e-30"),
    *_scaled("1e7"),
    *_scaled("1e-7"),
    works("subnormal.ply", "a radius of 1e-40", ply(V * 1e-40), **BALL),
    refused("scale1e200.obj", "a radius of 1e200", obj(V * 1e200), "scale the mesh"),
    refused("scale1e-200.obj", "a radius of 1e-200", obj(V * 1e-200), "scale the mesh"),
    repaired("far.obj", "four million radii from the origin", obj(V + 4e6), "far from the origin",
             **BALL),
    refused("point.obj", "all vertices in one place", obj(V * 0), "no extent"),
    refused("line.obj", "all vertices on a line", obj(V * [1, 0, 0]), "degenerate"),
    refused("needle.obj", "a million times longer than wide", obj(V * [1e6, 1, 1]),
            "the views don't see"),
    works("flat.obj", "without thickness", _FLAT, faces=2, vertices=4),
    repaired("unused.obj", "NaN in a vertex that no face uses", _UNUSED, "no face uses", **BALL),
    repaired("outlier.obj", "an unused vertex a million radii away", _OUTLIER, "no face uses",
             **BALL),
    refused("comma.obj", "decimal commas", obj().replace(b".", b","), "decimal points"),
    refused("flat2d.obj", "two coordinates a vertex", _2D, "fewer than three coordinates"),
    works("weights.obj", "a fourth coordinate", _WEIGHTS, **BALL),
)  # fmt: skip

# ------------------------------------------------------------------------------------ topology

Mesh = tuple[np.ndarray, np.ndarray]


def _wings() -> Mesh:
    """Twenty faces around one edge."""
    around = [[np.cos(a), np.sin(a), 0] for a in np.arange(20) * np.pi / 10]
    axis = [[0, 0, -1], [0, 0, 1]]
    return np.concatenate([axis, around]), np.array([(0, 1, k + 2) for k in range(20)])


def _crowd() -> Mesh:
    """2000 tetrahedra."""
    points, faces = CUBE[[0, 3, 5, 6]], np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    places = [3 * np.array([k % 15, k // 15 % 15, k // 225]) for k in range(2000)]
    return joined(*((points + place, faces) for place in places))


def _disc() -> tuple[np.ndarray, list[range]]:
    """One face of 500 corners."""
    angles = np.arange(500) * np.pi / 250
    return np.array([(np.cos(a), np.sin(a), 0) for a in angles]), [range(500)]


def _moebius(n: int = 24) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """A band of quads with half a turn in it."""
    angle = np.arange(n) * 2 * np.pi / n
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    side = 0.3 * (np.cos(angle / 2)[:, None] * ring + np.sin(angle / 2)[:, None] * [0, 0, 1])
    band = [(k, k + 1, n + k + 1, n + k) for k in range(n - 1)] + [(n - 1, n, 0, 2 * n - 1)]
    return np.concatenate([ring - side, ring + side]), band


_TURNED = np.concatenate([F[:20, ::-1], F[20:]])
_MIXED = [*QUADS[:5], (1, 5, 7), (1, 7, 3)]
_SOUP = V[F].reshape(-1, 3), np.arange(240).reshape(-1, 3)
_FAN = obj(CUBE[:5], [(0, 1, 2), (1, 0, 3), (0, 1, 4)])
_BOWTIE = obj(*joined((V, F), (V + 2 * V[0], F)))
_HOLLOW = obj(*joined((V, F), (V / 2, F[:, ::-1])))
_NESTED = obj(*joined((V, F), (V / 2, F)))
_TWO = obj(*joined((V, F), (V + 5, F)))
_CROSSING = obj(*joined((V, F), (V + 0.5, F)))
_DEGENERATE = [(0, 0, 1), (3, 3, 3)]
_PAIRS = [(0, 1), (5,)]
_ISOLATED = np.concatenate([V, V[:9] * 3])
_FACELESS = "curv 0 1 1 2 3\nend\n"
_DOUBLE = {"faces": 160, "vertices": 84}

TOPOLOGY = group(
    "meshes with odd topology",
    repaired("degenerate.obj", "faces without area", obj(V, [*F, *_DEGENERATE]), "degenerate",
             faces=82, vertices=42),
    refused("onlydegenerate.obj", "nothing but such faces", obj(V, _DEGENERATE),
            "only degenerate"),
    works("twice.obj", "every face twice", obj(V, [*F, *F]), faces=160, vertices=42),
    works("mirrored.obj", "every face twice, once turned", obj(V, [*F, *F[:, ::-1]]),
          faces=160, vertices=42),
    works("hundredfold.obj", "one face a hundred times", obj(V, [*F, *([F[0]] * 99)]),
          faces=179, vertices=42),
    repaired("turned.obj", "a quarter of the faces turned", obj(V, _TURNED), "flipped", **BALL),
    repaired("inward.obj", "inside out", obj(V, F[:, ::-1]), "inwards", **BALL),
    works("fan.obj", "three faces at one edge", _FAN, faces=3, vertices=5),
    works("wings.obj", "twenty faces at one edge", obj(*_wings()), faces=20, vertices=22),
    works("bowtie.obj", "two balls that share a vertex", _BOWTIE, faces=160, vertices=83),
    works("open.obj", "a hole", obj(V, F[8:]), faces=72),
    works("sheet.obj", "one triangle", obj(V[:3], [(0, 1, 2)]), faces=1, vertices=3),
    works("two.obj", "two balls", _TWO, **_DOUBLE),
    works("nested.obj", "a ball in a ball", _NESTED, faces=160),
    repaired("hollow.obj", "a hollow ball", _HOLLOW, "pointed inwards", faces=160),
    works("crowd.obj", "2000 components", lambda: obj(*_crowd()), faces=8000, vertices=8000),
    repaired("isolated.obj", "vertices without faces", obj(_ISOLATED, F), "no face uses", **BALL),
    repaired("isolated.ply", "vertices without faces", ply(_ISOLATED, F), "no face uses", **BALL),
    repaired("quads.obj", "quads", obj(CUBE, QUADS), "triangulated", **BOX),
    repaired("quads.ply", "quads", ply(CUBE, QUADS), "triangulated", **BOX),
    repaired("quads.off", "quads", off(CUBE, QUADS), "triangulated", **BOX),
    repaired("mixed.obj", "triangles and quads", obj(CUBE, _MIXED), "triangulated", **BOX),
    repaired("mixed.ply", "triangles and quads, binary", ply(CUBE, _MIXED), "triangulated 5 quads",
             **BOX),
    repaired("mixed.off", "triangles and quads", off(CUBE, _MIXED), "triangulated", **BOX),
    repaired("disc.obj", "one face of 500 corners", obj(*_disc()), "triangulated",
             faces=498, vertices=500),
    repaired("pairs.obj", "faces of two corners", obj(V, [*F.tolist(), *_PAIRS]),
             "fewer than three", **BALL),
    refused("onlypairs.obj", "nothing but such faces", obj(V, _PAIRS), "three corners"),
    refused("points.obj", "a point cloud", obj(V, []), "point cloud"),
    refused("points.ply", "a point cloud", ply(V, []), "point cloud"),
    repaired("lines.obj", "lines and points among the faces", obj(after="l 1 2 3\np 4\n"),
             "(l, p)", **BALL),
    refused("curve.obj", "a spline", obj(V, [], after=_FACELESS), "point cloud"),
    refused("comment.obj", "comments alone", b"# nothing here\n", "no mesh"),
    works("soup.obj", "every face with vertices of its own", obj(*_SOUP), **BALL),
    works("soup.stl", "every face with vertices of its own", stl(), **BALL),
    works("crossing.obj", "two balls that cut each other", _CROSSING, **_DOUBLE),
    repaired("moebius.obj", "a one-sided band", obj(*_moebius()), "triangulated",
             faces=48, vertices=48),
    works("onlystyle.obj", "one triangle as the style", obj(V[:3], [(0, 1, 2)]), style=True),
    repaired("openstyle.obj", "a style with a hole and turned faces", obj(V, _TURNED[8:]),
             "flipped", style=True),
)  # fmt: skip

# ------------------------------------------------------------------------------------ rounding


def _rounded() -> Iterator[Case]:
    rng = np.random.default_rng(9)
    corners, faces = _SOUP
    far = (corners + 50).astype(np.float32)
    way = rng.choice(np.array([-np.inf, np.inf], np.float32), far.shape)
    near = np.nextafter(far, way).astype(float)
    told = "corners off by a unit in the last place of singles"
    for kind, write in (("stl", stl), ("ply", ply), ("obj", obj)):
        yield repaired(f"noise.{kind}", told, write(near, faces), "merged", **BALL)
    digits = obj((corners + rng.uniform(-4e-7, 4e-7, (240, 3))).round(6), faces)
    told = "corners off in the last of six decimals"
    yield repaired("digits.obj", told, digits, "merged", **BALL)


def _halves() -> bytes:
    corners, faces = _SOUP[0].copy(), _SOUP[1]
    corners[:120] += [0, 0, 2e-5]
    return obj(corners, faces)


_PLATE = stl(CUBE * [1, 1, 1e-5], [t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])

ROUNDING = group(
    "vertices that rounding tears apart",
    *_rounded(),
    repaired("gap.obj", "two halves wider apart than rounding explains", _halves(),
             "nearly coincide", faces=80),
    works("plate.stl", "a closed box a hundred thousand times wider than thick", _PLATE, **BOX),
)  # fmt: skip
