"""What residuals cannot show of markers: permuted names, slipped axes, markers off the skin.

And what a stated transform, which has no residuals, is held against.

It doubts a registration and never changes one.
"""
