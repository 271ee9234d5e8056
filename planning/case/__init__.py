"""A case: the TOML schema key by key, the validated case in LPS mm and radians, and the entry frame.

It holds what the user wrote. What the named files contain is read in `anatomy` and `registration`.
"""
