from .pivot_job import pivot_case as pivot_case
from .scan_job import ScanRequest as ScanRequest, ScanRun as ScanRun, scan_case as scan_case
from .scan_text import scan_text as scan_text
from .sweep_job import sweep_case as sweep_case
from .touch_job import touch_case as touch_case
