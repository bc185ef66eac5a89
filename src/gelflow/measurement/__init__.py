"""Timing of code, and the machine and versions a measurement ran with."""
