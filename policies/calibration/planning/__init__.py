"""What to record next: information of attempts, suggestions, and plans."""
