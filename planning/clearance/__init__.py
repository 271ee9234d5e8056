"""Clearance of every needle axis from every structure: the exact engine, and FCL, the reference that it equals."""
