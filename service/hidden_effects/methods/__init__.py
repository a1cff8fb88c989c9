"""What is asked which effect a model lacks: the diagnosis and, beside it, baselines by regression and by search."""
