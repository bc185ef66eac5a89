"""The insertion runner, its checks and its lab file."""
