"""T_base_ct from matched markers, by each method, and what its residuals must not show."""
