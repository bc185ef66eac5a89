"""The mock camera server."""
