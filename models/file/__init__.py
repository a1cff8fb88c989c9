"""Model files: sections are their tables, own_equations the user's, read and write go from text to model and back,
history knows what was added when."""
