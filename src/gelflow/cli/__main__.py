"""`python -m gelflow.cli`: the `gelflow` command of the interpreter that runs it."""

import sys

from gelflow.cli.main import main

sys.exit(main())
