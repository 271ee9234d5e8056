"""The patient: structures with roles and margins, the skin, where a path crosses it, and what the CT shows beside.

Distances of needles from structures are measured in `clearance`; whether a candidate is safe is decided in `search`.
"""
