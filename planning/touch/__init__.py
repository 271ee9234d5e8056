"""How the markers are touched with the needle's tip: which poses, in which order, by which motions."""
