"""Cohorts: many cases planned, run in parts by workers that may die, merged into one table, and compared.

A case is a pure function into a folder that is named by the hash of its inputs, options and version, and appears whole.
"""
