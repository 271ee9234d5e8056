"""Errors of markers and of stated transforms that residuals cannot show; a registration is doubted, never changed."""
