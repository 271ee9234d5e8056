"""A label map must hold the body within the needle's reach; both are compared along the map's own axes."""

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from case_world import write_case
from scipy.spatial.transform import Rotation

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.search.context import prepare

STEP_MM = 2.0


def oblique_case(folder, half_mm, turn):
    """The usual patient, whose skin is a ball of 90 mm; its label map is a cube about it, turned."""
    path = write_case(folder)
    n = round(2 * half_mm / STEP_MM)
    T = np.eye(4)
    T[:3, :3] = turn.as_matrix() * STEP_MM
    T[:3, 3] = -T[:3, :3] @ np.full(3, (n - 1) / 2)
    points = np.moveaxis(np.indices((n, n, n)), 0, -1) @ T[:3, :3].T + T[:3, 3]
    vessel = (np.abs(points - [36.0, 36.0, 0.0]) < [4.0, 4.0, 20.0]).all(axis=-1)
    image = sitk.GetImageFromArray((3 * vessel).astype(np.uint8).transpose(2, 1, 0))
    image.SetSpacing([STEP_MM] * 3)
    image.SetOrigin(T[:3, 3].tolist())
    image.SetDirection(turn.as_matrix().ravel().tolist())
    sitk.WriteImage(image, str(folder / "labels.nrrd"))
    return path


@pytest.mark.parametrize("degrees", [(0, 0, 0), (0, 0, 45), (20, -30, 40), (90, 0, 0), (180, 0, 5)])
def test_an_oblique_map_that_holds_the_body_is_accepted(tmp_path, degrees):
    """The corners of the body's box lie outside of a turned map; the body does not."""
    turn = Rotation.from_euler("xyz", degrees, degrees=True)
    names = [s.name for s in prepare(oblique_case(tmp_path, 92.0, turn), arm=False).anatomy.structures]
    assert "vessel" in names


@pytest.mark.parametrize("degrees", [(0, 0, 0), (20, -30, 40)])
def test_an_oblique_map_that_ends_in_the_body_is_refused(tmp_path, degrees):
    """By six voxels of 2 mm at every face, within the needle's reach."""
    turn = Rotation.from_euler("xyz", degrees, degrees=True)
    with pytest.raises(InputError, match=r"label map labels.nrrd ends [56] voxels inside the body"):
        prepare(oblique_case(tmp_path, 78.0, turn), arm=False)


@pytest.mark.parametrize(("half_mm", "refused"), [(70.0, False), (50.0, True)])
def test_only_what_the_needle_reaches_counts(tmp_path, half_mm, refused):
    """With a needle of 62 mm a map of 70 mm to each side is enough, though the body goes on."""
    path = oblique_case(tmp_path, half_mm, Rotation.from_euler("xyz", (20, -30, 40), degrees=True))
    path.write_text(
        path.read_text().replace("length_mm = 210.0\nshaft_mm = 150.0", "length_mm = 62.0\nshaft_mm = 60.0")
    )
    if refused:
        with pytest.raises(InputError, match=r"ends [56] voxels inside the body"):
            prepare(path, arm=False)
    else:
        prepare(path, arm=False)
