"""The `gelflow` command."""
