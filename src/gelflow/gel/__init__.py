"""The elastic layer of a gel, and the files that describe it."""

from gelflow.gel.gel_file import ElasticGel, load_gel, save_gel

__all__ = ["ElasticGel", "load_gel", "save_gel"]
