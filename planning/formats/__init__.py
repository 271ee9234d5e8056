"""Strict readers of other programs' files: every byte that a file promises must be there, or it is refused.

The guard stands before all compiled code. Each kind of file has its room below. What a file means to a case (roles,
margins, markers) is not decided here.
"""
