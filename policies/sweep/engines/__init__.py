"""Engines that execute runs: this machine, a Ray cluster, SLURM."""
