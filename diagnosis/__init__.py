"""Diagnosis: a model against a measurement, where it fails, and which physical effect it lacks. No I/O, no clock."""
