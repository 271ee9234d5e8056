"""Which voxels of a CT are the patient, and what else is in it that is not air: limbs, table, mattress, lines."""
