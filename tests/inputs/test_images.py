"""load_image on every kind of file that people have, and on files that are not pictures."""

import numpy as np
import pytest
import torch
from PIL import Image

from styleexp.inputs.images import is_normal_map, load_image, luminance
from styleexp.system.errors import UserError

rng = np.random.default_rng(0)
COLOUR = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
GREY = rng.integers(0, 256, (20, 30), dtype=np.uint8)


def smooth_colour():
    """A gradient that lossy formats keep nearly as it is."""
    y, x = np.mgrid[0:64, 0:96]
    return np.stack([x * 2, y * 3, 255 - x], axis=-1).astype(np.uint8)


@pytest.mark.parametrize("suffix", ["png", "tiff", "webp", "bmp"])
def test_lossless_colour_is_exact(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(COLOUR).save(path, **({"lossless": True} if suffix == "webp" else {}))
    pixels = load_image(path)
    assert pixels.dtype == np.float32
    assert pixels.flags.c_contiguous
    np.testing.assert_allclose(pixels, COLOUR / 255.0, atol=1e-6)


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_lossy_colour_is_close(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(smooth_colour()).save(path, quality=95)
    assert np.abs(load_image(str(path)) - smooth_colour() / 255.0).mean() < 0.02


def test_name_does_not_matter(tmp_path):
    path = tmp_path / "really-a-png.jpg"
    Image.fromarray(COLOUR).save(path, format="PNG")
    np.testing.assert_allclose(load_image(path), COLOUR / 255.0, atol=1e-6)


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_sixteen_bit_grey_keeps_its_depth(tmp_path, suffix):
    values = np.linspace(0, 65535, 600).astype(np.uint16).reshape(20, 30)
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(values).save(path)
    pixels = load_image(path)
    assert pixels.shape == (20, 30, 3)
    np.testing.assert_allclose(pixels[..., 1], values / 65535.0, atol=1e-6)


def test_big_endian_sixteen_bit(tmp_path):
    values = np.linspace(0, 65535, 600).astype(">u2").reshape(20, 30)
    Image.frombytes("I;16B", (30, 20), values.tobytes()).save(tmp_path / "a.tiff")
    np.testing.assert_allclose(load_image(tmp_path / "a.tiff")[..., 0], values / 65535.0, atol=1e-6)


def test_float_tiff(tmp_path):
    values = rng.random((20, 30), dtype=np.float32)
    Image.fromarray(values).save(tmp_path / "a.tiff")
    np.testing.assert_array_equal(load_image(tmp_path / "a.tiff")[..., 2], values)
    Image.fromarray(values * 300).save(tmp_path / "hdr.tiff")
    with pytest.raises(UserError, match=r"outside \[0, 1\]"):
        load_image(tmp_path / "hdr.tiff")


def test_grey_one_bit_and_palette(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "grey.png")
    np.testing.assert_allclose(load_image(tmp_path / "grey.png")[..., 0], GREY / 255.0, atol=1e-6)
    Image.fromarray(GREY > 127).save(tmp_path / "bit.png")
    np.testing.assert_array_equal(load_image(tmp_path / "bit.png")[..., 0], GREY > 127)
    palette = Image.fromarray(COLOUR).quantize(16)
    palette.save(tmp_path / "palette.png")
    expected = np.asarray(palette.convert("RGB")) / 255.0
    np.testing.assert_allclose(load_image(tmp_path / "palette.png"), expected, atol=1e-6)


def test_cmyk_jpeg(tmp_path):
    Image.new("CMYK", (32, 32), (0, 255, 255, 0)).save(tmp_path / "a.jpg", quality=95)
    red = load_image(tmp_path / "a.jpg").mean((0, 1))
    np.testing.assert_allclose(red, [1, 0, 0], atol=0.03)


def test_alpha_is_composited_on_white_or_the_grey_asked_for(tmp_path):
    rgba = np.zeros((20, 30, 4), np.uint8)
    rgba[:, 10:20, 3] = 51  # black at a fifth of opacity
    rgba[:, 20:, 3] = 255
    Image.fromarray(rgba).save(tmp_path / "a.png")
    white = load_image(tmp_path / "a.png")
    np.testing.assert_allclose(white[0, [0, 10, 20], 0], [1, 0.8, 0], atol=1e-6)
    grey = load_image(tmp_path / "a.png", background=0.5)
    np.testing.assert_allclose(grey[0, [0, 10, 20], 0], [0.5, 0.4, 0], atol=1e-6)


def test_palette_transparency_and_grey_alpha(tmp_path):
    palette = Image.new("P", (20, 20), 0)
    palette.putpalette([0, 0, 0, 255, 0, 0])
    palette.paste(1, (0, 0, 10, 20))
    palette.save(tmp_path / "p.png", transparency=0)
    pixels = load_image(tmp_path / "p.png")
    np.testing.assert_allclose(pixels[0, [0, 15]], [[1, 0, 0], [1, 1, 1]], atol=1e-6)
    Image.new("LA", (20, 20), (0, 0)).save(tmp_path / "la.png")
    assert (load_image(tmp_path / "la.png") == 1).all()


def test_two_pictures_in_one_jpeg(tmp_path):
    """Phones write MPO files under the name .jpg; the first picture counts."""
    first, second = (Image.new("RGB", (32, 32), colour) for colour in ("red", "blue"))
    first.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[second])
    np.testing.assert_allclose(load_image(tmp_path / "a.jpg")[9, 9], [1, 0, 0], atol=0.02)


def test_exif_rotation_is_applied(tmp_path):
    image = Image.fromarray(COLOUR)
    exif = image.getexif()
    exif[0x0112] = 6  # the camera was turned: rotate by 90 degrees clockwise to show it upright
    image.save(tmp_path / "a.png", exif=exif)
    expected = np.rot90(COLOUR, k=-1) / 255.0
    np.testing.assert_allclose(load_image(tmp_path / "a.png"), expected, atol=1e-6)


def test_first_frame_of_an_animation(tmp_path):
    frames = [Image.new("RGB", (20, 20), colour) for colour in ("red", "blue")]
    for suffix in ("gif", "webp", "png"):
        path = tmp_path / f"a.{suffix}"
        frames[0].save(path, save_all=True, append_images=frames[1:])
        with pytest.warns(UserWarning, match="has 2 frames"):
            np.testing.assert_allclose(load_image(path)[10, 10], [1, 0, 0], atol=0.02)


def test_not_there_folder_empty(tmp_path):
    with pytest.raises(UserError, match=r"no\.png' does not exist"):
        load_image(tmp_path / "no.png")
    with pytest.raises(UserError, match="is a folder"):
        load_image(tmp_path)
    (tmp_path / "empty.png").touch()
    with pytest.raises(UserError, match="empty"):
        load_image(tmp_path / "empty.png")


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tiff", "gif"])
@pytest.mark.parametrize("kept", [0.02, 0.3, 0.7])
def test_truncated_files_are_refused(tmp_path, suffix, kept):
    whole, cut = tmp_path / f"whole.{suffix}", tmp_path / f"cut.{suffix}"
    Image.fromarray(rng.integers(0, 256, (128, 128, 3), dtype=np.uint8)).save(whole)
    data = whole.read_bytes()
    cut.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(UserError, match=r"cut\.") as caught:
        load_image(cut)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
def test_random_damage_never_escapes_as_another_error(tmp_path):
    for suffix in ("png", "jpg", "webp", "tiff", "gif"):
        whole = tmp_path / f"whole.{suffix}"
        Image.fromarray(smooth_colour()).save(whole)
        data = np.frombuffer(whole.read_bytes(), np.uint8)
        for _ in range(15):
            damaged = data.copy()
            where = rng.integers(0, min(len(damaged), 200), 8)
            damaged[where] = rng.integers(0, 256, 8)
            path = tmp_path / f"damaged.{suffix}"
            path.write_bytes(damaged.tobytes())
            try:
                pixels = load_image(path)
            except UserError:
                continue
            assert pixels.ndim == 3
            assert np.isfinite(pixels).all()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\x00\x01\x02junk" * 100, "not an image that can be read"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 99 99\n", "text file"),
        (b"just some notes\n" * 10, "text file"),
        (b'<svg xmlns="http://www.w3.org/2000/svg"/>', "SVG"),
        (b'<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"/>', "SVG"),
        (b"<!DOCTYPE html><html>404</html>", "web page"),
    ],
)
def test_things_that_are_no_pictures(tmp_path, content, says):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(UserError, match=says):
        load_image(path)


