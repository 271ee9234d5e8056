"""The ground truth: where the patient is, what the arm's joints do, what scanner and touching tip measure.

Guidance must not import it; a job hands it over as functions that answer like devices.
"""
