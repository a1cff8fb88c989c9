"""Every method side by side: table says which there are and what each takes, run runs them, fits and common_fit measure
all alike, choice says which to rely on, document and rows are what people and programs read."""
