"""What encloses the bodies of an arm: spheres, prisms and coarse hulls, each proven to contain its body."""
