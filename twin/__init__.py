"""The simulated room that knows the truth, beside the belief that planning works on."""
