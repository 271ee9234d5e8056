"""The digital twin: the experiment with a ground truth that the planner does not know, and pictures of what happened.

`plant` answers as devices do, `guidance` sees measurements only, `rehearsal` executes plans, `report` draws, `jobs`
composes them into the commands.
"""
