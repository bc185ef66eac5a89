"""Files and pictures of tracking and calibration."""
