"""The noise of a recording as its residuals show it: its parts, by least squares or likelihood, and their doubt."""
