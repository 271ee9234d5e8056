"""The cohort's page on a phone and a desk, in headless Chromium; skipped where there is no browser."""

import base64
import io

import numpy as np
import pytest
from page_browser import chromium, opened, serious_findings
from PIL import Image

from puncture_twin.planning.batch.merge import SCHEMA
from puncture_twin.twin.jobs.batch.jobs import histogram, write_cohort_page

HITS = [0.5, 1.0, None, 1e-9, 0.93]
"""Chances of five cases, the third without a safe direction."""


def row(at, hit):
    values = dict.fromkeys([*SCHEMA.names, "page"])
    safe = 0 if hit is None else 12
    known = {"case": f"p{at}/case.toml", "name": f"p{at}", "id": f"{at:032x}", "safe": safe, "arm": "checked"}
    return {**values, **known, "exit_code": int(hit is None), "directions": 100, "best_p_hit": hit, "page": at == 0}


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("cohort") / "cohort.html"
    rows = [row(at, hit) for at, hit in enumerate(HITS)]
    rows.append({**row(9, None), "exit_code": 2, "reason": "case.toml: no such structure", "safe": None})
    write_cohort_page("study", rows, (), path)
    return path.as_uri()


@pytest.fixture(scope="module")
def browser():
    with chromium() as browser:
        yield browser


@pytest.mark.parametrize("width", [390, 1200])
def test_the_page_reads_and_sorts(browser, address, width):
    """No serious finding, never wider than its window; a chance sorts by its size, however it is written."""
    with opened(browser, address, width) as page:
        assert serious_findings(page) == []
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        page.get_by_role("button", name="p hit").click()
        cells = page.locator("table.sortable tbody tr").evaluate_all(
            "rows => rows.map(row => row.cells[9].textContent)"
        )
        assert cells[:4] in (["<0.0001", "0.50", "0.93", ">0.9999"], [">0.9999", "0.93", "0.50", "<0.0001"])
        assert page.locator("table.sortable a").count() == 1


def test_a_distribution_is_a_picture_with_as_much_green_as_it_has_cases():
    """The same bytes for the same numbers; three bars, of which one is twice as high; what it says is read aloud."""
    values = [0.0, 1.0, 1.0, 3.0]
    shown = str(histogram(values, "best clearance, mm"))
    assert 'alt="best clearance, mm: 4 cases, median 1"' in shown and shown == histogram(values, "best clearance, mm")
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(shown.split("base64,")[1].split('"')[0]))))
    high = (picture[..., :3] == (0, 104, 74)).all(axis=2).sum(axis=0)
    edges = np.flatnonzero(np.diff(np.pad(high > 0, 1).astype(int)))
    first, second, third = (int(high[begin:end].max()) for begin, end in edges.reshape(-1, 2))
    assert abs(second - 2 * first) <= 2 and abs(third - first) <= 1
