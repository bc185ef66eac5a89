"""Driver of an ABB arm over EGM (externally guided motion)."""
