"""Where the tests find the repository and, where it is present, real data that is not part of it."""

from pathlib import Path

TESTS = Path(__file__).parent
ROOT = TESTS.parent
DATA = ROOT.parent / "shared" / "data"
"""Real data beside the repository; a test that needs it skips, saying so, where it is absent."""
REAL_CT = DATA / "totalseg_abdomen_3mm"
