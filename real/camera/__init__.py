"""Tactile cameras: MJPEG streams and UVC devices."""
