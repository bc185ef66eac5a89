"""Training runs of any algorithm: learner, folder, state, progress."""
