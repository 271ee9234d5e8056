"""What every room needs and none of them owns: errors, reasons, files, provenance, TOML, names, processes, stages.

Nothing here knows of needles, arms or anatomy.
"""
