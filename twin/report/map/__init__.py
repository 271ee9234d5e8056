"""The map of all entry directions with the reason of each refusal, and the map of placements."""
