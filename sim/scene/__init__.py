"""Scenes: model files (MJCF, URDF) and the TOML beside them, read into what the core needs."""
