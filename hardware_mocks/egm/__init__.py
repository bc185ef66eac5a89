"""The mock ABB arm."""
