"""A real browser for the tests of our pages: Debian's chromium, headless, with software WebGL."""

import io
import json
import shutil
import time
from contextlib import contextmanager

import numpy as np
import pytest

from tests.helpers.needed import available

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
)


def programs():
    """Paths of chromium and its driver; a `UserError` that names what is missing."""
    from styleexp.system.errors import UserError

    found = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in found:
        raise UserError("a browser is missing: apt-get install chromium chromium-driver")
    return found


@contextmanager
def browser(folder, width=1200, height=1400):
    """A driver with an empty profile in ``folder``; downloads go to ``folder/downloads``."""
    selenium = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    from selenium.webdriver.chrome.service import Service

    chromium, driver = available(programs)
    options = selenium.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={folder}/profile", f"--window-size={width},{height}"):
        options.add_argument(flag)
    options.add_experimental_option(
        "prefs", {"download.default_directory": str(folder / "downloads")}
    )
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    page = selenium.Chrome(options=options, service=Service(driver))
    try:
        page.get("about:blank")
        page.get_log("performance")  # the browser's own start page
        yield page
    finally:
        page.quit()


def wait(page, script, seconds=120):
    """Wait until a script returns something true; returns it."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found = page.execute_script(f"return {script}")
        if found:
            return found
        time.sleep(0.1)
    told = page.execute_script("return document.body.innerText.slice(0, 400)")
    pytest.fail(f"after {seconds} s still not: {script}\n{told}\n{page.get_log('browser')}")


def pixels(page, selector):
    """What an element looks like, (height, width, 3) as floats in [0, 255]."""
    from PIL import Image

    element = page.find_element("css selector", selector)
    page.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    time.sleep(0.3)  # a frame or two of a software renderer
    shot = Image.open(io.BytesIO(element.screenshot_as_png)).convert("RGB")
    return np.asarray(shot, dtype=float)


def covered(picture):
    """Share of the pixels that differ from the upper left corner's colour, and their spread."""
    differs = np.abs(picture - picture[8, 8]).max(axis=-1) > 12
    return float(differs.mean()), float(picture[differs].std()) if differs.any() else 0.0


def requests(page):
    """Addresses that our pages asked for since the last call."""
    asked = []
    for entry in page.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            asked.append(message["params"]["request"]["url"])
    return asked


def check_quiet(page):
    """No error on the console; nothing asked of any machine, this one's servers included."""
    assert [x for x in page.get_log("browser") if x["level"] == "SEVERE"] == []
    asked = requests(page)
    assert asked, "the log of requests is empty, so it proves nothing"
    assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []
