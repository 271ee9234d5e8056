"""Collision cases as ordinary pytest cases: the plugin behind ``*.collision.toml`` and the fixture ``collision``."""
