"""The option `--preset`, the same everywhere. No command."""

PRESET_HELP = "how exactly to simulate: fast, balanced, accurate (default: the scene's own numbers; docs/tradeoff.md)"
