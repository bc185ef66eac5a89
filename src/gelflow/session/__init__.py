"""Recorded sessions: write, read, recover and replay MCAP files."""
