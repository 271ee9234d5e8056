"""The cache from one run to the next: surfaces and proofs as arrays, and numba's compiled kernels.

An entry is trusted only if its digest, the hashes of its inputs and the source of the code that made it all fit. What
an entry means is the business of the workcell that makes it.
"""
