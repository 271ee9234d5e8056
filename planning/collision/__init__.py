"""The arm with its tool against everything: bounds that are proofs first, FCL where they decide nothing.

The workcell (patient, obstacles, gantry, table) is put together here. Motions are planned in `motion`.
"""
