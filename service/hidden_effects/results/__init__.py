"""Trials as lines of a file (trials), and their evaluation: figures of merit (summary), pictures, by disturbance."""
