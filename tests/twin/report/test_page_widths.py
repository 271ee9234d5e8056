"""The page on a phone, a tablet and a desk, by Playwright in headless Chromium; skipped where there is no browser."""

import pytest
import report_world as world
from page_browser import chromium, opened, serious_findings

WIDTHS = [390, 900, 1440]


@pytest.fixture(scope="module")
def browser():
    """One browser for all widths."""
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The page's."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    world.make_page(path)
    return path.as_uri()


@pytest.fixture(params=WIDTHS)
def page(request, browser, address):
    """The page, open and drawn, at one width."""
    with opened(browser, address, request.param) as page:
        page.wait_for_function("document.body.dataset.ready === 'true'")
        yield page


def test_axe_finds_nothing_serious(page):
    """Names, contrasts, landmarks, nesting: by axe-core's own rules, none of them left out."""
    assert serious_findings(page) == []


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
