"""Profiles of tactile sensors: what a camera sends, which part of it shows the gel, and the printed markers."""
