"""What every pose says of the unknowns of A X P = Y B Q: residuals and their Jacobians."""
