"""Trunks drawn anew by a seed: a case of meshes, no two alike, whose truth is known.

``python -m tools.phantoms --out DIR --seed N`` writes one.
"""
