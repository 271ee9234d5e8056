"""The command ``selfcal``: the self-calibration from end to end, its pictures and page."""
