"""Numba, with this project's places for compiled kernels in force: the one way by which kernels are compiled here.

A kernel that is defined before they are in force would be kept by numba's own rule, which misses edits in other files.

What is compiled twice is waited for twice on a new machine. Numba compiles a kernel once more for read-only arrays:
whoever calls one from Python hands over a copy. It does so for an integer constant that one kernel hands to another,
which it types as this very number: there ``np.int64(0)`` stands for 0. And an array assigned to part of another brings
the text of an error with it, two seconds of kernels for characters: inside kernels such parts are filled by a loop.
"""

from functools import partial
from typing import Any

import numba as nb

from puncture_twin.planning.base.cache.kernel_cache import use_kernel_cache

__all__ = ["allocation_free", "nb"]

use_kernel_cache()

allocation_free: Any = partial(nb.njit, cache=True, _nrt=False)
"""Compile a kernel that makes no array: all that it works on, and works in, its caller owns.

Other kernels count how often each array is in use, with locked instructions, for each array of each tuple that is
handed on, taken apart or cut: of a kernel that asks a few flops of many arrays that is most of its time. Numba refuses
to compile one of these that makes an array.
"""
