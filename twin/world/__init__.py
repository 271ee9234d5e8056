"""The simulated room in PyBullet: client, arm, bodies, cameras. The only place with metres, and the only pybullet."""
