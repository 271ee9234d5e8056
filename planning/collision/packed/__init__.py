"""The checks of one cell packed for compiled code: hulls, spheres, the skin's tree, and what moves."""
