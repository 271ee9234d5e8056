from .batch import run_batch as run_batch
