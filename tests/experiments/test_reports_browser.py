"""Our pages in a real browser, from file://, without a network."""

import json
import random
import time

import numpy as np
import pytest

from tests.helpers import warm
from tests.helpers.browser import browser, check_quiet, covered, pixels, wait

EVIL = "<img src=x onerror=alert(1)>"
SMOKE = ["method=robust", "profile=smoke", "encoder=vgg19_random"]
PARTICIPANTS = 4


def styleexp(*arguments, cwd):
    return warm.run("-m", "styleexp", *arguments, cwd=cwd, env=warm.coarse())


def report(*arguments, cwd):
    done = warm.run("-m", "styleexp.cli.report", *arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A sweep of two pairs, with a job that fails, and a run of a mesh with a wicked name."""
    from styleexp.inputs import meshes, shapes

    folder = tmp_path_factory.mktemp("runs")
    torus = shapes.make("torus", detail=2000)
    meshes.save_mesh(torus, torus.vertices, folder / f"{EVIL}.obj")
    done = styleexp(
        f'source.path="{EVIL}.obj"', "style=bubble", *SMOKE, "hydra.run.dir=evil", cwd=folder
    )
    assert done.returncode == 0, done.stderr
    from PIL import Image

    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(folder / "noise.png")
    done = styleexp(
        "-m", "source=torus", "style=bubble,stripe", "field.sigma=2,-1", *SMOKE,
        "hydra.sweep.dir=sweep", cwd=folder,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    report("sweep", cwd=folder)
    pictures = ("source=torus", "style.path=noise.png", *SMOKE, "hydra.run.dir=board/noise")
    assert styleexp(*pictures, cwd=folder).returncode == 0
    mesh = ("source=torus", "style=bubble", *SMOKE, "hydra.run.dir=board/bubble")
    assert styleexp(*mesh, cwd=folder).returncode == 0
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("browser")) as driver:
        yield driver


def open_run(page, path):
    page.get(path.as_uri())
    wait(page, "document.getElementById('stage').dataset.shown")


def press(page, button):
    """Click a button that has the meshes drawn anew; wait until they are."""
    before = page.execute_script("return document.getElementById('stage').dataset.shown")
    page.find_element("id", button).click()
    wait(page, f"document.getElementById('stage').dataset.shown !== '{before}'")


def orbit(page, kind):
    return page.execute_script(
        "const o = document.getElementById(arguments[0]).getCameraOrbit();"
        "return [o.theta, o.phi, o.radius]",
        f"view-{kind}",
    )


def test_run_page_shows_its_meshes_and_a_wicked_name_is_only_a_name(runs, page):
    open_run(page, runs / "evil" / "report.html")
    for kind in ("source", "style", "result"):
        share, spread = covered(pixels(page, f"#view-{kind}"))
        assert share > 0.1, kind  # of the picture, and shaded
        assert spread > 10, kind
    assert page.find_element("tag name", "h1").text == f"{EVIL} in the style of bubble"
    assert page.execute_script("return document.querySelectorAll('img[src=x]').length") == 0
    assert EVIL in page.find_element("id", "command").text
    check_quiet(page)


def test_heat_map_and_wireframe_change_what_is_seen(runs, page):
    open_run(page, runs / "evil" / "report.html")

    def colourful(picture):
        return float((picture.max(axis=-1) - picture.min(axis=-1)).mean())

    plain, source = pixels(page, "#view-result"), pixels(page, "#view-source")
    press(page, "heat")
    heat = pixels(page, "#view-result")
    assert colourful(heat) > 2 * colourful(plain)
    assert page.find_element("id", "legend").is_displayed()
    assert np.abs(pixels(page, "#view-source") - source).mean() < 1
    press(page, "wire")
    wire = pixels(page, "#view-source")
    assert np.abs(wire - source).mean() > 2
    assert wire.mean() < source.mean()  # dark lines
    press(page, "wire")
    assert np.abs(pixels(page, "#view-source") - source).mean() < 1
    check_quiet(page)


def test_cameras_follow_the_one_that_is_turned_by_keyboard(runs, page):
    from selenium.webdriver.common.keys import Keys

    open_run(page, runs / "evil" / "report.html")
    before = orbit(page, "result")
    source = page.find_element("id", "view-source")
    page.execute_script("arguments[0].shadowRoot.querySelector('.userInput').focus()", source)
    page.switch_to.active_element.send_keys(Keys.ARROW_LEFT * 5)
    wait(page, f"Math.abs(byId('view-source').getCameraOrbit().theta - {before[0]}) > 0.2")
    time.sleep(1)  # the camera glides to a halt
    assert orbit(page, "result") == pytest.approx(orbit(page, "source"), abs=1e-3)
    assert orbit(page, "style") == pytest.approx(orbit(page, "source"), abs=1e-3)
    moved = orbit(page, "result")
    page.find_element("id", "link").click()
    page.execute_script("arguments[0].shadowRoot.querySelector('.userInput').focus()", source)
    page.switch_to.active_element.send_keys(Keys.ARROW_LEFT * 5)
    time.sleep(1)
    assert orbit(page, "result") == pytest.approx(moved, abs=1e-6)
    assert abs(orbit(page, "source")[0] - moved[0]) > 0.2
    page.find_element("id", "home").click()
    assert orbit(page, "source") == pytest.approx(before, abs=1e-3)


def test_before_and_after_lie_on_each_other(runs, page):
    open_run(page, runs / "evil" / "report.html")
    press(page, "heat")
    page.find_element("id", "compare").click()

    def cut(percent):
        page.execute_script(
            "byId('cut').value = arguments[0]; byId('cut').dispatchEvent(new Event('input'))",
            percent,
        )
        return pixels(page, ".panel.result")

    result, half, source = cut(0), cut(50), cut(100)
    middle = half.shape[1] // 2
    left, right = np.s_[:, : middle - 20], np.s_[:, middle + 20 :]
    assert np.abs(half[left] - source[left]).mean() < 1
    assert np.abs(half[right] - result[right]).mean() < 1
    assert np.abs(source - result).mean() > 2


def test_turning_stops_when_a_mesh_is_touched(runs, page):
    open_run(page, runs / "evil" / "report.html")
    page.find_element("id", "spin").click()
    start = orbit(page, "result")[0]
    wait(page, f"byId('view-result').getCameraOrbit().theta > {start} + 0.1")
    touch = "byId('view-source').dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}))"
    page.execute_script(touch)
    assert page.find_element("id", "spin").get_attribute("aria-pressed") == "false"


def test_run_page_fits_a_phone_and_follows_dark_mode(runs, tmp_path):
    with browser(tmp_path, width=500, height=900) as phone:
        phone.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True},
        )
        open_run(phone, runs / "evil" / "report.html")
        assert phone.execute_script("return document.documentElement.scrollWidth") <= 360

        def paper():
            return phone.execute_script("return getComputedStyle(document.body).backgroundColor")

        light = paper()
        dark = [{"name": "prefers-color-scheme", "value": "dark"}]
        phone.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": dark})
        assert paper() != light
        check_quiet(phone)


def test_sweep_page_opens_runs_sorts_and_shows_failures(runs, page):
    page.get((runs / "sweep" / "report.html").as_uri())
    text = page.find_element("tag name", "main").text
    assert text.count("failed\n") >= 2
    assert "field.sigma=-1" in text  # the reason
    means = page.find_elements("xpath", "//h3[.='Means by field.sigma']/following::table[1]//tr")
    assert [row.text.split()[:2] for row in means[1:]] == [["-1", "0"], ["2", "2"]]  # finished
    runs_table = page.find_element("xpath", "//h3[.='All runs']/following::table[1]")

    def shown():
        cells = runs_table.find_elements("css selector", "tbody td:nth-of-type(5)")
        return [cell.get_attribute("data-value") for cell in cells]

    assert len(shown()) == 4
    runs_table.find_element("xpath", ".//button[.='loss']").click()
    up = shown()
    numbers = [float(value) for value in up if value]
    assert numbers == sorted(numbers)
    assert up[-2:] == ["", ""]  # what failed has none
    runs_table.find_element("xpath", ".//button[.='loss']").click()
    down = [float(value) for value in shown() if value]
    assert down == numbers[::-1]
    page.find_element("css selector", ".entry a[href^='0/']").click()
    wait(page, "document.getElementById('stage')?.dataset.shown")
    assert page.current_url == (runs / "sweep" / "0" / "report.html").as_uri()
    check_quiet(page)


def test_compared_runs_turn_together_and_the_difference_is_coloured(runs, page):
    from selenium.webdriver.common.keys import Keys

    report("board/bubble", "board/noise", "--out", "compared.html", cwd=runs)
    open_run(page, runs / "compared.html")
    assert page.title == "torus: style bubble, noise"
    plain = [pixels(page, f"#view-result-{k}") for k in (0, 1)]
    for picture in plain:
        assert covered(picture)[0] > 0.1
    press(page, "heat")
    first, second = (pixels(page, f"#view-result-{k}") for k in (0, 1))
    assert np.abs(first - plain[0]).mean() < 1  # the others are compared with it
    assert np.abs(second - plain[1]).mean() > 2
    assert "in radii of the source" in page.find_element("id", "legend").text
    before = orbit(page, "result-0")[0]
    view = page.find_element("id", "view-result-1")
    page.execute_script("arguments[0].shadowRoot.querySelector('.userInput').focus()", view)
    page.switch_to.active_element.send_keys(Keys.ARROW_LEFT * 5)
    wait(page, f"Math.abs(byId('view-result-0').getCameraOrbit().theta - {before}) > 0.2")
    check_quiet(page)


def test_sweep_page_filters_rows_and_pictures_and_groups_rows(runs, page):
    from selenium.webdriver.support.ui import Select

    page.get((runs / "sweep" / "report.html").as_uri())

    def seen(selector):
        return [
            each for each in page.find_elements("css selector", selector) if each.is_displayed()
        ]

    box = page.find_element("id", "filter")
    box.send_keys("FAILED style=bubble")
    assert len(seen("table.runs tr[data-text]")) == len(seen(".entry")) == 1
    assert page.find_element("id", "filter-state").text == "1 of 4 runs"
    assert len(seen("table.sheet tbody tr")) == 1  # stripe's row is empty
    Select(page.find_element("css selector", "select.group")).select_by_visible_text("style")
    assert [row.text for row in seen("table.runs tr.group")] == ["style=bubble"]
    box.clear()
    box.send_keys(" ")
    assert [row.text for row in seen("table.runs tr.group")] == ["style=bubble", "style=stripe"]
    page.find_element("xpath", "//table[contains(@class, 'runs')]//button[.='field.sigma']").click()
    rows = [row.text.split()[0] for row in seen("table.runs tbody tr")]
    assert rows[0] == "style=bubble"  # a group's name stays first
    assert len(rows) == 6
    check_quiet(page)


def keep_still(page):
    """As for people who ask for less motion: in software each frame of a turn takes long."""
    still = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": still})


def take_part(page, uri, seed, downloads):
    """Go through the study as one simulated participant; returns the saved file's content."""
    chance = random.Random(seed)
    page.get("about:blank")  # else a change of the hash alone would not load the page anew
    page.get(f"{uri}#seed={seed}&simulated")
    wait(page, "!document.getElementById('welcome').hidden")
    again = page.find_element("id", "again")
    (again if again.is_displayed() else page.find_element("id", "begin")).click()
    while not page.find_element("id", "thanks").is_displayed():
        pair = wait(page, "document.getElementById('stage').dataset.pair")
        assert not page.find_element("id", "next").is_enabled()
        rating = chance.randint(1, 5)
        page.find_element("css selector", f"#scale input[value='{rating}']").click()
        page.find_element("id", "next").click()
        wait(page, f"document.getElementById('stage').dataset.pair !== {json.dumps(pair)}"
                   " || !document.getElementById('thanks').hidden")  # fmt: skip
    before = set(downloads.glob("*.json"))
    page.find_element("id", "save").click()
    deadline = time.monotonic() + 30
    while not (new := set(downloads.glob("*.json")) - before):
        assert time.monotonic() < deadline, "the browser saved no file"
        time.sleep(0.1)
    return new.pop()


def test_study_is_rated_saved_and_analysed(runs, tmp_path):
    report("study", "board", "--seed", "3", cwd=runs)
    uri = (runs / "board" / "study.html").as_uri()
    with browser(tmp_path, width=600, height=700) as page:  # fewer pixels to draw in software
        keep_still(page)
        files = [take_part(page, uri, seed, tmp_path / "downloads") for seed in range(PARTICIPANTS)]
        check_quiet(page)
    answers = [json.loads(path.read_text()) for path in files]
    assert len({each["participant"] for each in answers}) == PARTICIPANTS
    assert all(each["simulated"] for each in answers)
    assert set(answers[0]) <= {  # nothing about the participant
        "schema", "study", "title", "participant", "simulated", "study_seed", "order_seed",
        "order", "pairs", "ratings", "seconds",
    }  # fmt: skip
    assert len({tuple(each["order"]) for each in answers}) == 2  # both orders were seen
    for seed, each in enumerate(answers):
        chance = random.Random(seed)
        assert [each["ratings"][pair] for pair in each["order"]] == [
            chance.randint(1, 5) for _ in each["order"]
        ]
    broken = tmp_path / "broken.json"
    broken.write_text(files[0].read_text()[:200])
    done = report("study", "--analyse", *files, broken, "--out", tmp_path / "out", cwd=runs)
    assert "broken.json' was left out" in done.stderr
    found = json.loads((tmp_path / "out" / "study.json").read_text())
    assert found["participants"] == found["simulated_participants"] == PARTICIPANTS
    assert found["pairs"] == 2
    assert (tmp_path / "out" / "fig9.png").stat().st_size > 10_000


def test_study_shows_the_style_as_a_mesh_or_a_picture(runs, page):
    from selenium.webdriver.common.by import By

    report("study", "board", cwd=runs)
    page.get((runs / "board" / "study.html").as_uri() + "#seed=1&simulated")
    wait(page, "!document.getElementById('welcome').hidden")
    page.find_element(By.ID, "begin").click()
    start = orbit(page, "result")[0]
    wait(page, f"byId('view-result').getCameraOrbit().theta > {start}")  # it turns by itself
    page.find_element(By.ID, "spin").click()
    seen = set()
    for _ in range(2):
        pair = wait(page, "document.getElementById('stage').dataset.pair")
        for kind in ("source", "result"):
            assert covered(pixels(page, f"#view-{kind}"))[0] > 0.1
        picture = page.find_element(By.ID, "picture").is_displayed()
        assert picture == (pair == "noise")
        shown = "#picture" if picture else "#view-style"
        assert covered(pixels(page, shown))[1] > 10
        seen.add(pair)
        page.find_element("tag name", "body").send_keys("4\n")
        wait(page, f"document.getElementById('stage').dataset.pair !== '{pair}'"
                   " || !document.getElementById('thanks').hidden")  # fmt: skip
    assert seen == {"noise", "bubble"}
    check_quiet(page)
