"""The command ``reproduce``: a paper's printed numbers compared with ours."""
