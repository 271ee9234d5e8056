"""What a case leaves open of where its robot is."""

from __future__ import annotations

from puncture_twin.planning.case.case_file import CaseFile
from puncture_twin.planning.case.settings import RobotSettings
from puncture_twin.planning.case.tables.registration_section import NO_RESIDUALS

ROBOT_NOWHERE = (
    "the case names a robot ({robot}), but not where its base is: the arm is not checked "
    "([registration] or [robot.mount] says it)"
)


def robot_warnings(content: CaseFile, robot: RobotSettings) -> tuple[str, ...]:
    """That a stated transform has no residuals, or that nothing is said of where a robot is: no verdict is about it."""
    stated = content.registration
    if stated is not None and stated.transform is not None:
        return () if stated.markers_ct else (f"registration: {NO_RESIDUALS.format(file=stated.transform)}",)
    located = stated is not None or content.robot.mount is not None
    nowhere = not located and bool({"robot", "tool"} & content.model_fields_set)
    return (ROBOT_NOWHERE.format(robot=robot.model.name),) if nowhere else ()
