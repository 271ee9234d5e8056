"""The simulated room that knows the truth, beside the belief that planning works on."""

import planning  # noqa: F401  # it says where compiled kernels are kept, before the twin's own are met
