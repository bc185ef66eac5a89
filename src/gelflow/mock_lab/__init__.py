"""The mock robot with its lab file, and measurements of the runner on it: soak tests, promises and endurance."""
