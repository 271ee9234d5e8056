"""What the inputs of a case say of each other: checks of plausibility, each a function to findings."""
