"""The simulated workcell in PyBullet: client, arm, bodies, cameras. The only place with metres and with PyBullet."""