def test_too_small(tmp_path):
    Image.new("RGB", (200, 15)).save(tmp_path / "a.png")
    with pytest.raises(UserError, match="200x15 pixels; it needs at least 16"):
        load_image(tmp_path / "a.png")
    Image.new("RGB", (16, 16)).save(tmp_path / "b.png")
    assert load_image(tmp_path / "b.png").shape == (16, 16, 3)


@pytest.mark.parametrize("limit", [500, 1000])
def test_decompression_bomb(tmp_path, monkeypatch, limit):
    """Pillow warns above its limit and raises above twice that; both are refused."""
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
    with pytest.raises(UserError, match=f"more than {limit} pixels"):
        load_image(tmp_path / "a.png")


def test_luminance_of_arrays_and_tensors():
    rgb = COLOUR / np.float32(255)
    grey = luminance(rgb)
    assert grey.shape == (20, 30)
    expected = np.asarray(Image.fromarray(COLOUR).convert("L")) / 255.0
    np.testing.assert_allclose(grey, expected, atol=1 / 255)
    np.testing.assert_allclose(luminance(torch.from_numpy(rgb)).numpy(), grey, rtol=1e-6)
    assert luminance(np.full(3, 0.25)) == pytest.approx(0.25)


# ------------------------------------------------------------------------------------ deep colours

