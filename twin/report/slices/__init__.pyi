from .planes import Plane as Plane, letters as letters, needle_planes as needle_planes
from .sheet import Slices as Slices, draw_slices as draw_slices, write_sheet as write_sheet
from .subject import Subject as Subject
from .tones import TONES as TONES, Tone as Tone
