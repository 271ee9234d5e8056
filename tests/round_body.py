"""A folder that `init` starts from: the CT of a round body about the origin on a grid of 4 mm, and masks in it."""

from pathlib import Path
from unittest.mock import Mock, patch

import numpy as np
import SimpleITK as sitk  # noqa: N813
from case_world import image_of

from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main
from puncture_twin.twin.report.slices import sheet

SPACING = (4.0, 4.0, 4.0)
AT = np.arange(50) * 4.0 - 98.0
Z, Y, X = np.meshgrid(AT, AT, AT, indexing="ij")


def inside(middle, radius):
    """Voxels (z, y, x) of a ball."""
    return (X - middle[0]) ** 2 + (Y - middle[1]) ** 2 + (Z - middle[2]) ** 2 < radius**2


BODY = inside((0.0, 0.0, 0.0), 90.0)


def body_hu():
    """Of the body, with noise, HU (z, y, x)."""
    return np.where(BODY, 40.0, -1000.0) + np.random.default_rng(5).normal(0.0, 12.0, X.shape)


def write_image(path, voxels):
    """Values (z, y, x) as they are."""
    sitk.WriteImage(image_of(voxels, SPACING), str(path))


def write_ct(path):
    write_image(path, body_hu().astype(np.int16))


def write_mask(path, voxels):
    write_image(path, voxels.astype(np.uint8))


def run_init(capfd, folder, *words):
    """Run `init` without its picture; exit code, stdout, and stderr's lines that are no progress."""
    with patch.multiple(sheet, draw_slices=Mock(), write_sheet=Mock()):
        code = main(["init", str(folder), *words])
    out, err = capfd.readouterr()
    return code, out, [line for line in err.splitlines() if not line.startswith("stage") and ", took " not in line]


def roles(case):
    """Name to role and margin of the case's structures, as a search reads them; of a folder, or as prepared."""
    context = prepare(case, arm=False) if isinstance(case, Path) else case
    return {one.name: (str(one.role), one.margin_mm) for one in context.anatomy.structures}
