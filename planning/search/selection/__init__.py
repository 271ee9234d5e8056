"""What to prefer among safe directions: how far each may be off, their connected windows, and what a person chooses.

It reads candidates and changes no verdict.
"""
