"""Planner and digital twin for robotic needle puncture."""
