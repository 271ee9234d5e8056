"""The commands ``batch``: a cohort planned, run, counted, merged and compared; its texts and its page."""
