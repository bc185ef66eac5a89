"""Codecs, transports, drivers and the insertion runner for real hardware."""
