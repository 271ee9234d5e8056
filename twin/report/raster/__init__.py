"""Pictures without a screen: a camera, triangles to samples, translucent surfaces, shading; compiled."""
