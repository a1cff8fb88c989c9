"""The command line as a process of its own, which parts of the service run for what a person would type."""

from __future__ import annotations

import sys

UPRIGHT = (sys.executable, "-c", "from upright.service.cli import main; main()")
"""The words before those of a command."""
