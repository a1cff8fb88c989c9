"""The vocabulary of upright: channels, samples and recordings. SI units, no I/O beyond recording files."""
