"""Structure-aware fuzzing of every reader and of the command line: a corpus, mutators, targets and a runner."""
