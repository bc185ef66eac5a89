"""Model files (MJCF, URDF), parsed and compiled by MuJoCo."""
