"""Base of every room: errors, reasons, files, caches, provenance, strict JSON and TOML, names, processes, progress.

Nothing here knows of needles, arms or anatomy.
"""
