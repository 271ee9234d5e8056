"""The camera way of guidance: two calibrated cameras, a ball on the tool, and a servo on what they see (Liu 2007)."""
