"""How the body moves with the breath: positions after Lujan, what they displace, and which of them a gate lets through.

It knows names and millimetres only; which candidates that leaves safe is found in `planning.search.phases`.
"""
