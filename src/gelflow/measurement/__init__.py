"""Timing of workloads, start-up times, and the machine and versions of a measurement."""
