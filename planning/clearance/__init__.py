"""Needle to organ, every direction: the engine interface, the FCL reference, crossings and containment."""
