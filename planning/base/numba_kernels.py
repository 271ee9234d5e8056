"""Numba, with this project's places for compiled kernels in force: the one way by which kernels are compiled here.

A kernel that is defined before they are in force would be kept by numba's own rule, which misses edits in other files.
"""

import numba as nb

from puncture_twin.planning.base.cache.kernel_cache import use_kernel_cache

__all__ = ["nb"]

use_kernel_cache()
