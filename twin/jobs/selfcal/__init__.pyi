from .job import run_selfcal as run_selfcal
from .text import selfcal_text as selfcal_text
