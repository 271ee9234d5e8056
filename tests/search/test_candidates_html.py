"""What a search's candidates show in a notebook: every cell of the grid is drawn, whatever its step."""

import base64
import io
import re
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from puncture_twin.planning.base.reasons import SAFE
from puncture_twin.planning.search.candidates import Candidates


class Grid(SimpleNamespace):
    """With a length."""

    def __len__(self):
        return len(self.theta)


def grid(step_deg):
    theta, beta = np.meshgrid(np.arange(0, 60.01, step_deg), np.arange(0, 360, step_deg), indexing="ij")
    n = theta.size
    return Grid(
        theta=np.radians(theta.ravel()), beta=np.radians(beta.ravel()), safe=np.ones(n, bool), safe_text="safe",
        verdict=SimpleNamespace(reason=np.full(n, "", object)), ranked=np.empty(0, int), arm_note="checked",
        counts=lambda: {"safe": n},
    )  # fmt: skip


@pytest.mark.parametrize("step_deg", [1.0, 2.0, 5.0, 12.0])
def test_a_safe_cap_is_one_whole_disc(step_deg):
    shown = Candidates.plot_map(grid(step_deg))._repr_html_()
    data = base64.b64decode(re.search(r'base64,([^"]+)"', shown)[1])
    picture = np.asarray(Image.open(io.BytesIO(data))).astype(int)
    inside = np.hypot(*np.meshgrid(*2 * [(np.arange(640) - 319.5) / 320])) < 1
    lined = np.round(np.array(SAFE) * 0.55)
    assert ((picture == SAFE) | (picture == lined)).all(axis=2)[inside].all()
    assert (picture == SAFE).all(axis=2)[inside].mean() > 0.95
    assert "no skin entry" not in shown
