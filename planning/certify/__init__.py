"""The map between the grid points: cells of directions proven safe or rejected, the proof as a file, its checker.

The checker (`checker`, `plain_skin`) shares no code with the search or with what makes the certificate.
"""
