"""The sub-commands of `gelflow`, one module each."""
