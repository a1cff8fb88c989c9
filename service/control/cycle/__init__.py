"""The control cycle: what happens to a sample (`loop`), its experiment (`sequence`), and what may end it."""
