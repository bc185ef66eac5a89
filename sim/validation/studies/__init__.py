"""Studies of the simulator's accuracy and robustness; the scripts in `benchmarks/` run them and store the results."""
