"""Errors of markers that residuals cannot show: permuted names, slipped axes, markers off the skin.

And what a stated transform, which has no residuals, is held against.

It doubts a registration and never changes one.
"""
