"""Comparison of all methods: table lists them and their recordings, run runs them, fits and common_fit measure all fits
in the same way, choice recommends one, document and rows are the output. structural tests identifiability, combinations
and bounded_fit are for parameters of which only products are identifiable, validation is on held-out recordings."""
