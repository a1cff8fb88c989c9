"""Computed while the vehicle moves: estimates, news of the diagnosis, the model's prediction and what it lacks."""
