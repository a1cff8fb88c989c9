"""Every method side by side: table says which there are and what each takes, run runs them, fits and common_fit measure
all alike, choice says which to rely on, document and rows are what people and programs read. structural says what the
outputs could tell at all, combinations and bounded_fit what is known in products alone, validation how fits predict
recordings that they have not seen."""
