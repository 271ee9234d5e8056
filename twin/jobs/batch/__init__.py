"""The commands ``batch``: a cohort planned, run, looked at, merged and compared; its texts and its page."""
