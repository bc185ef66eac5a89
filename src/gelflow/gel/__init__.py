"""The elastic layer of a gel, and the files that describe it."""
