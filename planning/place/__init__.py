"""Where to put the arm: mounts about the patient, scored by the fraction of organ-safe directions that they reach."""
