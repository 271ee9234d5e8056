"""The embedded abdomen with a straight plan into the right lobe of its liver."""

from dataclasses import replace

import pytest
from sight_world import straight_plan

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.settings import Stereo, Ultrasound
from puncture_twin.planning.search.context import prepare

PROBE = Ultrasound(ur_model("ur3"), None, (0.3, 0.5), (0.08, 0.5), 0.07, 150.0, 40.0)


@pytest.fixture(scope="session")
def abdomen():
    """The prepared case, with cameras and a probe whose places are open; and its plan."""
    context = prepare(folder() / "abdomen" / "case.toml")
    case = replace(context.case, stereo=Stereo(None, (80.0, 160.0), 0.03), ultrasound=PROBE)
    context = replace(context, case=case, chance=None)  # which nothing here asks for
    return context, straight_plan(context, 64.0, 98.0)


@pytest.fixture(scope="session")
def stated(abdomen):
    """A function: the abdomen with other keys of `Stereo` or `Ultrasound`; None declares none."""
    context, plan = abdomen

    def make(kind, **keys):
        value = None if not keys else replace(getattr(context.case, kind), **keys)
        return replace(context, case=replace(context.case, **{kind: value})), plan

    return make
