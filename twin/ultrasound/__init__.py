"""The ultrasound way: two arms calibrate themselves through the needle that shows in the image, A X P = Y B Q."""

from twin.ultrasound.calibration import Calibration, calibrate
from twin.ultrasound.pose_choice import choose_poses
from twin.ultrasound.recording import Noise, Recording, read_recording, write_recording
from twin.ultrasound.solve import Degenerate

__all__ = [
    "Calibration",
    "Degenerate",
    "Noise",
    "Recording",
    "calibrate",
    "choose_poses",
    "read_recording",
    "write_recording",
]
