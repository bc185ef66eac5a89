"""Networks, training, checkpoints and evaluation."""
