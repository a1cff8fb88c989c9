"""What a vehicle is: one folder a kind, with all that is its own, and what kinds have in common.

contract says what a kind is made of, registry finds them; sections and file are vehicle files, excitation, phases,
bounds and rising what an experiment consists of, recorded what a recording says of its controller; drives their
configuration, views what people see.
"""
