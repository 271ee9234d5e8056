"""The main job: every direction (θ, β) of a case to a verdict with a reason, ranked, explained and written as a table.

`prepare` puts together what a search needs from the rooms below; `constraints` holds the order of the reasons.
"""
