"""Shrink the demo's pictures for the README: ``make pictures``."""

import sys
from pathlib import Path

from PIL import Image

WIDTH = 1200


def main(demo: Path) -> None:
    """Write docs/map.png and docs/scene.png from a demo's folder; all colours stay, for a legend names them."""
    for name in ("map.png", "scene.png"):
        picture = Image.open(demo / name).convert("RGB")
        height = round(picture.height * WIDTH / picture.width)
        picture.resize((WIDTH, height), Image.Resampling.LANCZOS).save(Path(__file__).with_name(name), optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
