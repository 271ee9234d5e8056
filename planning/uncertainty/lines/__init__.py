"""The chance to touch beyond first order: the needle is displaced along lines, and where it touches is found."""
