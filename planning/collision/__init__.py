"""The arm with its tool against all of the workcell: bounds that are proofs first, FCL where they decide nothing."""
