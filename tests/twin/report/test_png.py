"""PNG files against Pillow, which reads them."""

import io

import numpy as np
import pytest
from PIL import Image

from puncture_twin.twin.report.png import png_bytes, write_png


@pytest.mark.parametrize("shaded", [False, True])
@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 13, 3), (64, 50, 4), (3, 1, 4)])
def test_pillow_reads_the_pixels_that_were_written(rng, shape, shaded):
    """Every byte, with opacity and without."""
    pixels = rng.integers(0, 256, shape, dtype=np.uint8)
    with Image.open(io.BytesIO(png_bytes(pixels, shaded=shaded))) as image:
        image.verify()
    with Image.open(io.BytesIO(png_bytes(pixels, shaded=shaded))) as image:
        assert image.mode == {3: "RGB", 4: "RGBA"}[shape[2]]
        np.testing.assert_array_equal(np.asarray(image), pixels)


def test_part_of_a_picture_can_be_written(rng, tmp_path):
    """Also where its rows are not beside each other in memory."""
    pixels = rng.integers(0, 256, (20, 30, 4), dtype=np.uint8)
    write_png(pixels[3:, ::2, :3], tmp_path / "part.png", shaded=True)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "part.png")), pixels[3:, ::2, :3])
