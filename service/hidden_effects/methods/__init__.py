"""The methods that find the effect a model lacks: the diagnosis, and baselines by regression and by search."""
