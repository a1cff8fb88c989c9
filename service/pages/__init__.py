"""Results as text, for a terminal, a script or a notebook: each function prints to the console that it is given."""
