"""What a search's candidates show in a notebook: every cell of the grid is drawn, whatever its step."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from puncture_twin.planning.base.reasons import SAFE, css
from puncture_twin.planning.search.candidates import candidates_html


class Grid(SimpleNamespace):
    """With a length."""

    def __len__(self):
        return len(self.theta)


def grid(step_deg):
    """All safe, on a full cap up to 60 degrees."""
    theta, beta = np.meshgrid(np.arange(0, 60.01, step_deg), np.arange(0, 360, step_deg), indexing="ij")
    n = theta.size
    return Grid(
        theta=np.radians(theta.ravel()), beta=np.radians(beta.ravel()), safe=np.ones(n, bool), safe_text="safe",
        verdict=SimpleNamespace(reason=np.full(n, "", object)), ranked=np.empty(0, int), arm_note="checked",
        counts=lambda: {"safe": n},
    )  # fmt: skip


@pytest.mark.parametrize("step_deg", [1.0, 2.0, 5.0, 12.0])
def test_a_safe_cap_is_one_whole_disc(step_deg):
    """Every ring of the map is drawn all around: four sectors for each ring."""
    shown = candidates_html(grid(step_deg))
    outline = re.search(rf'fill="{css(SAFE)}"[^>]* d="([^"]*)"', shown)[1]
    rings = round((60.0 + step_deg / 2) / (step_deg / 2))
    assert outline.count("M") == 4 * rings
    assert "no skin entry" not in shown
