"""Recordings once they are made: replay reads and runs them again, export writes them, machine says whose they are,
next_experiment what to record next, trail what a diagnosis leaves behind."""
