"""Exit codes of the `gelflow` command; documented in docs/reference/command-line.md."""

SUCCESS = 0
NEGATIVE_RESULT = 1  # the command ran, and its result is negative
ERROR = 2  # wrong input, or a device or file that does not behave as expected
INTERRUPTED = 130  # Ctrl-C: 128 + SIGINT, as shells report it
SIGNALLED = 128  # plus the number of the signal: 129 SIGHUP, 143 SIGTERM
