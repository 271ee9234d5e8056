"""Bodies with known truth: the carton of Chen 2019, an abdomen, an open head, and a supine patient as a CT.

``python -m tools.phantoms --out DIR`` makes the embedded cases' files again.
"""