DEEP = np.random.default_rng(1).integers(0, 65536, (20, 30, 4), dtype=np.uint16)


def over(values, background):
    """What any colours with opacity are over a grey, all in [0, 1]."""
    values = values / 65535.0
    return values[..., :-1] * values[..., -1:] + background * (1 - values[..., -1:])


def write_png(path, values):
    """A PNG of 16 bits by zlib alone, its rows filtered in all five ways."""
    import struct
    import zlib

    height, width, samples = values.shape
    rows, size = values.astype(">u2").tobytes(), width * samples * 2
    step, before, body = samples * 2, bytes(size), b""
    for y in range(height):
        row = rows[y * size : (y + 1) * size]
        left, corner = bytes(step) + row[:-step], bytes(step) + before[:-step]
        kind = y % 5

        def paeth(a, b, c):
            return min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]

        guess = [bytes(size), left, before,
                 bytes((a + b) // 2 for a, b in zip(left, before, strict=True)),
                 bytes(map(paeth, left, before, corner))][kind]  # fmt: skip
        body += bytes([kind]) + bytes((x - g) % 256 for x, g in zip(row, guess, strict=True))
        before = row

    def chunk(name, data):
        check = struct.pack(">I", zlib.crc32(name + data))
        return struct.pack(">I", len(data)) + name + data + check

    color = {1: 0, 2: 4, 3: 2, 4: 6}[samples]
    head = struct.pack(">IIBBBBB", width, height, 16, color, 0, 0, 0)
    parts = (b"IHDR", head), (b"IDAT", zlib.compress(body)), (b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))


@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_sixteen_bits_of_a_png_are_kept(tmp_path, samples):
    path = tmp_path / "a.png"
    values = DEEP[..., :samples]
    write_png(path, values)
    for background in (1.0, 0.25):
        wanted = values / 65535.0 if samples in (1, 3) else over(values, background)
        pixels = load_image(path, background=background)
        assert (pixels.shape, pixels.dtype) == ((20, 30, 3), np.float32)
        np.testing.assert_allclose(pixels, np.broadcast_to(wanted, (20, 30, 3)), atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"compression": "zlib", "predictor": True},
                                     {"compression": "lzw"}, {"planarconfig": "separate"},
                                     {"byteorder": ">"}, {"tile": (16, 16)}])  # fmt: skip
@pytest.mark.parametrize("samples", [3, 4])
def test_sixteen_bits_of_a_tiff_are_kept(tmp_path, samples, options):
    import tifffile

    values, extra = DEEP[..., :samples], {"extrasamples": ["unassalpha"]} if samples == 4 else {}
    stored = np.moveaxis(values, -1, 0) if "planarconfig" in options else values
    tifffile.imwrite(tmp_path / "a.tiff", stored, photometric="rgb", **extra, **options)
    wanted = values / 65535.0 if samples == 3 else over(values, 0.25)
    np.testing.assert_allclose(load_image(tmp_path / "a.tiff", background=0.25), wanted, atol=1e-6)


@pytest.mark.parametrize("kind", ["f2", "f4", "f8"])
@pytest.mark.parametrize("colors", [1, 3])
def test_floats_of_any_precision(tmp_path, kind, colors):
    import tifffile

    values = np.random.default_rng(2).random((20, 30, colors)).astype(kind)
    meaning = "rgb" if colors == 3 else "minisblack"
    stored = values if colors == 3 else values[..., 0]
    tifffile.imwrite(tmp_path / "a.tiff", stored, photometric=meaning)
    wanted = np.broadcast_to(values.astype(float), (20, 30, 3))
    np.testing.assert_allclose(load_image(tmp_path / "a.tiff"), wanted, atol=1e-6)
    tifffile.imwrite(tmp_path / "a.tiff", stored * 2, photometric=meaning)
    with pytest.raises(UserError, match=r"outside \[0, 1\]"):
        load_image(tmp_path / "a.tiff")


