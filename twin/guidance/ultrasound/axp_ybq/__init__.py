"""A X P = Y B Q: from a recording to the unknowns with their covariance, or a refusal with poses that would help."""
