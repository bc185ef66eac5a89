"""A page that shows a run while it happens, in a process of its own."""
