"""``python -m puncture_twin`` is ``run-twin``."""

from puncture_twin.run_twin import program

program()
