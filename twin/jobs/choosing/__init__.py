"""Choice among directions: two side by side, lists checked row by row, tables of candidates for other programs.

They read a search and change no verdict.
"""
