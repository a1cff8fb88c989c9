"""`python -m upright`: the command line."""

from __future__ import annotations

from upright.service.cli import main

if __name__ == "__main__":
    main()
