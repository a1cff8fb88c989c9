"""Model files: sections are their tables, own_equations and own_effects the user's, whose effect_rules are those of the
catalogue; document is what a file holds, text how it is written, model_file reads and writes it, history knows what was
added when."""
