"""Make the shipped low-poly mesh, `critter_low`: the critter with few faces, texture coordinates
and a painted material, as an artist would hand it over.

    pip install '.[bake]'
    python examples/low_poly.py critter_low.glb
"""

import sys
from dataclasses import replace

import numpy as np
from PIL import Image
from trimesh.visual.material import PBRMaterial

from styleexp.inputs import meshes, solids
from styleexp.runs import bake
from styleexp.runs.bake import texels

VERTICES, SIZE = 900, 512
COAT, BELLY, PAW = (150, 116, 84), (222, 204, 176), (88, 64, 48)
EAR, NOSE, EYE, GLINT = (206, 148, 132), (52, 38, 36), (36, 28, 26), (250, 250, 246)


def paint(points):
    """Colours (points, 3) at places on the critter."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]

    def ball(centre, radius, softness=0.02):
        away = np.linalg.norm(np.stack([x, y, z], axis=1) - centre, axis=1)
        return ((radius - away) / softness + 0.5).clip(0, 1)

    grain = (
        0.03 * np.sin(23 * points[:, 0] + 5 * np.sin(9 * y)) * np.sin(31 * z + 3 * np.sin(7 * y))
    )
    colour = np.array(COAT) * (1 + grain)[:, None]
    for share, other in (
        (((-0.15 - y) / 0.2).clip(0, 1) * ((0.16 - x) / 0.1).clip(0, 1), BELLY),
        (ball((0.0, 0.48, 0.80), 0.20, 0.08), BELLY),
        (((-0.58 - y) / 0.05).clip(0, 1), PAW),
        (ball((0.28, 0.98, 0.56), 0.13, 0.06) * (z > 0.45), EAR),
        (ball((0.0, 0.58, 0.93), 0.075), NOSE),
        (ball((0.14, 0.68, 0.80), 0.070), EYE),
        (ball((0.155, 0.715, 0.825), 0.020, 0.01), GLINT),
    ):
        colour += share[:, None] * (np.array(other) - colour)
    return colour


def main(path):
    """Write the mesh."""
    mesh = bake.unwrapped(meshes.from_arrays(*solids.critter(VERTICES)))
    corners = mesh.carrier.uv[mesh.carrier.corners]
    picture, known = np.zeros((SIZE * SIZE, 3)), np.zeros(SIZE * SIZE, bool)
    for each in texels.covered(corners, SIZE):
        points = np.einsum("nk,nkd->nd", each.weights, mesh.vertices[mesh.faces[each.face]])
        picture[each.at], known[each.at] = paint(points), True
    picture = picture.reshape(SIZE, SIZE, 3)
    texels.fill(known.reshape(SIZE, SIZE), picture)
    texture = Image.fromarray(picture.clip(0, 255).astype(np.uint8))
    texture = texture.quantize(96)  # a smaller file
    material = PBRMaterial(
        "coat", baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=0.8
    )
    carrier = replace(
        mesh.carrier,
        parts=("critter",),
        materials=(material,),
        face_material=np.zeros(len(mesh.faces), int),
    )
    mesh = replace(mesh, name="critter_low", carrier=carrier)
    meshes.save_mesh(mesh, mesh.vertices, path)
    print(f"{path}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces")


if __name__ == "__main__":
    main(sys.argv[1])
