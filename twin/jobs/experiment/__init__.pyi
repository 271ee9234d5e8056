from .scan_job import ScanRequest as ScanRequest, ScanRun as ScanRun, scan_case as scan_case
from .scan_text import scan_text as scan_text
from .touch_job import touch_case as touch_case
