"""The promises of the runner, each shown on the mock robot with its reaction time, and the endurance of EGM."""
