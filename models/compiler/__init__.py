"""From a model to machine code: `equations` merges effects in, `derivatives` and `codegen` generate slopes and
sensitivities, `column_code` and `machine_code` assemble these, and `fingerprint` identifies code that exists already.
`loops` passes over the data, `curves` interpolates inputs between samples, and `kernel` is the interface for all
callers."""
