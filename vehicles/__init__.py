"""What a vehicle is: one folder a kind, with all that is its own, and what kinds have in common.

contract says what a kind is made of, registry finds them; sections and file are vehicle files, excitation, phases and
bounds what an experiment consists of, drives their configuration, views what people see.
"""
