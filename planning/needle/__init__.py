"""A needle that bends: its section, the beam on an elastic foundation, a bevel's path, the axial force; N and mm."""
