"""The commands that train and evaluate policies, one module each."""
