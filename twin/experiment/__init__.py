"""The experiment of Chen et al. 2019 drawn anew: what its printed numbers say of its errors, and what they do not.

Arithmetic on points alone; what a robot and a scanner do lives in the plant.
"""
