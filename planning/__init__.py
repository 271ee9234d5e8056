"""The planner: decides which needle paths are safe and reachable. Pure: no simulator, no screen, no printing."""

from planning.kernel_cache import use_kernel_cache

use_kernel_cache()
