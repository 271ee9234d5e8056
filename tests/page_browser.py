"""Headless Chromium by Playwright, and axe-core's rules in it.

What needs them skips where they are absent; where CI is set, it fails.
"""

import os
import shutil
from contextlib import contextmanager
from importlib.resources import files

import pytest

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: make install brings it")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""The machine's own; without one, Playwright's, which ``playwright install chromium`` brings."""

PATIENCE_MS = 120_000
FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
SERIOUS = {"serious", "critical"}


@contextmanager
def chromium():
    """A browser."""
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


def serious_findings(page):
    """What axe-core's own rules find, none of them left out."""
    page.evaluate((files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate("axe.run()")
    assert len(found["passes"]) > 5  # it did look
    told = [(one["impact"], one["id"], [node["target"] for node in one["nodes"]][:3]) for one in found["violations"]]
    return [one for one in told if one[0] in SERIOUS]
