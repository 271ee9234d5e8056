"""Headless rendering: a camera, triangles to samples, translucent surfaces, shading; compiled."""
