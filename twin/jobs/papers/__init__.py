"""The command ``reproduce``: a paper's printed numbers beside ours."""
