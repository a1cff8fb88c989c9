"""Which effects explain what a model leaves, and the order in which they are found.

score all candidates -> contenders: those that may explain most get fits -> one_more: gates and held_out data decide
which of these the model lacks -> neighbours: beside the others, is it another one, or two, or one with a second ->
search: again, until nothing more passes (further), and random parts beside all of it.
"""
