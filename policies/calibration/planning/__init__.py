"""Choice of the attempts to record next: their information, suggestions, and plans."""
