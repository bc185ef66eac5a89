"""Meshes, signed distance grids and surface sampling."""
