"""The studio's page in a real browser, and its server when others ask."""

import http.client
import json
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver.common.action_chains import ActionChains

from styleexp.inputs import meshes, shapes
from tests.helpers.browser import browser, covered, pixels, requests, wait

QUICK = ("source.refine=none", "baseline.bank=600", "threads=1")
EVIL = "<img src=x onerror=alert(1)>.obj"


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A mesh with texture coordinates and a wicked name, and a picture of discs."""
    folder = tmp_path_factory.mktemp("given")
    ball = shapes.make("sphere", 1500)
    lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices.tolist()]
    lines += [f"vt {0.5 + 0.5 * x} {0.5 + 0.5 * y}" for x, y, _ in ball.vertices.tolist()]
    lines += [
        f"f {a + 1}/{a + 1} {b + 1}/{b + 1} {c + 1}/{c + 1}" for a, b, c in ball.faces.tolist()
    ]
    (folder / EVIL).write_text("\n".join(lines))
    rows, columns = np.sin(np.mgrid[0:96, 0:96] / 5)
    Image.fromarray((255 * (rows * columns).clip(0)).astype(np.uint8)).save(folder / "discs.png")
    return folder


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    """The command, running; its address and folder."""
    folder = tmp_path_factory.mktemp("studio")
    mesh = shapes.make("bubble", 3000)
    meshes.save_mesh(mesh, mesh.vertices, folder / "bubble.ply")
    command = [sys.executable, "-m", "styleexp.cli.studio", "sphere", "bubble.ply"]
    command += ["--no-browser", "--out", "made", *QUICK]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().split()[-1]
            threading.Thread(target=process.stdout.read, daemon=True).start()
            yield address, folder / "made"
        finally:
            process.terminate()


def ask(address, path="", method="GET", body=None, host=None, token=True):
    """Status and body of a request."""
    _, _, place, secret, _ = address.split("/")
    connection = http.client.HTTPConnection(place, timeout=60)
    prefix = f"/{secret}/" if token else "/"
    connection.request(method, prefix + path, body, {"Host": host} if host else {})
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_nobody_else_gets_in(studio):
    address, _ = studio
    assert address.startswith("http://127.0.0.1:")
    assert ask(address)[0] == 200
    assert ask(address, token=False)[0] == 404
    assert ask(address, "state?since=-1", token=False)[0] == 404
    assert ask(address, host="attacker.example")[0] == 400


def test_what_does_not_fit_is_one_sentence(studio):
    address, folder = studio
    for path, method, body, said in (
        ("settings", "POST", b'{"strength": 1e9}', "from -2 to 2"),
        ("settings", "POST", b"[]", "give an object"),
        ("settings", "POST", b"{", "not JSON"),
        ("save", "POST", b'{"formats": []}', "at least one format"),
        ("files/source/..%2F..%2Fevil.sh", "PUT", b"x", None),
        ("files/source/evil.sh", "PUT", b"x", "can't be read"),
    ):
        status, answer = ask(address, path, method, body)
        assert status in (400, 404, 422), path
        if said is not None:
            assert said in json.loads(answer)["error"]
    assert not list(folder.parent.rglob("evil.sh"))


def paint(page, kind):
    """Choose a brush and drag over the middle of the result."""
    page.execute_script(
        f"const s = document.getElementById('where'); s.value = '{kind}';"
        "s.dispatchEvent(new Event('change'));"
    )
    drag = ActionChains(page).move_to_element(page.find_element("id", "strokes")).click_and_hold()
    drag.move_by_offset(60, 0).move_by_offset(60, 0).release().perform()


def shown(page):
    """How many results the page has shown."""
    return int(page.execute_script("return document.getElementById('stage').dataset.shown"))


def test_from_drop_to_saved_files(studio, given, tmp_path):
    address, folder = studio
    with browser(tmp_path, width=1300, height=1000) as page:
        page.get(address)
        wait(page, "document.getElementById('stage-line').textContent === 'Done'")
        share, spread = covered(pixels(page, "#view-result"))
        assert share > 0.1
        assert spread > 10

        page.find_element("id", "file-source").send_keys(str(given / EVIL))
        wait(page, "document.getElementById('command').textContent.includes('onerror')")
        page.find_element("id", "file-style").send_keys(str(given / "discs.png"))
        wait(page, "document.getElementById('command').textContent.includes('discs.png')")
        done = (
            "document.getElementById('stage-line').textContent === 'Done'"
            " && !document.getElementById('save').disabled"
        )
        wait(page, done)
        assert page.find_element("id", "name-source").text == EVIL
        assert page.find_element("id", "picture-style").is_displayed()
        before = pixels(page, "#view-result")

        page.execute_script(
            "const s = document.getElementById('strength'); s.value = 2;"
            "s.dispatchEvent(new Event('input'));"
        )
        wait(page, "document.getElementById('command').textContent.includes('strength=2')")
        wait(page, done)
        wait(page, "Number(document.getElementById('stage').dataset.shown) > 2")
        assert np.abs(pixels(page, "#view-result") - before).mean() > 0.5

        before, looks = pixels(page, "#view-result"), shown(page)
        paint(page, "near")
        wait(page, "document.getElementById('command').textContent.includes('=near:')")
        wait(page, f"Number(document.getElementById('stage').dataset.shown) > {looks}")
        wait(page, done)
        time.sleep(1.5)  # the strokes fade
        painting = pixels(page, "#view-result").astype(int)
        blue = painting[..., 2] - painting[..., 0] > 40
        assert blue.mean() > 0.02  # the mask, while one paints
        page.find_element("id", "paint").click()
        time.sleep(1.5)
        plain = pixels(page, "#view-result").astype(int)
        assert (plain[..., 2] - plain[..., 0] > 40).mean() < 0.001
        # Away from the brush it is a ball again.
        left = np.abs(pixels(page, "#view-result") - before)[:, : before.shape[1] // 3]
        assert left.mean() > 5
        assert "the relief covers" in page.find_element("id", "notes").text
        page.find_element("id", "unpaint").click()
        wait(page, "!document.getElementById('command').textContent.includes('near')")
        wait(page, done)

        page.get(address)  # as after a closed tab
        wait(page, done)
        assert "strength=2" in page.find_element("id", "command").text
        for kind in ("stl", "maps"):
            page.find_element("css selector", f"#formats input[value='{kind}']").click()
        page.find_element("id", "save").click()
        wait(page, "document.getElementById('saved').dataset.count === '8'")
        assert [each for each in page.get_log("browser") if each["level"] == "SEVERE"] == []
        asked = requests(page)
        assert any(url.startswith(address) for url in asked)
        assert [url for url in asked if not url.startswith((address, "blob:", "data:"))] == []
    names = {path.name for path in folder.glob("*/*") if path.parent.name != "files"}
    maps = {f"{each}.png" for each in ("height", "normal", "occlusion", "curvature")}
    assert maps | {"command.txt"} < names
    assert any(name.endswith("_low.glb") for name in names)
    assert {name.rpartition(".")[2] for name in names} == {"glb", "stl", "png", "txt"}
