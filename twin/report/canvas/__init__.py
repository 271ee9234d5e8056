"""Lines, areas and words in pictures without axes, smooth at their edges: nobody waits for a plotter to load."""
