"""The film as a file: what changes from frame to frame is put on a ground, and goes to the encoder as whole frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from puncture_twin.planning.base.files import atomic

Pixels = NDArray[np.uint8]
"""Shape (h, w, 3)."""

SAME_BYTES = ("-threads", "4", "-filter_threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact",
              "-sws_flags", "bitexact+accurate_rnd")  # fmt: skip
"""x264 writes other bytes for another number of threads, and left alone it takes as many as there are cores."""

QUALITY = ("-crf", "20", "-preset", "veryfast", "-movflags", "+faststart")

BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
"""Of an MP4 file (ISO 14496-12), from the outermost to the one that lists the frames' sizes."""

SIZES = b"stsz"


class Part(NamedTuple):
    """A part of a frame that may differ from the ground."""

    left: int
    top: int
    pixels: Pixels


Frame = Sequence[Part]


def put_on(ground: Pixels, frame: Frame) -> Pixels:
    """The whole frame."""
    whole = ground.copy()
    for left, top, pixels in frame:
        whole[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
    return whole


def write_mp4(ground: Pixels, frames: Iterable[Frame], path: Path, fps: int) -> None:
    """Write the film; it appears whole or not at all.

    Args:
        ground: What every frame is put on; its height and width are multiples of 16, as H.264 likes them.
        frames: Drawn while the encoder works on those before.
        path: The ``.mp4`` to write.

    Raises:
        OSError: No encoder can be started.
        RuntimeError: It has no H.264, or did not write all frames.
    """
    height, width = ground.shape[:2]
    with atomic(path) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (width, height),
            fps=fps,
            codec="libx264",
            quality=None,
            output_params=[*QUALITY, *SAME_BYTES],
            ffmpeg_log_level="quiet",
        )
        writer.send(None)
        sent = 0
        try:
            for frame in frames:
                writer.send(put_on(ground, frame))
                sent += 1
        finally:
            writer.close()
        written = frames_in(temporary.read_bytes())  # an encoder on a full disk says nothing
        if written != sent:
            raise RuntimeError(f"the encoder wrote {written} of {sent} frames")


def frames_in(film: bytes) -> int:
    """How many frames an MP4 of one track holds; 0 where it is cut off or none."""
    begin, end = 0, len(film)
    if sum(size for _, _, size in _boxes(film, begin, end)) != len(film):
        return 0
    for wanted in (*BOXES, SIZES):
        found = next((box for box in _boxes(film, begin, end) if box[0] == wanted), None)
        if found is None:
            return 0
        begin, end = found[1] + 8, found[1] + found[2]
    return int.from_bytes(film[begin + 8 : begin + 12], "big")


def _boxes(film: bytes, begin: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Name, place and size of each box in a part of the file."""
    while begin + 8 <= end:
        size = int.from_bytes(film[begin : begin + 4], "big")
        if size < 8:  # what is larger than 4 GB, or reaches to the file's end, is no film of ours
            return
        yield film[begin + 4 : begin + 8], begin, size
        begin += size


def write_gif(ground: Pixels, frames: Iterable[Frame], path: Path, fps: int) -> None:
    """Write a film as a GIF; arguments as of `write_mp4`."""
    images = [Image.fromarray(put_on(ground, frame)).quantize(128) for frame in frames]
    with atomic(path) as temporary:
        images[0].save(temporary, format="GIF", save_all=True, append_images=images[1:], loop=0, duration=1000 // fps)
