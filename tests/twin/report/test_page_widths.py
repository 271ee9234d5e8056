"""The page on a phone, a tablet and a desk, by Playwright in headless Chromium; skipped where there is no browser."""

import shutil
from importlib.resources import files

import pytest
import report_world as world

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: make install brings it")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""The machine's own; without one, Playwright's, which ``playwright install chromium`` brings."""

WIDTHS = [390, 900, 1440]
PATIENCE_MS = 120_000
FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
SERIOUS = {"serious", "critical"}


@pytest.fixture(scope="module")
def browser():
    """One browser for all widths."""
    with sync_api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS, timeout=PATIENCE_MS)
        except sync_api.Error as error:
            pytest.skip(f"no browser: {error.message.splitlines()[0]}")
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The page's."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    world.make_page(path)
    return path.as_uri()


@pytest.fixture(params=WIDTHS)
def page(request, browser, address):
    """The page, open and drawn, at one width; the check's own script is let in."""
    context = browser.new_context(viewport={"width": request.param, "height": 900}, bypass_csp=True)
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.goto(address)
    page.wait_for_function("document.body.dataset.ready === 'true'")
    yield page
    context.close()


def test_axe_finds_nothing_serious(page):
    """Names, contrasts, landmarks, nesting: by axe-core's own rules, none of them left out."""
    page.evaluate((files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate("axe.run()")
    assert len(found["passes"]) > 15  # it did look
    told = [(one["impact"], one["id"], [node["target"] for node in one["nodes"]][:3]) for one in found["violations"]]
    assert [one for one in told if one[0] in SERIOUS] == []


def test_a_click_chooses_and_everything_follows(page):
    """On the map, in the table, by the keyboard; the page never grows wider than its window."""
    command = page.locator("#command")
    page.locator("#map-image").click(position={"x": 150, "y": 150})
    chosen = command.inner_text()
    assert chosen.startswith("run-twin ") and "--theta" in chosen
    page.locator("button.pick").first.click()
    assert command.inner_text() != chosen and page.locator("button.pick[aria-pressed=true]").count() == 1
    picked = command.inner_text()
    page.locator("#theta").focus()
    page.keyboard.press("ArrowRight")
    assert command.inner_text() != picked
    page.locator("#pose-target").click()
    assert page.locator("#pose-target").get_attribute("aria-pressed") == "true"
    page.locator("[data-view=axial]").click()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_dates_film_and_fractions_are_there(page):
    """When it was made, that the scan's day is not stated, a link to the film, parts of the solid angle."""
    said = page.locator("header").inner_text()
    assert "Made on 20" in said and "scan of a date that its files do not state" in said
    assert page.locator("a[href='rehearsal.mp4']").count() == 1
    assert "of solid angle" in page.locator(".mapside").inner_text()