def test_other_meanings_and_ways_round(tmp_path):
    import tifffile

    path = tmp_path / "a.tiff"
    grey = DEEP[..., 0]
    tifffile.imwrite(path, grey, photometric="miniswhite")
    np.testing.assert_allclose(load_image(path)[..., 1], 1 - grey / 65535.0, atol=1e-6)
    tifffile.imwrite(path, DEEP, photometric="separated")
    wanted = (1 - DEEP[..., :3] / 65535.0) * (1 - DEEP[..., 3:] / 65535.0)
    np.testing.assert_allclose(load_image(path), wanted, atol=1e-6)
    multiplied = np.minimum(DEEP, DEEP[..., 3:])
    tifffile.imwrite(path, multiplied, photometric="rgb", extrasamples=["assocalpha"])
    wanted = multiplied[..., :3] / 65535.0 + 1 - multiplied[..., 3:] / 65535.0
    np.testing.assert_allclose(load_image(path), wanted, atol=1e-6)
    plain = Image.fromarray(COLOUR)
    for turn in range(1, 9):  # as Pillow turns the same
        exif = plain.getexif()
        exif[0x0112] = turn
        plain.save(tmp_path / "b.png", exif=exif)
        tags = [(274, "H", 1, turn, True)]
        tifffile.imwrite(path, COLOUR.astype(np.uint16) * 257, photometric="rgb", extratags=tags)
        np.testing.assert_allclose(load_image(path), load_image(tmp_path / "b.png"), atol=1e-6)
    tifffile.imwrite(path, np.stack([DEEP[..., :3]] * 2), photometric="rgb")
    with pytest.warns(UserWarning, match="has 2 frames"):
        load_image(path)


def test_a_vast_deep_tiff_is_refused_before_it_is_decoded(tmp_path):
    import tifffile

    vast = np.broadcast_to(np.uint16(7), (12_000, 12_000, 3))
    tifffile.imwrite(tmp_path / "a.tiff", vast, photometric="rgb", compression="zlib")
    with pytest.raises(UserError, match="pixels"):
        load_image(tmp_path / "a.tiff")


def normal_map(height, tilt=1.0, flip=1):
    down, right = np.gradient(height)
    normals = np.stack([-right * tilt, -flip * down * tilt, np.ones_like(down)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


@pytest.mark.parametrize("tilt", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("flip", [1, -1])
def test_a_normal_map_is_recognised(tmp_path, tilt, flip):
    y, x = np.mgrid[0:64, 0:64]
    normals = normal_map(3 * np.sin(x / 4) * np.cos(y / 5), tilt, flip)
    path = tmp_path / "a.png"
    Image.fromarray(((normals + 1) * 127.5).round().astype(np.uint8)).save(path)
    assert is_normal_map(load_image(path))


def test_other_pictures_are_no_normal_maps(tmp_path):
    y, x = np.mgrid[0:64, 0:64]
    wave = (np.sin(x / 4) * np.cos(y / 5) + 1) / 2
    sky = np.stack([0.5 + 0.2 * wave, 0.6 + 0.2 * wave, 0.95 + 0 * wave], axis=-1)
    light = np.repeat((0.75 + 0.1 * wave)[..., None], 3, axis=-1)
    height = np.repeat(wave[..., None], 3, axis=-1)
    for k, picture in enumerate((sky, light, height, COLOUR / 255.0, smooth_colour() / 255.0)):
        Image.fromarray((picture * 255).astype(np.uint8)).save(tmp_path / f"{k}.png")
        assert not is_normal_map(load_image(tmp_path / f"{k}.png"))


def test_deep_colours_load_their_libraries_only_when_needed(tmp_path):
    import subprocess
    import sys

    Image.fromarray(COLOUR).save(tmp_path / "a.tiff")
    Image.fromarray(COLOUR).save(tmp_path / "a.png")
    code = (
        "import sys; from styleexp.inputs.images import load_image\n"
        f"load_image({str(tmp_path / 'a.png')!r}); load_image({str(tmp_path / 'a.tiff')!r})\n"
        "assert not {'imagecodecs', 'tifffile'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
