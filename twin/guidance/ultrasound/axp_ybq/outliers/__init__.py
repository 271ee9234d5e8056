"""Poses that disagree with the others: found, set aside, and the others fitted."""
