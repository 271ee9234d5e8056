"""Clearance of every needle axis from every structure: the exact engine, and FCL as the reference that it must equal.

Margins and verdicts are not known here.
"""
