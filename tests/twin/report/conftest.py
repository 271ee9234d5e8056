"""The small patient of `report_world`, one a module, and a browser for all of them."""

import pytest
import report_world as world


@pytest.fixture(scope="module")
def case():
    return world.make_case()


@pytest.fixture(scope="module")
def candidates(case):
    return world.make_candidates(case)


@pytest.fixture(scope="module")
def anatomy():
    return world.make_anatomy(warnings=("rib_right_9 is open",))


@pytest.fixture(scope="module")
def plan(case, candidates):
    return world.make_plan(case, candidates)


@pytest.fixture(scope="module")
def browser():
    from page_browser import chromium  # here: without playwright its tests alone are skipped

    with chromium() as browser:
        yield browser
