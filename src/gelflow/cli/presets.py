"""The option `--preset`, the same everywhere. No command."""

PRESET_HELP = "fast, balanced or accurate simulation (default: the values of the scene file; docs/guide/tradeoff.md)"
