"""Slices of the CT about a needle's path, with outlines, margin and region: the picture and its parts."""
