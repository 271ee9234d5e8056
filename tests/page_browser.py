"""Headless Chromium by Playwright, axe-core's rules in it, and what its canvases show.

What needs them skips where they are absent; where CI is set, it fails.
"""

import base64
import io
import os
import shutil
from contextlib import contextmanager
from importlib.resources import files

import numpy as np
import pytest
from PIL import Image

from puncture_twin.twin.report.slices.panel import PIXELS

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: make install brings it")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""The machine's own; without one, Playwright's, which ``playwright install chromium`` brings."""
PATIENCE_MS = 120_000
FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
SERIOUS = {"serious", "critical"}
GREYS = 2
"""Of 255, in the window of 400 HU: half a step of the page's bytes (1.7 HU), and the rounding of a grey."""
SHOWN = """() => [...document.querySelectorAll("#slices-a .slice")].map((one) => {
    const [base, over] = one.querySelectorAll("canvas"), both = document.createElement("canvas");
    both.width = both.height = base.width;
    const context = both.getContext("2d");
    context.drawImage(base, 0, 0);
    context.drawImage(over, 0, 0, base.width, base.height);
    return [base.toDataURL(), both.toDataURL()];
})"""


@contextmanager
def chromium():
    with sync_api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS, timeout=PATIENCE_MS)
        except sync_api.Error as error:
            absent = pytest.fail if os.environ.get("CI") else pytest.skip
            absent(f"no browser: {error.message.splitlines()[0]}")
        yield browser
        browser.close()


@contextmanager
def opened(browser, address, width):
    """A page at one width; the check's own script is let in."""
    context = browser.new_context(viewport={"width": width, "height": 900}, bypass_csp=True)
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.goto(address)
    yield page
    context.close()


@contextmanager
def ready(browser, address, width=1300):
    """The page of a report, whose script has run and whose slices are drawn."""
    with opened(browser, address, width) as page:
        page.wait_for_function("document.body.dataset.ready === 'true'")
        drawn(page)
        yield page


def serious_findings(page):
    """What axe-core's own rules find, none of them left out."""
    page.evaluate((files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate("axe.run()")
    assert len(found["passes"]) > 5  # it did look
    told = [(one["impact"], one["id"], [node["target"] for node in one["nodes"]][:3]) for one in found["violations"]]
    return [one for one in told if one[0] in SERIOUS]


def drawn(page, what=None):
    """Wait until a row's slices, or any, are drawn; returns the row."""
    one = "document.getElementById('slices-a').dataset.drawn"
    page.wait_for_function(f"{one} === '{what}'" if what is not None else f"{one} !== undefined")
    return page.evaluate(one)


def picture(address):
    """The pixels of a data address, RGB."""
    content = base64.b64decode(address.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)


def row_of(candidates, theta_deg, beta_deg):
    same = np.isclose(candidates.theta, np.radians(theta_deg)) & np.isclose(candidates.beta, np.radians(beta_deg))
    return int(np.flatnonzero(same)[0])


def at_pixel(page, number, column, row):
    """Point at a pixel of a slice, 480 a side; returns where that is in the window."""
    over = page.locator("#slices-a .over").nth(number)
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    place = {"x": (column + 0.5) / PIXELS * box["width"], "y": (row + 0.5) / PIXELS * box["height"]}
    over.hover(position=place)
    box = over.bounding_box()
    return box["x"] + place["x"], box["y"] + place["y"]


def pick_first(page):
    """Choose the best window's direction in the table, and wait for its slices; returns its row."""
    first = page.locator("button.pick").first
    first.click()
    return int(drawn(page, first.get_attribute("data-row")))
