"""Guided commissioning: a vehicle's steps (vehicles.commissioning), carried out one after the other with a person.

evaluations turn recordings into numbers, guide carries out a step and keeps the record at the daemon, report writes the
document that an engineer files.
"""
