"""The arm in torque mode: inverse dynamics, impedance and admittance at the needle's tip. SI units: m, kg, N, rad."""
