"""Trials as lines of a file (trials), and what they come to: figures of merit (summary), pictures, by disturbance."""
