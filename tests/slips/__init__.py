"""Slips that people make with files, lists and recordings, drawn by a seed; each beside an input that is true."""
