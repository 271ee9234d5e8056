"""Shrink pictures that commands wrote for the pages: ``make pictures``."""

import sys
from pathlib import Path

from PIL import Image

WIDTH = {"bmode.png": 720}
"""Of speckle a smaller picture shows enough; of the others 1200 pixels."""
NAMES = {
    "map.png": "map.png",
    "scene.png": "scene.png",
    "placements.png": "placements.png",
    "bmode.png": "bmode.png",
    "room.png": "two_arms.png",
    "convergence.png": "convergence.png",
    "camera_1.png": "camera.png",
    "budget.png": "budget.png",
}
"""What a command calls a picture, and what the pages call it."""


def main(folders: list[Path]) -> None:
    """Write what of `NAMES` the commands' folders hold to docs/pictures; all colours stay, for a legend names them."""
    for folder in folders:
        for source, name in NAMES.items():
            if (folder / source).is_file():
                picture = Image.open(folder / source).convert("RGB")
                width = min(WIDTH.get(name, 1200), picture.width)
                height = round(picture.height * width / picture.width)
                small = picture.resize((width, height), Image.Resampling.LANCZOS)
                small.save(Path(__file__).parent / "pictures" / name, optimize=True)


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
