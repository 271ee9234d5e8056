"""The commands about a patient: search, check, plan, rehearse, export, register, verify, place."""
