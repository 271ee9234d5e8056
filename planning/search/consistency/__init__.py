"""Do the inputs of a case fit each other? A concept each: what is refused, and what is warned of."""
