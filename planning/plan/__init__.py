"""The chosen pose and its motion: found from ranked candidates, written as `plan.json`, checked again when loaded."""
