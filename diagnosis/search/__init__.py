"""Which effects explain the lack of fit of a model, and the order in which they are found.

score all candidates -> contenders: full fits of those that may explain most -> one_more: gates and held-out data decide
which of them the model lacks -> neighbours: with the other findings in the model, is each the right one, are two better
than one, or one better than two -> search: repeat until nothing more passes (further), with random parts in addition.
"""
