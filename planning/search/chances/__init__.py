"""The chances of a search's candidates to hit and to touch: to first order for all, refined where they decide."""
