"""Where the next millimetre is won: what each source costs a puncture, and what a change of scan, markers or arm gains.

It computes with the one error model; nothing here decides a verdict.
"""
