"""Kinds of vehicle: one folder per kind with everything specific to it, and the code that kinds have in common.

contract defines the parts of a kind, registry finds the kinds. sections and file are vehicle files; excitation, phases,
bounds and rising are the parts of an experiment; recorded identifies the controller of a recording; drives configures
the drives; views is what people see.
"""
