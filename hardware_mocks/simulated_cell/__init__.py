"""The simulated robot cell behind the mock devices."""
