"""Model files: `sections` are their tables, `own_equations` and `own_effects` those of the user, `effect_rules` apply
to these effects and to the catalogue; `document` is the content of a file, `text` writes it as text, `model_file` reads
and writes files, `history` evaluates what was added when."""
