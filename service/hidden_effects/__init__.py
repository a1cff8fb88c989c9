"""The benchmark of hidden effects: how often an effect of a virtual vehicle that the model lacks is named correctly.

`cases` defines the cases, `trial` runs one, `spread` distributes them over cores or machines. methods/ contains the
diagnosis and the baselines that it is compared with. results/ stores the trials and evaluates them.
"""
