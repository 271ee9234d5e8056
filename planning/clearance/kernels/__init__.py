"""The exact engine's compiled inside: packed surfaces, bounds that are proofs, and triangle distances in float64."""
